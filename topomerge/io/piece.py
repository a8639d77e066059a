"""Common parts of all readers: options, pieces of a cloud, gathering them."""

from __future__ import annotations

import importlib
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from numbers import Real
from pathlib import Path
from typing import IO, Any

import numpy as np

from topomerge.archive import refuse_pointer
from topomerge.errors import InputError, is_memory_short
from topomerge.io.frame import TURNS, UNITS
from topomerge.types import LANDMARK_DTYPE, Array, Landmarks, TrueRoom, VoxelGrid

PIXELS = 100_000_000  # of a picture; more is refused
BLOCK_POINTS = 1 << 19  # points a reader hands over at a time
MOST_POINTS = 100_000_000  # points that a sampled or extruded file may become; more is a wrong unit, not a building


@dataclass(frozen=True)
class Piece:
    """Some of the points of a file. `free`, `rooms` and `drawn_doors` describe the whole file and come with its first piece;
    `poses` come with the first piece whose points need them, and are counted by `pose_of` over all pieces; `landmarks` come with
    any, also with one without points."""

    points: Array  # (n, 3) float, in the file's frame and unit
    colors: Array | None = None  # (n, 3) uint8
    labels: Array | None = None  # (n,) int32
    poses: Array | None = None  # (K, 4, 4) float64
    pose_of: Array | None = None  # (n,) int32
    free: VoxelGrid | None = None
    rooms: tuple[TrueRoom, ...] = ()
    warnings: tuple[str, ...] = ()
    done: float = 0.0  # share of the file read so far
    intensities: Array | None = None  # (n,) float32, in whatever the file counts in
    classes: Array | None = None  # (n,) int32, of what the points lie on, as the file counts them; -1: none
    landmarks: Landmarks | None = None  # positions in the file's frame and unit
    drawn_doors: Array | None = None  # (k, 4) float64 floor on which a drawing shows doors: place, and how probably


def is_outside_link(path: Path) -> bool:
    """Return whether a path links to a place outside of its folder, whose content must not be quoted in a message."""
    return not path.resolve().is_relative_to(path.parent.resolve())


def read_head(path: Path, kind: str, magic: bytes, length: int) -> bytes:
    """Read the first bytes of a file that must start with `magic`.

    Raises:
        InputError: it does not, or has fewer than `length` bytes.
    """
    refuse_pointer(path)
    with path.open("rb") as stream:
        head = stream.read(length)
    if not head.startswith(magic):
        start = magic.rstrip(b"\0").decode()
        raise InputError(f"{path}: is not {kind} (it does not start with {start}); check the file's suffix")
    if len(head) < length:
        raise build_damage_error(path, kind, "its header is cut short")
    return head


def build_truncation_error(path: Path, have: int, promised: int, what: str = "points") -> InputError:
    """Build the error for a file that ends before what its header promises."""
    return InputError(
        f"{path}: holds {have:,} of the {promised:,} {what} that its header promises; the file is cut short, copy it again"
    )


def build_damage_error(path: Path, kind: str, reason: object) -> InputError:
    """Build the error for a file that is not what its name says. Of a link to another place nothing is quoted."""
    text = " ".join(str(reason).split())[:160] or type(reason).__name__
    if is_outside_link(path):
        text = "it is a link out of its folder, so nothing of it is shown"
    return InputError(f"{path}: damaged, or not {kind} ({text}); export it again")


def build_count_error(path: Path, count: float, spacing: float) -> InputError:
    """Build the error for a surface that would become an absurd number of points."""
    return InputError(
        f"{path}: would become {count:.1e} points at a spacing of {spacing:g} m; check --unit, or give a larger --spacing"
    )


