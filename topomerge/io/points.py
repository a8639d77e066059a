"""Points in: one door for every format.

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
from pathlib import Path
from typing import Any, TypeVar

from topomerge.errors import InputError, is_memory_short
from topomerge.io.gather import Gatherer
from topomerge.io.options import ReadOptions, read_options
from topomerge.io.piece import Piece, damaged, refuse_pointer
from topomerge.types import PointCloud

Progress = Callable[[float, str], None]
Block = TypeVar("Block")
MOST_FILES_LOOKED_AT = 1000  # in a folder that can't be read
MESSAGE_LETTERS = 500  # of a message beside the path, at most: what it quotes of a damaged file may be long
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Format:
    """A family of files, or of folders (no suffixes).

    `fixed`: the format states its own unit and up axis, so those given don't apply; `takes`: options that only it knows.
    """

    name: str
    module: str
    suffixes: tuple[str, ...]
    up: str = "z"
    fixed: bool = False
    extra: str = ""  # of the package, with the libraries that it needs
    takes: tuple[str, ...] = ()


PICTURES = (".pgm", ".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
DRAWN = ("resolution", "extrude", "ceiling")  # options of drawings, whose walls are raised
FORMATS = (
    Format("a PLY file", "ply", (".ply",)),
    Format("a PCD file", "pcd", (".pcd",)),
    Format("a table of points", "text", (".xyz", ".txt", ".csv", ".pts", ".asc")),
    Format("a NumPy file", "arrays", (".npz", ".npy")),
    Format("a LAS file", "las", (".las", ".laz"), extra="las"),
    Format("an E57 file", "e57", (".e57",), extra="e57"),
    Format("a mesh", "mesh", (".obj", ".stl")),
    Format("a glTF mesh", "mesh", (".glb", ".gltf"), up="y"),
    Format("an OctoMap", "octomap", (".bt", ".ot")),
    Format("an IFC model", "ifc", (".ifc",), fixed=True, extra="ifc", takes=("doors",)),
    Format("a ROS bag", "bag", (".bag", ".db3", ".mcap"), extra="ros", takes=("poses", "topic", "extrude", "ceiling")),
    Format("a map in JSON", "json_map", (".json",), fixed=True, takes=DRAWN),
    Format("an RTAB-Map database", "rtabmap", (".db",)),
    Format("a ScanNet recording", "sens", (".sens",)),
    Format("a floor plan", "grid", (".yaml", ".yml", *PICTURES), fixed=True, takes=DRAWN),
)
SCAN_FOLDER = Format("a folder of scans", "scan_folder", (), takes=("poses",))
TILES_FOLDER = Format("a folder of files of one frame", "tiles", (), takes=("one_frame",))
RGBD_FOLDER = Format("a folder of RGB-D images", "rgbd", (), takes=("poses",))
OCTREES = {  # by the file that names all others
    "ept.json": Format("an EPT point cloud", "ept", (), extra="las"),
    "cloud.js": Format("a Potree 1.x point cloud", "potree", (), extra="las"),
}
POSED_RGBD_FOLDER = Format("a folder of RGB-D images with their poses", "rgbd_folders", ())


def suffixes() -> tuple[str, ...]:
    """Every suffix that can be read."""
    return tuple(s for f in FORMATS for s in f.suffixes)


def read_points(path: str | Path, *, progress: Progress | None = None, **options: Any) -> PointCloud:
    """The points of a file as one cloud, in metres, z up: ``read_points("a.ply", up="y", unit="mm")``.

    Args:
        path: the file, whose suffix names the format, or a folder of scans.
        progress: called now and then with the share done and a text.
        options: those of `topomerge.io.options.ReadOptions`: ``up``, ``unit``, ``scale`` of the coordinates; ``resolution``,
            ``extrude``, ``ceiling`` of floor plans; ``spacing`` of points on surfaces; ``doors`` of building models; ``poses``
            and ``topic`` of scans; ``one_frame`` of a folder whose files are parts of one cloud.

    Raises:
        InputError: anything that keeps the file from being read, or a wrong option, in one line.
    """
    return next(read_chunks(path, chunk=sys.maxsize, progress=progress, **options))


def read_chunks(
    path: str | Path, *, chunk: int = 2_000_000, progress: Progress | None = None, **options: Any
) -> Iterator[PointCloud]:
    """The points of a file as clouds of at most `chunk` points, for files larger than memory.

    All clouds share one shift. Poses, free space and true rooms come with the first, warnings about the whole file with the
    last. Meshes, building models, OctoMaps and NumPy archives are read whole and then cut.

    Args:
        path: of the file or folder.
        chunk: points of a cloud, at most.
        progress: called now and then with the share done and a text.
        options: as of `read_points`, whose errors these are, too.
    """
    path = Path(path)
    file_format = format_of(path)
    reading = read_options(path, options)
    if reading.one_frame and file_format is SCAN_FOLDER:
        file_format = TILES_FOLDER
    if chunk < 1:
        raise InputError(f"{path}: a chunk of {chunk} points can't be read; give 1 or more")
    for name in ("poses", "topic", "doors", "one_frame", *DRAWN):
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
    gatherer = Gatherer(str(path), up, reading.factor, chunk, warnings)
    return _chunks(path, _pieces(path, file_format, reading), gatherer, progress)


def format_of(path: Path) -> Format:
    """The format of a file that exists and can be opened, or of a folder.

    Raises:
        InputError: it can't, or its suffix is that of no format.
    """
    if path.is_dir():
        return _folder_format(path)
    for file_format in (OCTREES[path.name],) if path.name in OCTREES else FORMATS:
        if path.name in OCTREES or path.suffix.lower() in file_format.suffixes:
            break
    else:
        if path.suffix.lower() == ".tmap":
            raise InputError(f"{path}: is a map already; give the scan that it was made of, or see it with `topomerge info`")
        readable = " ".join(s[1:] for s in suffixes())
        raise InputError(f"{path}: unknown suffix {path.suffix or '(none)'}; rename or export it as one of {readable}")
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


def _folder_format(path: Path) -> Format:
    """What a folder holds: a ROS 2 bag or parts of a bag, an octree of files, RGB-D images, or scans."""
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
    from topomerge.io.rgbd_folders import layout_of

    return POSED_RGBD_FOLDER if layout_of(path) else SCAN_FOLDER


def _pieces(path: Path, file_format: Format, options: ReadOptions) -> Iterator[Piece]:
    return guarded(path, file_format, lambda reader: reader.read(path, options))


def guarded(path: Path, file_format: Format, blocks: Callable[[Any], Iterator[Block]]) -> Iterator[Block]:
    """What the reader of a format hands over, a block at a time.

    Args:
        path: of the file.
        file_format: its module is the reader.
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
        raise damaged(path, file_format.name, error) from error


def _refuse_pointers_in(folder: Path) -> None:
    """Refuse a folder that can't be read since files in it are pointers of Git LFS."""
    if folder.is_dir():
        for file in itertools.islice(folder.rglob("*"), MOST_FILES_LOOKED_AT):
            if file.is_file():
                refuse_pointer(file)


def _chunks(path: Path, pieces: Iterable[Piece], gatherer: Gatherer, progress: Progress | None) -> Iterator[PointCloud]:
    for piece in pieces:
        yield from gatherer.add(piece)
        if progress is not None:
            progress(min(piece.done, 1.0), f"reading {path.name}")
    if progress is not None:
        progress(1.0, f"read {path.name}")
    yield from gatherer.finish()
