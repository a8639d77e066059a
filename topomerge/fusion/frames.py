"""Where the files of a merge or an atlas lie in its frame: what `topomerge.io.native` needs to write them again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.frame import get_axis_rotation
from topomerge.io.native import NATIVE, Doubt, Motion, Source, refuse_scale
from topomerge.io.native.pose_graph import PoseGraph, build_pose_graph, read_pose_graph
from topomerge.io.piece import ReadOptions
from topomerge.types import (
    Array,
    Deformation,
    Placement,
    Sim3,
    convert_pose_to_files,
    convert_pose_to_maps,
    read_levelling,
    transform_points,
)

LISTINGS = ("merge.json", "atlas.json")
LEAST_DOUBT, USUAL_DOUBT, TURN_DOUBT = 0.02, 0.05, 0.01  # m, m and rad: of a pose between two maps


@dataclass(frozen=True, eq=False)
class FileFrame:
    """A file of a merge and where it lies.

    Args:
        number: of its map.
        source: as the merge was given it.
        motion: into the frame of the first map it is joined with; None: it stands apart.
        into: number of that map.
        doubt: of its pose.
        partners: maps that it is linked with.
    """

    number: int
    source: str
    motion: Motion | None
    into: int = 0
    doubt: Doubt = field(default_factory=lambda: Doubt(USUAL_DOUBT, TURN_DOUBT))
    partners: tuple[int, ...] = ()


def build_file_motion(placement: Placement, levelling: Array, into: Array) -> Motion:
    """Build the motion of a file from the placement of its map.

    Args:
        placement: of the map in the joined one.
        levelling, into: (4, 4), take points of the file, and of the first file, into their maps.
    """
    stays = placement.pose == Sim3() and np.array_equal(levelling, into)
    matrix = np.eye(4) if stays else convert_pose_to_files(placement.pose, levelling, into)
    if placement.bend is None:
        return Motion(matrix)
    return Motion(matrix, partial(_warp, placement, levelling, np.linalg.inv(into)))


def _warp(placement: Placement, levelling: Array, back: Array, points: Array) -> Array:
    return transform_points(back, placement.transform_points(transform_points(levelling, points)))


def convert_motion(motion: Motion, options: ReadOptions, up: str = "z") -> Motion:
    """Convert a motion of a file that is read with other axes or another unit: what it holds keeps both.

    Args:
        motion: in metres, z up.
        options: by which the file was read.
        up: the axis of the format, where the options name none.
    """
    reading = np.eye(4)
    reading[:3, :3] = options.factor * get_axis_rotation(options.up or up)
    if np.array_equal(reading, np.eye(4)):
        return motion
    back = np.linalg.inv(reading)
    matrix = back @ motion.matrix @ reading
    if motion.warp is None:
        return Motion(matrix)
    warp = motion.warp
    return Motion(matrix, lambda points: transform_points(back, warp(transform_points(reading, points))))


def read_file_frames(place: Path) -> list[FileFrame]:
    """Read where the files of a merge or an atlas lie: from its folder, or from a pose graph of its maps (.g2o).

    Raises:
        InputError: it is neither, or damaged.
    """
    if place.is_file() and place.suffix.lower() == ".g2o":
        vertices = read_pose_graph(place).vertices
        return [FileFrame(k, "", Motion(vertex.pose)) for k, vertex in sorted(vertices.items()) if vertex.posed]
    if not place.exists():
        raise InputError(f"{place}: no such file or folder; name the folder of a merge or an atlas, or a .g2o of its maps")
    listing_file = next((place / name for name in LISTINGS if (place / name).is_file()), None)
    if listing_file is None:
        raise InputError(f"{place}: is no folder of a merge or an atlas ({' or '.join(LISTINGS)} is missing), and no .g2o of one")
    try:
        listing: Any = json.loads(listing_file.read_text(encoding="utf-8"))
        frames = _parse_frames(listing)
    except InputError as error:
        raise InputError(f"{listing_file}: {error}") from error
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError, np.linalg.LinAlgError) as error:
        raise InputError(f"{listing_file}: damaged ({' '.join(str(error).split())[:100]}); merge the maps again") from error
    if not any(frame.motion is not None for frame in frames):
        raise InputError(f"{listing_file}: brought no maps together, so that nothing can be moved; see its reason")
    return frames


def _parse_frames(listing: Mapping[str, Any]) -> list[FileFrame]:
    levels = [read_levelling(m) for m in listing["maps"]]
    frames = [FileFrame(k, str(m["source"]), None, k) for k, m in enumerate(listing["maps"])]
    bends = {int(k): Deformation.from_json(bend) for k, bend in (listing.get("bend") or {}).items()}
    heads = set()
    for key, entry in listing["transforms"].items():
        k, into = int(key), int(entry["into"])
        matrix = convert_pose_to_maps(np.array(entry["matrix"], np.float64), levels[k], levels[into])
        placement = Placement(Sim3.from_matrix(matrix), bends.get(k))
        rmse = entry.get("rmse_m")
        doubt = Doubt(max(float(rmse), LEAST_DOUBT) if rmse is not None else USUAL_DOUBT, TURN_DOUBT)
        heads.add(into)
        motion = build_file_motion(placement, levels[k], levels[into])
        frames[k] = replace(frames[k], motion=motion, into=into, doubt=doubt)
    for k in heads:
        frames[k] = replace(frames[k], motion=build_file_motion(Placement(Sim3(), bends.get(k)), levels[k], levels[k]))
    for link in listing.get("links", ()):
        a, b = (int(k) for k in link["maps"])
        frames[b] = replace(frames[b], partners=(*frames[b].partners, a))
    return frames


def build_map_graph(frames: Sequence[FileFrame]) -> PoseGraph:
    """Build the pose graph of the maps of a merge: an edge for each link of an atlas, else from the first map to each other.

    Raises:
        InputError: a map is scaled, which no pose can be.
    """
    for frame in frames:
        if frame.motion is not None:
            refuse_scale(Source(Path(frame.source), frame.motion), NATIVE["g2o"])
    poses = {frame.number: frame.motion.matrix for frame in frames if frame.motion is not None}
    links = []
    for frame in frames:
        partners = frame.partners or ((frame.into,) if frame.into != frame.number and frame.motion is not None else ())
        links += [(a, frame.number, frame.doubt) for a in partners if a in poses]
    return build_pose_graph(poses, links)
