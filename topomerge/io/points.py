"""From the pieces of a reader to clouds of a wanted size: placed, cleaned, judged. One door for every format.

`read_points` and `read_chunks` find the reader by the file's suffix, bring what it hands over into metres with z up, and turn
every failure into an `InputError` of one line. Only the reader that is needed is imported.
"""

from __future__ import annotations

import importlib
import itertools
import logging
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from topomerge.archive import refuse_pointer
from topomerge.errors import InputError, is_memory_short
from topomerge.io import frame
from topomerge.io.frame import warn_about
from topomerge.io.landmarks import read_tables_beside
from topomerge.io.piece import Piece, ReadOptions, build_damage_error, read_options
from topomerge.io.sightings import ObjectFinder
from topomerge.progress import Progress
from topomerge.types import (
    Array,
    Landmarks,
    PointCloud,
    TrueRoom,
    VoxelGrid,
    clean_landmarks,
    join_landmarks,
    transform_landmarks,
)


class PointSample:
    """A thinned copy of all points seen so far, of bounded size."""

    def __init__(self, limit: int = 400_000) -> None:
        self.limit, self.step = limit, 1
        self.parts: list[Array] = []

    def add(self, points: Array) -> None:
        """Take every `step`-th of the (n, 3) points."""
        self.parts.append(np.array(points[:: self.step], np.float64))
        while sum(len(p) for p in self.parts) > self.limit:
            self.step *= 2
            self.parts = [p[::2] for p in self.parts]

    @property
    def points(self) -> Array:
        """(n, 3) float64."""
        return np.concatenate(self.parts) if self.parts else np.empty((0, 3))


BEYOND = 1e30  # m; larger values are as good as infinite, and float32 ends at 3e38


@dataclass(frozen=True)
class _Part:
    """Placed points with what belongs to each."""

    points: Array
    colors: Array | None = None
    labels: Array | None = None
    pose_of: Array | None = None
    intensities: Array | None = None

    def select(self, rows: Array | slice) -> _Part:
        values = (self.points, self.colors, self.labels, self.pose_of, self.intensities)
        return _Part(*(None if v is None else v[rows] for v in values))  # type: ignore[arg-type]


def _join(parts: list[_Part]) -> _Part:
    """Return all parts as one and nothing left in the list. What a part lacks is black, without room, pose or intensity."""
    if len(parts) == 1:
        return parts.pop()
    rows = [len(p.points) for p in parts]
    columns: list[Array | None] = []
    for name, blank in (("points", 0), ("colors", 0), ("labels", -1), ("pose_of", -1), ("intensities", np.nan)):
        values = [getattr(p, name) for p in parts]
        present = next((v for v in values if v is not None), None)
        if present is None:
            columns.append(None)
            continue
        shape, kind = present.shape[1:], present.dtype
        full = (np.full((n, *shape), blank, kind) if v is None else v for v, n in zip(values, rows, strict=True))
        columns.append(np.concatenate(list(full)))
    parts.clear()
    return _Part(*columns)  # type: ignore[arg-type]