def convert_to_float32(values: Array) -> Array:
    """Return the values as float32; what is beyond its reach is infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32)


def convert_to_uint8(colors: Array) -> Array:
    """Return (n, 3) uint8 colours from bytes, 16-bit integers or floats in 0..1 or 0..255."""
    if colors.dtype == np.uint8 or not len(colors):
        return np.ascontiguousarray(colors, np.uint8)
    values = np.nan_to_num(convert_to_float32(colors), nan=0.0, posinf=0.0, neginf=0.0)
    top = float(values.max())
    if np.issubdtype(colors.dtype, np.floating) and top <= 1.0:
        values = values * 255.0
    elif top > 255.0:
        values = values / 257.0
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class ReadOptions:
    """Options of `read_points`, `read_chunks` and each reader; lengths in metres.

    Args:
        up: axis of the file that points up: "z", "y", "x" or "-z", "-y", "-x"; None: what the format says, which is y for
            glTF and z for all others.
        unit: of the file's coordinates: "m", "cm", "mm", "ft" or "in"; None: metres.
        scale: factor on the coordinates, beside the unit.
        resolution: m per pixel of an image without a map_server file; of a drawing None: by what is written on it.
        drawing: read an image of a page as a drawn plan; False: its dark pixels are walls.
        extrude: height of the walls made from a floor plan, m.
        ceiling: also close a floor plan from above.
        spacing: distance between points sampled on meshes, building models and floor plans, m; None: 0.05 m for surfaces
            and the resolution for floor plans. Of clouds cut into octrees, that of the finest level to read; None: all levels.
        doors: keep the door leaves of a building model; by default its doors stand open.
        poses: file with the trajectory of a folder of scans, RGB-D images or a bag (KITTI or TUM format); of a bag also the name
            of a topic with poses. None: what lies beside the scans, or what the bag holds.
        one_frame: read all files of a folder as parts of one cloud, whose points lie in one frame.
        topic: of a bag, where it has several with points or maps.
        page: of a PDF file, from 1; None: the only one that holds anything. Of a picture with several plans: which; None: all.
        text: read signs and tags on pictures. True: must; None: where the packages for that are installed; False: don't.
        tag_size: side of the black square of the tags on pictures, m, by which they are placed; None: by depth.
    """

    up: str | None = None
    unit: str | None = None
    scale: float = 1.0
    resolution: float | None = None
    drawing: bool = True
    extrude: float = 2.5
    ceiling: bool = False
    spacing: float | None = None
    doors: bool = False
    poses: str | None = None
    topic: str | None = None
    one_frame: bool = False
    page: int | None = None
    text: bool | None = None
    tag_size: float | None = None

    @property
    def factor(self) -> float:
        """Metres per unit of the file."""
        return UNITS[self.unit or "m"] * self.scale


OPTION_NAMES = tuple(field.name for field in fields(ReadOptions))
LENGTH_NAMES = ("scale", "resolution", "extrude", "spacing", "tag_size")


def read_options(path: Path, values: Mapping[str, Any]) -> ReadOptions:
    """Read the options of these names and values.

    Raises:
        InputError: there is no such option, or it can't have such a value; the line names the file that was to be read.
    """
    for name in values:
        if name not in OPTION_NAMES:
            raise InputError(f"{path}: {name} is no option of reading; give one of {', '.join(OPTION_NAMES)}")
    options = ReadOptions(**values)
    for name, allowed in (("up", TURNS), ("unit", UNITS)):
        if values.get(name) is not None and values[name] not in allowed:
            wrong = "not an axis" if name == "up" else "not known"
            raise InputError(f"{path}: --{name} {values[name]} is {wrong}; give one of {', '.join(allowed)}")
    for name in ("poses", "topic"):
        if getattr(options, name) is not None and not str(getattr(options, name)).strip():
            raise InputError(f"{path}: --{name} is empty; give a name")
    if options.page is not None and not (isinstance(options.page, int) and options.page >= 1):
        raise InputError(f"{path}: --page {options.page!r} can't be used; give a whole number from 1 on")
    for name in LENGTH_NAMES:
        value = getattr(options, name)
        if value is not None and not (isinstance(value, Real) and math.isfinite(value) and float(value) > 0):
            shown = f"{value:g}" if isinstance(value, Real) else repr(value)
            raise InputError(f"{path}: --{name.replace('_', '-')} {shown} can't be used; give a number above 0")
    return options


LARGEST_JSON = 1 << 28  # bytes: a page of a hierarchy of ten million nodes
MOST_LEVELS = 40  # of an octree: a millimetre of a million kilometres
LARGEST_NODE = 1 << 30  # bytes; usual ones have a few million
COLOR_NAMES = ("red", "green", "blue")


def load_json(path: Path, kind: str) -> dict[str, Any]:
    """Load the object in a JSON file.

    Raises:
        InputError: there is no such file, or no object in it.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file, and it belongs to {kind}; copy the whole folder again")
    if path.stat().st_size > LARGEST_JSON:
        raise InputError(f"{path}: has {path.stat().st_size:,} bytes, too many for a part of {kind}; copy it again")
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise build_damage_error(path, f"a part of {kind}", error) from error
    if not isinstance(values, dict):
        raise build_damage_error(path, f"a part of {kind}", "it holds no object")
    return values


