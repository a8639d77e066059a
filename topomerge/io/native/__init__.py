"""Files of other programs, written again in their own format with the poses of a merge.

A format is a module with `join(sources, target, doubt) -> Tally`, entered in `NATIVE`. Formats that hold sessions join several
files in one; those that hold points or one trajectory are written moved, each for itself. Nothing is imported until it is needed,
and no source is ever changed.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.archive import refuse_pointer, replace_on_success
from topomerge.errors import InputError
from topomerge.types import Array, transform_points

Warp = Callable[[Array], Array]  # (n, 3) float64 points of a file, m -> (n, 3) of the joined frame
STEP = 0.05  # m, over which the turn of a bent map at a place is measured
SAME_SIZE = 1e-6  # by which a scale may miss 1


@dataclass(frozen=True, eq=False)
class Motion:
    """Where the frame of a file lies in the joined one.

    Args:
        matrix: (4, 4) float64, a rotation and a translation; for formats that can be scaled also a scale.
        warp: where a bent map puts points; None: `matrix` says it all.
    """

    matrix: Array = field(default_factory=lambda: np.eye(4))
    warp: Warp | None = None

    @property
    def still(self) -> bool:
        """Does everything stay where it is?"""
        return self.warp is None and bool(np.array_equal(self.matrix, np.eye(4)))

    @property
    def scale(self) -> float:
        """How many times as large does the file become?"""
        return float(np.cbrt(np.linalg.det(self.matrix[:3, :3])))

    @property
    def level(self) -> bool:
        """Does the vertical stay vertical?"""
        return bool(np.allclose(self.matrix[2, :3], (0, 0, 1), rtol=0, atol=SAME_SIZE))

    def move_points(self, points: Array) -> Array:
        """Move (n, 3) points."""
        return transform_points(self.matrix, points) if self.warp is None else self.warp(np.asarray(points, np.float64))

    def move_poses(self, poses: Array) -> Array:
        """Move (n, 4, 4) poses; of a bent map each is turned as the map is turned around it."""
        if self.warp is None or not len(poses):
            moved: Array = self.matrix @ poses
            return moved
        places = poses[:, :3, 3]
        ends = [self.warp(places + sign * STEP * axis) for axis in np.eye(3) for sign in (1, -1)]
        jacobian = np.stack([(ends[2 * k] - ends[2 * k + 1]) / (2 * STEP) for k in range(3)], axis=2)
        u, _, v = np.linalg.svd(jacobian)
        out = poses.astype(np.float64)
        out[:, :3, :3] = (u @ v) @ poses[:, :3, :3]
        out[:, :3, 3] = self.warp(places)
        return out


@dataclass(frozen=True)
class Doubt:
    """How sure the pose of one session in another is: standard deviations of a place, m, and of a turn, rad."""

    place: float = 0.05
    turn: float = 0.01

    def build_information(self) -> Array:
        """Build (6, 6) inverse covariance of x, y, z and turns about them."""
        information: Array = np.diag([self.place**-2.0] * 3 + [self.turn**-2.0] * 3)
        return information


@dataclass(frozen=True, eq=False)
class Source:
    """A file and where its frame lies."""

    path: Path
    motion: Motion = field(default_factory=Motion)


@dataclass(frozen=True)
class Tally:
    """Counts of what was written: kind of thing (nodes, links, …) -> how many the sources have and how many the file has."""

    counts: Mapping[str, tuple[int, int]]
    warnings: tuple[str, ...] = ()

    def describe(self) -> str:
        """Describe the counts in words."""
        return ", ".join(f"{after:,} {name}" for name, (_, after) in self.counts.items() if after)


@dataclass(frozen=True)
class Format:
    """A format: what such files are called, their suffixes, the module that writes them, whether several become one, the
    suffix of a file that is written beside, whether only those of one group are joined (`find_group` of the module), whether what
    is in them can be scaled, and the suffix of what is written, if it is not theirs."""

    name: str
    suffixes: tuple[str, ...]
    module: str
    joins: bool = False
    companion: str = ""
    grouped: bool = False
    scales: bool = False
    written: str = ""


NATIVE = {
    "rtabmap": Format("an RTAB-Map database", (".db",), "rtabmap", joins=True),
    "g2o": Format("a pose graph", (".g2o",), "pose_graph", joins=True),
    "pbstream": Format("a state of Cartographer", (".pbstream",), "pbstream", joins=True),
    "karto": Format("a pose graph of slam_toolbox", (".posegraph",), "karto", joins=True, companion=".data", grouped=True),
    "dsg": Format("a scene graph", (".json",), "scene_graph", joins=True),
    "usdz": Format("a USDZ file", (".usdz",), "usdz", joins=True, scales=True),
    "robot_map": Format("a vacuum robot's map", (".json", ".rr", ".rrmap"), "robot_map", joins=True, written=".json"),
    "e57": Format("an E57 file", (".e57",), "stations"),
    "las": Format("a LAS file", (".las", ".laz"), "clouds", scales=True),
    "ply": Format("a PLY file", (".ply",), "clouds", scales=True),
    "pcd": Format("a PCD file", (".pcd",), "clouds"),
    "trajectory": Format("a trajectory", (".txt", ".csv", ".tum", ".kitti"), "trajectories"),
}
CHECKED = ("trajectories", "scene_graph", "robot_map")  # modules whose `is_native` reads a file to tell whether it is theirs


def find_format(path: Path) -> Format | None:
    """Find the format in which a file can be written again; None: in none, or it does not exist."""
    if not path.is_file():
        return None
    able = (form for form in NATIVE.values() if path.suffix.lower() in form.suffixes)
    checked = (f for f in able if f.module not in CHECKED or import_module(f"topomerge.io.native.{f.module}").is_native(path))
    return next(checked, None)


def list_native_suffixes() -> str:
    """List the suffixes of files that can be written again, in words."""
    return " ".join(dict.fromkeys(s[1:] for form in NATIVE.values() for s in form.suffixes))


def plan_outputs(sources: Sequence[Source], folder: Path) -> list[tuple[Path, Format, list[Source]]]:
    """Plan the files to write: one for all sources of a format that joins, one for each of the others.

    Raises:
        InputError: a source can't be written again.
    """
    groups: dict[str, tuple[Format, list[Source]]] = {}
    for number, source in enumerate(sources):
        refuse_missing(source.path)
        form = find_format(source.path)
        if form is None:
            able = f"only {list_native_suffixes()} are written again with new poses"
            whole = next((f for f in NATIVE.values() if f.companion and source.path.suffix.lower() == f.companion), None)
            if whole is not None:
                name = source.path.with_suffix(whole.suffixes[0]).name
                raise InputError(f"{source.path}: give {name}, beside which it lies")
            raise InputError(f"{source.path}: {able}; leave it out, or take its points by `merge --points`")
        refuse_scale(source, form)
        key = form.module if form.joins else str(number)
        if form.grouped:
            key += import_module(f"topomerge.io.native.{form.module}").find_group(source.path)
        groups.setdefault(key, (form, []))[1].append(source)
    taken: set[str] = set()
    plan = []
    for form, members in groups.values():
        suffix = "".join(members[0].path.suffixes[-2:]) if members[0].path.name.endswith(".dsg.json") else members[0].path.suffix
        written = form.written or suffix
        stem = "joined" if len(members) > 1 else f"{members[0].path.name.removesuffix(suffix)}_moved"
        tries = (f"{stem}{f'_{n}' if n > 1 else ''}{written}" for n in itertools.count(1))
        name = next(name for name in tries if name.lower() not in taken)
        taken.add(name.lower())
        plan.append((folder / name, form, members))
    return plan


def refuse_scale(source: Source, form: Format) -> None:
    """Refuse a file that has another size in the joined frame, where its format holds poses.

    Raises:
        InputError: it is so.
    """
    scale = source.motion.scale
    if not form.scales and abs(scale - 1) > SAME_SIZE:
        raise InputError(
            f"{source.path}: is {scale:.4g} times as large in the joined frame, and poses can't scale; "
            f"read it with --scale {scale:.6g}"
        )


def refuse_missing(path: Path) -> None:
    """Refuse a path that is no file that can be read.

    Raises:
        InputError: it is none.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path")
    try:
        refuse_pointer(path)
    except OSError as error:
        raise InputError(f"{path}: can't be opened ({error.strerror or error}); check its permissions") from error