class Gatherer:
    """Collects pieces of one file and hands out clouds.

    Args:
        source: path of the file, for the clouds and for errors.
        up: axis of the file that points up; None: the format states its own unit and z is up.
        factor: metres per unit of the file.
        chunk: points a cloud.
        warnings: what is already known to be said about the file.
    """

    def __init__(self, source: str, up: str | None, factor: float, chunk: int, warnings: list[str]) -> None:
        self.source, self.up, self.factor, self.chunk = source, up, factor, chunk
        self.rotation = frame.get_axis_rotation(up or "z")
        self.shift: Array | None = None
        self.warnings = list(warnings)
        self.sample = PointSample()
        self.dropped = 0
        self.parts: list[_Part] = []
        self.size = 0
        self.poses: Array | None = None
        self.landmarks: list[Landmarks] = []
        self.objects = ObjectFinder()
        self.free: VoxelGrid | None = None
        self.drawn_doors: Array | None = None
        self.rooms: tuple[TrueRoom, ...] = ()
        self.pending: PointCloud | None = None  # the last full cloud, held back because the last one carries the warnings

    def add(self, piece: Piece) -> Iterator[PointCloud]:
        """Take a piece in; yields the clouds that are now complete."""
        self._update_metadata(piece)
        if len(piece.points):
            part = self._transform_piece(piece)
            self.parts.append(part)
            self.size += len(part.points)
        while self.size >= self.chunk:
            joined = _join(self.parts)
            if self.size > self.chunk:
                self.parts.append(joined.select(slice(self.chunk, None)))
            self.size -= self.chunk
            yield from self._emit_cloud(joined.select(slice(None, self.chunk)))

    def finish(self) -> Iterator[PointCloud]:
        """Yield the clouds that are left; the last one carries all warnings."""
        if self.size:
            yield from self._emit_cloud(_join(self.parts))
        if self.pending is None:
            lost = f"; all {self.dropped:,} are not finite" if self.dropped else ""
            raise InputError(f"{self.source}: holds no points{lost}; export it again")
        if self.dropped:
            self.warnings.append(f"{self.dropped:,} points were not finite and are left out")
        self.warnings += warn_about(self.sample.points, self.up)
        found = join_landmarks([*self.landmarks, self.objects.find_objects("classes of points")])
        warnings = tuple(dict.fromkeys(self.warnings))
        yield replace(self.pending, warnings=warnings, landmarks=found if len(found) else None, drawn_doors=self.drawn_doors)

    def _update_metadata(self, piece: Piece) -> None:
        """Keep what a piece says about the whole file."""
        self.warnings += piece.warnings
        self.rooms += frame.scale_rooms(piece.rooms, self.factor)
        if piece.poses is not None:
            placed = frame.transform_poses(piece.poses, self.rotation, self.factor)
            self.poses = placed if self.poses is None else np.concatenate([self.poses, placed])
        if piece.landmarks is not None and len(piece.landmarks):
            place = partial(frame.transform_points, rotation=self.rotation, factor=self.factor)
            self.landmarks.append(transform_landmarks(clean_landmarks(piece.landmarks), place, scale=self.factor))
        if (drawn := piece.drawn_doors) is not None:
            self.drawn_doors = np.column_stack([frame.transform_points(drawn[:, :3], self.rotation, self.factor), drawn[:, 3]])
        if piece.free is not None and len(piece.free):
            self.free = frame.transform_grid(piece.free, self.rotation, self.factor)

    def _transform_piece(self, piece: Piece) -> _Part:
        points = frame.transform_points(piece.points, self.rotation, self.factor)
        if piece.classes is not None:
            self.objects.add(points, piece.classes)
        part = _Part(points, piece.colors, piece.labels, piece.pose_of, piece.intensities)
        if not (points.min() > -BEYOND and points.max() < BEYOND):  # so of nan, too
            finite = np.asarray((np.abs(points) < BEYOND).all(axis=1))
            self.dropped += int(len(points) - finite.sum())
            part = part.select(finite)
        if self.shift is None and len(part.points):
            self.shift = frame.choose_shift(part.points)
        self.sample.add(part.points)
        near = np.empty(part.points.shape, np.float32)
        for axis, shift in enumerate((0.0, 0.0, 0.0) if self.shift is None else self.shift.tolist()):
            near[:, axis] = part.points[:, axis] - shift
        return replace(part, points=near)

    def _emit_cloud(self, part: _Part) -> Iterator[PointCloud]:
        assert self.shift is not None
        cloud = PointCloud(
            part.points, self.shift, part.colors, part.labels, self.poses, part.pose_of, self.free, self.rooms, self.source
        )
        cloud = replace(cloud, intensities=part.intensities, upright=self.up is None)
        self.free, self.rooms = None, ()
        if self.pending is not None:
            yield self.pending
        self.pending = cloud