def compute_deepest_level(root_spacing: float, options: ReadOptions) -> int:
    """Return the level whose points are as close as `options.spacing` asks for; levels halve the distance. Not asked for: all
    levels."""
    if options.spacing is None or not root_spacing > 0:
        return sys.maxsize
    ratio = root_spacing * options.factor / options.spacing
    return max(0, math.ceil(math.log2(ratio) - 1e-9)) if 0 < ratio < math.inf else sys.maxsize


def check_node(path: Path) -> None:
    """Raise an InputError where a node has no file, or an absurdly large one."""
    if not path.is_file():
        raise InputError(f"{path}: no such file, but the hierarchy names it; copy the whole folder again")
    if path.stat().st_size > LARGEST_NODE:
        raise InputError(f"{path}: has {path.stat().st_size:,} bytes, too many for a node of an octree; convert the cloud again")


def decode_rows(path: Path, data: bytes, layout: np.dtype[Any], promised: int) -> np.ndarray[Any, Any]:
    """Decode the rows of a node of packed points.

    Raises:
        InputError: its bytes are not those of whole points, or fewer than the hierarchy promises.
    """
    count = len(data) // layout.itemsize
    if len(data) % layout.itemsize or count < promised:
        raise build_truncation_error(path, count, promised)
    return np.frombuffer(data, layout)


def decode_colors(rows: np.ndarray[Any, Any]) -> np.ndarray[Any, Any] | None:
    """Decode (n, 3) uint8 of the fields red, green and blue; None where the rows lack one."""
    if not set(COLOR_NAMES) <= set(rows.dtype.names or ()):
        return None
    return convert_to_uint8(np.stack([rows[name] for name in COLOR_NAMES], axis=1))


ARRAYS: dict[str, Any] = {  # of a piece
    "points": np.float64, "colors": np.uint8, "poses": np.float64, "pose_of": np.int32, "intensities": np.float32,
    "landmarks": LANDMARK_DTYPE,
}  # fmt: skip


def read_in_subprocess(
    module: str, kind: str, path: Path, options: ReadOptions, seconds: int | None = None, room: int | None = None
) -> Iterator[Piece]:
    """Yield the pieces of ``module.read_in_process(path, options)``, labels and free space left out.

    Args:
        module: of `topomerge.io`.
        kind: what the file should be, for messages.
        seconds: of the processor that the reader may take for one piece; None: any.
        room: bytes that it may take beyond what it needs to start; None: any.

    Raises:
        InputError: as the reader; or the child came to an end before it was done.
    """
    with _open_child([module, str(path), asdict(options), seconds, room], kind, path, seconds) as stream:
        while (piece := _receive_piece(path, kind, stream)) is not None:
            yield piece


def compute_in_subprocess(module: str, kind: str, path: Path, task: Mapping[str, Any], seconds: int, room: int) -> Any:
    """Compute ``module.compute_in_process(task)`` in a process of its own; the task and the result are values of JSON.

    Args:
        module: of `topomerge.io`.
        kind: what the file should be, for messages.
        path: of the file, for messages.
        task: what to do.
        seconds: of the processor that it may take.
        room: bytes that it may take beyond what it needs to start.

    Raises:
        InputError: as the function; or the child came to an end before it was done.
    """
    with _open_child([module, str(path), {"task": dict(task)}, seconds, room], kind, path, seconds) as stream:
        return _receive_header(path, kind, stream)["value"]


@contextmanager
def _open_child(words: Sequence[Any], kind: str, path: Path, seconds: int | None) -> Iterator[IO[bytes]]:
    """Yield what a child sends; it is ended afterwards. Where it ended too early, an InputError."""
    child = start_child(json.dumps(words))
    assert child.stdout is not None
    try:
        yield child.stdout
    except EOFError:
        late = child.wait() == -signal.SIGXCPU
        why = f"more than {seconds} s for a small part of it" if late else "the library that reads it broke down"
        raise build_damage_error(path, kind, why) from None
    finally:
        child.kill()
        child.communicate()


def start_child(task: str) -> subprocess.Popen[bytes]:
    """Start the process that reads: `main`, whose pieces come on its standard output."""
    arguments = [sys.executable, "-c", f"from {__name__} import main; main()", task]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    return subprocess.Popen(
        arguments, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL, env=environment
    )


