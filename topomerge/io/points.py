"""Points in: one door for every format.

`read_points` and `read_chunks` find the reader by the file's suffix, bring what it hands over into metres with z up, and turn
every failure into an `InputError` of one line. Only the reader that is needed is imported.
"""

from __future__ import annotations

import importlib
import logging
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from topomerge.errors import InputError
from topomerge.io import frame
from topomerge.io.gather import Gatherer
from topomerge.io.piece import Options, Piece, damaged
from topomerge.types import PointCloud

Progress = Callable[[float, str], None]
LONGEST = 500  # letters of a message beside the path: what it quotes of a damaged file may be long
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Format:
    """A family of files. `fixed`: the format states its own unit and up axis, so those given don't apply."""

    name: str
    module: str
    suffixes: tuple[str, ...]
    up: str = "z"
    fixed: bool = False
    extra: str = ""  # of the package, with the libraries that it needs


FORMATS = (
    Format("a PLY file", "ply", (".ply",)),
    Format("a PCD file", "pcd", (".pcd",)),
    Format("a table of points", "text", (".xyz", ".txt", ".csv", ".pts", ".asc")),
    Format("a NumPy file", "arrays", (".npz", ".npy")),
    Format("a LAS file", "las", (".las", ".laz"), extra="las"),
    Format("an E57 file", "e57", (".e57",), extra="e57"),
    Format("a mesh", "mesh", (".obj", ".stl")),
    Format("a glTF mesh", "mesh", (".glb", ".gltf"), up="y"),
    Format("an OctoMap", "octomap", (".bt",)),
    Format("an IFC model", "ifc", (".ifc",), fixed=True, extra="ifc"),
    Format("a floor plan", "grid", (".yaml", ".yml", ".pgm", ".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"), fixed=True),
)


def suffixes() -> tuple[str, ...]:
    """Every suffix that can be read."""
    return tuple(s for f in FORMATS for s in f.suffixes)


def read_points(
    path: str | Path,
    *,
    up: str | None = None,
    unit: str | None = None,
    scale: float = 1.0,
    resolution: float | None = None,
    extrude: float = 2.5,
    ceiling: bool = False,
    spacing: float | None = None,
    doors: bool = False,
    progress: Progress | None = None,
) -> PointCloud:
    """The points of a file as one cloud, in metres, z up.

    Args:
        path: the file; its suffix names the format.
        up: axis of the file that points up: "z", "y", "x" or "-z", "-y", "-x"; None: what the format says, which is y for
            glTF and z for all others.
        unit: of the file's coordinates: "m", "cm", "mm", "ft" or "in"; None: metres.
        scale: factor on the coordinates, beside the unit.
        resolution: m per pixel; needed for an image without a map_server file.
        extrude: height of the walls made from a floor plan, m.
        ceiling: also close a floor plan from above.
        spacing: distance between points sampled on meshes, building models and floor plans, m; None: 0.05 m for surfaces
            and the resolution for floor plans.
        doors: keep the door leaves of a building model; by default its doors stand open.
        progress: called now and then with the share done and a text.

    Raises:
        InputError: anything that keeps the file from being read, in one line.
    """
    chunks = read_chunks(
        path, up=up, unit=unit, scale=scale, resolution=resolution, extrude=extrude, ceiling=ceiling,
        spacing=spacing, doors=doors, chunk=sys.maxsize, progress=progress,
    )  # fmt: skip
    return next(chunks)