Block = TypeVar("Block")
MOST_FILES_LISTED = 1000  # in a folder that can't be read
MESSAGE_LETTERS = 500  # of a message beside the path, at most: what it quotes of a damaged file may be long
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Format:
    """A family of files, or of folders (no suffixes). `fixed`: it states its own unit and up axis, those given don't apply;
    `takes`: options that only it knows."""

    name: str
    module: str
    suffixes: tuple[str, ...]
    up: str = "z"
    fixed: bool = False
    extra: str = ""  # of the package, with the libraries that it needs
    takes: tuple[str, ...] = ()


PICTURES = (".pgm", ".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
DRAWN = ("resolution", "drawing", "extrude", "ceiling")  # options of drawings, whose walls are raised
FORMATS = (
    Format("a PLY file", "ply", (".ply",)),
    Format("a PCD file", "pcd", (".pcd",)),
    Format("a table of points", "text", (".xyz", ".txt", ".csv", ".pts", ".asc")),
    Format("a NumPy file", "arrays", (".npz", ".npy")),
    Format("a LAS file", "las", (".las", ".laz"), extra="las"),
    Format("an E57 file", "e57", (".e57",), extra="e57"),
    Format("a mesh", "mesh", (".obj", ".stl")),
    Format("a glTF mesh", "mesh", (".glb", ".gltf"), up="y"),
    Format("a USDZ scene", "usdz", (".usdz",), fixed=True, extra="usd", takes=("doors",)),
    Format("an OctoMap", "octomap", (".bt", ".ot")),
    Format("an IFC model", "ifc", (".ifc",), fixed=True, extra="ifc", takes=("doors",)),
    Format("a ROS bag", "bag", (".bag", ".db3", ".mcap"), extra="ros", takes=("poses", "topic", "extrude", "ceiling")),
    Format("a map in JSON", "json_map", (".json",), fixed=True, takes=DRAWN),
    Format("a map of a vacuum robot", "valetudo", (".rr", ".rrmap"), fixed=True, takes=("extrude", "ceiling")),
    Format("an RTAB-Map database", "rtabmap", (".db",)),
    Format("a ScanNet recording", "sens", (".sens",)),
    Format("a state of Cartographer", "pbstream", (".pbstream",), fixed=True, takes=("extrude", "ceiling")),
    Format("a pose graph of slam_toolbox", "karto", (".posegraph",), fixed=True),
    Format("a DXF drawing", "dxf", (".dxf",), extra="dxf", takes=("extrude", "ceiling", "page")),
    Format("a PDF drawing", "pdf", (".pdf",), fixed=True, extra="pdf", takes=(*DRAWN, "page")),
    Format("an SVG drawing", "svg", (".svg",), fixed=True, extra="svg", takes=DRAWN),
    Format("a floor plan", "grid", (".yaml", ".yml", *PICTURES), fixed=True, takes=(*DRAWN, "page")),
)
ADVICE = {".dwg": "save it as DXF", **dict.fromkeys((".webp", ".gif", ".heic", ".heif", ".avif"), "save it as PNG")}
SCAN_FOLDER = Format("a folder of scans", "scan_folder", (), takes=("poses",))
TILES_FOLDER = Format("a folder of files of one frame", "tiles", (), takes=("one_frame",))
RGBD_FOLDER = Format("a folder of RGB-D images", "rgbd", (), takes=("poses",))
OCTREES = {  # by the file that names all others
    "ept.json": Format("an EPT point cloud", "ept", (), extra="las"),
    "cloud.js": Format("a Potree 1.x point cloud", "potree", (), extra="las"),
}
POSED_RGBD_FOLDER = Format("a folder of RGB-D images with their poses", "rgbd_folders", ())


def list_suffixes() -> tuple[str, ...]:
    """List every suffix that can be read."""
    return tuple(s for f in FORMATS for s in f.suffixes)


def read_points(path: str | Path, *, progress: Progress | None = None, **options: Any) -> PointCloud:
    """Read the points of a file as one cloud, in metres, z up: ``read_points("a.ply", up="y", unit="mm")``.
    Landmarks in a file beside it (docs/landmarks.md) come along.

    Args:
        path: the file, whose suffix names the format, or a folder of scans.
        progress: called now and then with the share done and a text.
        options: those of `topomerge.io.piece.ReadOptions`: ``up``, ``unit``, ``scale`` of the coordinates; ``resolution``,
            ``extrude``, ``ceiling`` of floor plans; ``spacing`` of points on surfaces; ``doors`` of building models; ``poses``
            and ``topic`` of scans; ``one_frame`` of a folder of parts of one cloud; ``text`` of pictures; ``page`` of a PDF
            or, of a picture with several plans, which.

    Raises:
        InputError: anything that keeps the file from being read, or a wrong option, in one line.
    """
    return next(read_chunks(path, chunk=sys.maxsize, progress=progress, **options))


def read_chunks(
    path: str | Path, *, chunk: int = 2_000_000, progress: Progress | None = None, **options: Any
) -> Iterator[PointCloud]:
    """Read the points of a file as clouds of at most `chunk` points, for files larger than memory.

    All clouds share one shift. Poses, free space and true rooms come with the first, warnings about the whole file and landmarks
    with the last. Meshes, building models, OctoMaps and NumPy archives are read whole and then cut.

    Args:
        path: of the file or folder.
        chunk: points of a cloud, at most.
        progress: called now and then with the share done and a text.
        options: as of `read_points`, whose errors these are, too.
    """
    path = Path(path)
    file_format = detect_format(path)
    reading = read_options(path, options)
    if reading.one_frame and file_format is SCAN_FOLDER:
        file_format = TILES_FOLDER
    if chunk < 1:
        raise InputError(f"{path}: a chunk of {chunk} points can't be read; give 1 or more")
    for name in ("poses", "topic", "doors", "one_frame", "page", *DRAWN):
        if options.get(name) not in (None, False) and name not in file_format.takes:
            able = ", ".join(f.name for f in (*FORMATS, SCAN_FOLDER, TILES_FOLDER, RGBD_FOLDER) if name in f.takes)
            raise InputError(
                f"{path}: --{name.replace('_', '-')} is of no use to {file_format.name}, only to {able}; leave it out"
            )
    warnings: list[str] = []
    if file_format.fixed and (reading.unit not in (None, "m") or reading.up not in (None, "z")):
        warnings.append(f"{file_format.name} states its own unit and up axis: --unit and --up are not applied")
        reading = replace(reading, unit=None, up=None)
    up = None if file_format.fixed else reading.up or file_format.up
    tables, ignored = read_tables_beside(path, reading.poses, list_suffixes())
    gatherer = Gatherer(str(path), up, reading.factor, chunk, warnings + ignored)
    pieces = _iter_pieces(path, file_format, reading)
    companions = [Piece(np.empty((0, 3)), landmarks=found) for found in tables]
    pieces = itertools.chain(companions, pieces)
    return _iter_chunks(path, pieces, gatherer, progress)


def detect_format(path: Path) -> Format:
    """Return the format of a file that exists and can be opened, or of a folder.

    Raises:
        InputError: it can't, or its suffix is that of no format.
    """
    if path.is_dir():
        return _detect_folder_format(path)
    for file_format in (OCTREES[path.name],) if path.name in OCTREES else FORMATS:
        if path.name in OCTREES or path.suffix.lower() in file_format.suffixes:
            break
    else:
        if path.suffix.lower() == ".tmap":
            raise InputError(f"{path}: is a map already; give the scan that it was made of, or see it with `topomerge info`")
        if path.suffix.lower() == ".data" and path.with_suffix(".posegraph").is_file():
            raise InputError(f"{path}: belongs to {path.stem}.posegraph; give that file, this one is read with it")
        readable = f"rename or export it as one of {' '.join(s[1:] for s in list_suffixes())}"
        if path.with_name(f"{path.name}.posegraph").is_file():
            readable = f"give {path.name}.posegraph"
        raise InputError(f"{path}: unknown suffix {path.suffix or '(none)'}; {ADVICE.get(path.suffix.lower(), readable)}")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is no regular file (a pipe or a device); give the name of a file")
    try:
        refuse_pointer(path)
        with path.open("rb") as stream:
            first = stream.read(1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: can't be opened ({error.strerror or error}); check its permissions") from error
    if not first:
        raise InputError(f"{path}: is empty; copy or export it again")
    return file_format


def _detect_folder_format(path: Path) -> Format:
    """Detect the format of a folder: a ROS 2 bag or parts of a bag, an octree of files, RGB-D images, or scans."""
    bag = next(f for f in FORMATS if f.module == "bag")
    names = [p.name for p in path.iterdir() if not p.name.startswith(".")]
    if "metadata.yaml" in names or any(n.endswith(bag.suffixes) for n in names):
        return bag
    octree = next((OCTREES[name] for name in OCTREES if name in names), None)
    if octree is not None:
        return octree
    if {"metadata.json", "octree.bin"} <= set(names):
        raise InputError(f"{path}: is a Potree 2 point cloud, which is not read; give the LAS or LAZ file that it was made of")
    if "depth.txt" in names:
        return RGBD_FOLDER
    from topomerge.io.rgbd_folders import find_layout

    return POSED_RGBD_FOLDER if find_layout(path) else SCAN_FOLDER


def _iter_pieces(path: Path, file_format: Format, options: ReadOptions) -> Iterator[Piece]:
    return iter_guarded(path, file_format, lambda reader: reader.read(path, options))


def iter_guarded(path: Path, file_format: Format, blocks: Callable[[Any], Iterator[Block]]) -> Iterator[Block]:
    """Yield the blocks of a format's reader, with its errors converted to `InputError`.

    Args:
        path, file_format: of the file; the format's module is the reader.
        blocks: what to ask of the reader.

    Raises:
        InputError: whatever a damaged file makes the reader raise.
    """
    try:
        yield from blocks(importlib.import_module(f"topomerge.io.{file_format.module}"))
    except InputError as error:
        _refuse_pointers_in(path)
        text, most = str(error), len(str(path)) + MESSAGE_LETTERS
        raise error if len(text) <= most else InputError(f"{text[:most]} ...") from error.__cause__
    except (GeneratorExit, KeyboardInterrupt, SystemExit):
        raise
    except ImportError as error:
        if is_memory_short(error):
            raise MemoryError(str(error)) from error
        package = f"topomerge[{file_format.extra}]" if file_format.extra else "topomerge"
        raise InputError(f"{path}: reading {file_format.name} needs {error.name}: pip install {package}") from error
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory; use a machine with more, or thin the file") from error
    except OSError as error:
        if is_memory_short(error):
            raise InputError(f"{path}: does not fit into memory; use a machine with more, or thin the file") from error
        raise InputError(f"{path}: can't be read ({error.strerror or error}); copy it again") from error
    except BaseException as error:  # native readers raise their own kinds, panics of lazrs not even an Exception
        log.debug("reading %s failed", path, exc_info=True)
        _refuse_pointers_in(path)
        if is_memory_short(error):
            raise InputError(f"{path}: does not fit into memory; use a machine with more, or thin the file") from error
        raise build_damage_error(path, file_format.name, error) from error


def _refuse_pointers_in(folder: Path) -> None:
    """Refuse a folder that can't be read since files in it are pointers of Git LFS."""
    if folder.is_dir():
        for file in itertools.islice(folder.rglob("*"), MOST_FILES_LISTED):
            if file.is_file():
                refuse_pointer(file)


def _iter_chunks(path: Path, pieces: Iterable[Piece], gatherer: Gatherer, progress: Progress | None) -> Iterator[PointCloud]:
    for piece in pieces:
        yield from gatherer.add(piece)
        if progress is not None:
            progress(min(piece.done, 1.0), f"reading {path.name}")
    if progress is not None:
        progress(1.0, f"read {path.name}")
    yield from gatherer.finish()