def _receive_header(path: Path, kind: str, stream: IO[bytes]) -> dict[str, Any]:
    """Return what the child sends next; an EOFError where it is no more."""
    line = stream.readline()
    if not line.endswith(b"\n"):
        raise EOFError
    header: dict[str, Any] = json.loads(line)
    if "refused" in header:
        raise InputError(header["refused"])
    if "fault" in header:
        raise build_damage_error(path, kind, header["fault"])
    return header


def _receive_piece(path: Path, kind: str, stream: IO[bytes]) -> Piece | None:
    """Return the next piece, None after the last."""
    header = _receive_header(path, kind, stream)
    if "end" in header:
        return None
    arrays: dict[str, Any] = {name: _receive_array(stream, ARRAYS[name], shape) for name, shape in header["arrays"].items()}
    rooms = tuple(TrueRoom(**{**room, "polygon": np.array(room["polygon"], float).reshape(-1, 2)}) for room in header["rooms"])
    if "landmarks" in arrays:
        arrays["landmarks"] = Landmarks(arrays["landmarks"], *map(tuple, header["strings"]))
    return replace(Piece(**arrays), rooms=rooms, warnings=tuple(header["warnings"]), done=header["done"])


def _receive_array(stream: IO[bytes], kind: Any, shape: list[int]) -> Array:
    data = stream.read(int(np.prod(shape)) * np.dtype(kind).itemsize)
    if len(data) < int(np.prod(shape)) * np.dtype(kind).itemsize:
        raise EOFError
    return np.frombuffer(data, kind).reshape(shape)


def main() -> None:
    """Run the child; what it is to do stands behind its name."""
    module, path, options, seconds, room = json.loads(sys.argv[1])
    reader = importlib.import_module(f"topomerge.io.{module}")
    limit(room=room)
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)  # what a library prints is no piece
        for header, arrays in _iter_messages(reader, Path(path), options, seconds):
            out.write(json.dumps(header).encode() + b"\n")
            for array in arrays:
                out.write(array.data)
            out.flush()


def _iter_messages(
    reader: Any, path: Path, options: Mapping[str, Any], seconds: int | None
) -> Iterator[tuple[dict[str, Any], list[Array]]]:
    try:
        limit(seconds=seconds)
        if "task" in options:
            yield {"value": reader.compute_in_process(options["task"])}, []
            return
        for piece in reader.read_in_process(path, ReadOptions(**options)):
            marks = piece.landmarks
            arrays: dict[str, Any] = {name: getattr(piece, name) for name in ARRAYS}
            arrays["landmarks"] = None if marks is None else marks.table
            given = {name: np.ascontiguousarray(v, ARRAYS[name]) for name, v in arrays.items() if v is not None}
            rooms = [{**vars(room), "polygon": np.asarray(room.polygon).tolist()} for room in piece.rooms]
            header = {"arrays": {name: v.shape for name, v in given.items()}, "rooms": rooms}
            header["strings"] = [] if marks is None else [marks.values, marks.sources]
            yield {**header, "warnings": piece.warnings, "done": piece.done}, list(given.values())
            limit(seconds=seconds)
    except InputError as error:
        yield {"refused": str(error)}, []
    except MemoryError:
        yield {"refused": f"{path}: does not fit into memory; use a machine with more, or thin the file"}, []
    except Exception as error:
        if is_memory_short(error):
            yield {"refused": f"{path}: does not fit into memory; use a machine with more, or thin the file"}, []
            return
        yield {"fault": f"{error}" or type(error).__name__}, []
    else:
        yield {"end": True}, []


def limit(seconds: int | None = None, room: int | None = None) -> None:
    """Limit this process to so many more seconds of the processor, and bytes of memory; nothing on Windows."""
    try:
        import resource
    except ImportError:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    requested = []
    if seconds is not None:
        requested.append((resource.RLIMIT_CPU, int(used.ru_utime + used.ru_stime) + 1 + seconds))
    size = Path("/proc/self/statm")
    if room is not None and size.exists():  # elsewhere the limit of the address space does nothing
        requested.append((resource.RLIMIT_AS, int(size.read_text().split()[0]) * resource.getpagesize() + room))
    for what, value in requested:
        _, hard = resource.getrlimit(what)
        resource.setrlimit(what, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