def read_chunks(
    path: str | Path,
    *,
    up: str | None = None,
    unit: str | None = None,
    scale: float = 1.0,
    resolution: float | None = None,
    extrude: float = 2.5,
    ceiling: bool = False,
    spacing: float | None = None,
    doors: bool = False,
    chunk: int = 2_000_000,
    progress: Progress | None = None,
) -> Iterator[PointCloud]:
    """The points of a file as clouds of at most `chunk` points, for files larger than memory.

    All clouds share one shift. Poses, free space and true rooms come with the first, warnings about the whole file with the
    last. Meshes, building models, OctoMaps and NumPy archives are read whole and then cut. Arguments and errors: `read_points`.
    """
    path = Path(path)
    file_format = _format_of(path)
    _check_values(path, up, unit, scale, resolution, extrude, spacing, chunk)
    warnings: list[str] = []
    if file_format.fixed and (unit not in (None, "m") or up not in (None, "z")):
        warnings.append(f"{file_format.name} states its own unit and up axis: --unit and --up are not applied")
        unit = up = None
    factor = frame.UNITS[unit or "m"] * scale
    up = None if file_format.fixed else up or file_format.up
    options = Options(factor, resolution, extrude, ceiling, spacing, doors)
    return _chunks(path, file_format, options, up, chunk, warnings, progress)


def _check_values(
    path: Path,
    up: str | None,
    unit: str | None,
    scale: float,
    resolution: float | None,
    extrude: float,
    spacing: float | None,
    chunk: int,
) -> None:
    if up is not None and up not in frame.TURNS:
        raise InputError(f"{path}: --up {up} is not an axis; give one of {', '.join(frame.TURNS)}")
    if unit is not None and unit not in frame.UNITS:
        raise InputError(f"{path}: --unit {unit} is not known; give one of {', '.join(frame.UNITS)}")
    lengths = {"scale": scale, "resolution": resolution, "extrude": extrude, "spacing": spacing}
    for name, value in lengths.items():
        if value is not None and not (math.isfinite(value) and value > 0):
            raise InputError(f"{path}: --{name} {value:g} can't be used; give a number above 0")
    if chunk < 1:
        raise InputError(f"{path}: a chunk of {chunk} points can't be read; give 1 or more")


def _format_of(path: Path) -> Format:
    """The format of a file that exists and can be opened."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give a file in it")
    for file_format in FORMATS:
        if path.suffix.lower() in file_format.suffixes:
            break
    else:
        if path.suffix.lower() == ".tmap":
            raise InputError(f"{path}: is a map already; give the scan that it was made of, or see it with `topomerge info`")
        known = " ".join(s[1:] for s in suffixes())
        raise InputError(f"{path}: unknown suffix {path.suffix or '(none)'}; rename or export it as one of {known}")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is no regular file (a pipe or a device); give the name of a file")
    try:
        with path.open("rb") as stream:
            first = stream.read(1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: can't be opened ({error.strerror or error}); check its permissions") from error
    if not first:
        raise InputError(f"{path}: is empty; copy or export it again")
    return file_format


def _pieces(path: Path, file_format: Format, options: Options) -> Iterator[Piece]:
    """What the reader hands over. Whatever a damaged file makes it raise leaves here as an InputError."""
    try:
        reader = importlib.import_module(f"topomerge.io.{file_format.module}")
        yield from reader.read(path, options)
    except InputError as error:
        text, most = str(error), len(str(path)) + LONGEST
        raise error if len(text) <= most else InputError(f"{text[:most]} ...") from error.__cause__
    except (GeneratorExit, KeyboardInterrupt, SystemExit):
        raise
    except ImportError as error:
        package = f"topomerge[{file_format.extra}]" if file_format.extra else "topomerge"
        raise InputError(f"{path}: reading {file_format.name} needs {error.name}: pip install {package}") from error
    except MemoryError as error:
        raise InputError(f"{path}: does not fit into memory; use a machine with more, or thin the file") from error
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror or error}); copy it again") from error
    except BaseException as error:  # native readers raise their own kinds, panics of lazrs not even an Exception
        log.debug("reading %s failed", path, exc_info=True)
        raise damaged(path, file_format.name, error) from error


def _chunks(
    path: Path, file_format: Format, options: Options, up: str | None, chunk: int, warnings: list[str], progress: Progress | None
) -> Iterator[PointCloud]:
    gatherer = Gatherer(str(path), up, options.factor, chunk, warnings)
    for piece in _pieces(path, file_format, options):
        yield from gatherer.add(piece)
        if progress is not None:
            progress(min(piece.done, 1.0), f"reading {path.name}")
    if progress is not None:
        progress(1.0, f"read {path.name}")
    yield from gatherer.finish()