def save_joined(form: Format, sources: Sequence[Source], target: Path, doubt: Doubt | None = None) -> Tally:
    """Write sources of one format as one file in the joined frame, whole or not at all.

    Args:
        form: of all sources; one that does not join takes one.
        sources: in the order of their sessions.
        target: the file.
        doubt: of the poses between sessions, for the links that hold them together.

    Raises:
        InputError: a source is damaged, or can't be written truly; the line says why.
    """
    module: Any = import_module(f"topomerge.io.native.{form.module}")
    try:
        with replace_on_success(target) as temporary:
            tally: Tally = module.join(sources, temporary, doubt or Doubt())
            if form.companion:
                with replace_on_success(target.with_suffix(form.companion)) as companion:
                    temporary.with_suffix(form.companion).replace(companion)
    except InputError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, struct.error) as error:
        named = " or ".join(str(source.path) for source in sources)
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise InputError(f"{named}: damaged, or not {form.name} ({reason}); export it again") from error
    return tally


def find_nearest_links(places: Sequence[Array], most: int = 10, apart: float = 1.0) -> Iterator[tuple[int, int, int, int]]:
    """Find pairs of nodes by which sessions are linked: for each session but the first, the nearest ones of those before it.

    Args:
        places: (n, 3) m of each session's nodes in the joined frame.
        most: pairs of one session, at most.
        apart: m, between the nodes of different pairs.

    Returns:
        Session and row of the earlier node, session and row of the later one. There is at least one pair of each session that
        has nodes.
    """
    from scipy.spatial import cKDTree

    owner = np.concatenate([np.full(len(p), k) for k, p in enumerate(places)])
    rows = np.concatenate([np.arange(len(p)) for p in places])
    every = np.concatenate([np.reshape(p, (-1, 3)) for p in places])
    for later, own in enumerate(places):
        before = np.flatnonzero(owner < later)
        if not len(own) or not len(before):
            continue
        distance, nearest = cKDTree(every[before]).query(own)
        kept: list[int] = []
        for row in np.argsort(distance, kind="stable").tolist():
            beyond = kept and distance[row] > max(2.0 * distance[kept[0]], apart)
            if len(kept) == most or beyond:
                break
            if all(np.linalg.norm(own[row] - own[other]) >= apart for other in kept):
                kept.append(row)
                earlier = before[nearest[row]]
                yield int(owner[earlier]), int(rows[earlier]), later, row
