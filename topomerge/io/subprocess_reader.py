"""A reader in a process of its own, for libraries that can end the process that they run in, or never come back.

The child hands over its pieces on a pipe: a line of JSON, then the arrays as they lie in memory. Nothing is unpickled.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from topomerge.errors import InputError, is_memory_short
from topomerge.io.options import ReadOptions
from topomerge.io.piece import Piece, damaged
from topomerge.types import Array, TrueRoom

ARRAYS = {  # of a piece
    "points": np.float64, "colors": np.uint8, "poses": np.float64, "pose_of": np.int32, "intensities": np.float32,
}  # fmt: skip


def read_in_subprocess(
    module: str, kind: str, path: Path, options: ReadOptions, seconds: int | None = None, room: int | None = None
) -> Iterator[Piece]:
    """What ``module.read_in_process(path, options)`` yields, labels and free space left out.

    Args:
        module: of `topomerge.io`.
        kind: what the file should be, for messages.
        seconds: of the processor that the reader may take for one piece; None: any.
        room: bytes that it may take beyond what it needs to start; None: any.

    Raises:
        InputError: as the reader; or the child came to an end before it was done.
    """
    task = json.dumps([module, str(path), asdict(options), seconds, room])
    words = [sys.executable, "-c", f"from {__name__} import main; main()", task]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    child = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL, env=environment)
    assert child.stdout is not None
    try:
        while (piece := _piece(path, kind, child.stdout)) is not None:
            yield piece
    except EOFError:
        late = child.wait() == -signal.SIGXCPU
        why = f"more than {seconds} s for a small part of it" if late else "the library that reads it broke down"
        raise damaged(path, kind, why) from None
    finally:
        child.kill()
        child.communicate()


def _piece(path: Path, kind: str, stream: IO[bytes]) -> Piece | None:
    """The next piece, None after the last; an EOFError where the child is no more."""
    line = stream.readline()
    if not line.endswith(b"\n"):
        raise EOFError
    header = json.loads(line)
    if "end" in header:
        return None
    if "refused" in header:
        raise InputError(header["refused"])
    if "fault" in header:
        raise damaged(path, kind, header["fault"])
    arrays: dict[str, Any] = {name: _array(stream, ARRAYS[name], shape) for name, shape in header["arrays"].items()}
    rooms = tuple(TrueRoom(**{**room, "polygon": np.array(room["polygon"], float).reshape(-1, 2)}) for room in header["rooms"])
    return replace(Piece(**arrays), rooms=rooms, warnings=tuple(header["warnings"]), done=header["done"])


def _array(stream: IO[bytes], kind: Any, shape: list[int]) -> Array:
    data = stream.read(int(np.prod(shape)) * np.dtype(kind).itemsize)
    if len(data) < int(np.prod(shape)) * np.dtype(kind).itemsize:
        raise EOFError
    return np.frombuffer(data, kind).reshape(shape)


def main() -> None:
    """The child: what it is to do stands behind its name."""
    module, path, options, seconds, room = json.loads(sys.argv[1])
    reader = importlib.import_module(f"topomerge.io.{module}")
    limit(room=room)
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)  # what a library prints is no piece
        for header, arrays in _messages(reader, Path(path), ReadOptions(**options), seconds):
            out.write(json.dumps(header).encode() + b"\n")
            for array in arrays:
                out.write(array.data)
            out.flush()


def _messages(reader: Any, path: Path, options: ReadOptions, seconds: int | None) -> Iterator[tuple[dict[str, Any], list[Array]]]:
    try:
        limit(seconds=seconds)
        for piece in reader.read_in_process(path, options):
            arrays = {name: getattr(piece, name) for name in ARRAYS}
            given = {name: np.ascontiguousarray(v, ARRAYS[name]) for name, v in arrays.items() if v is not None}
            rooms = [{**vars(room), "polygon": np.asarray(room.polygon).tolist()} for room in piece.rooms]
            header = {"arrays": {name: v.shape for name, v in given.items()}, "rooms": rooms}
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
    """From now on this process may take so many more seconds of the processor, and bytes of memory; nothing on Windows."""
    try:
        import resource
    except ImportError:
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    wanted = []
    if seconds is not None:
        wanted.append((resource.RLIMIT_CPU, int(used.ru_utime + used.ru_stime) + 1 + seconds))
    size = Path("/proc/self/statm")
    if room is not None and size.exists():  # elsewhere the limit of the address space does nothing
        wanted.append((resource.RLIMIT_AS, int(size.read_text().split()[0]) * resource.getpagesize() + room))
    for what, value in wanted:
        _, hard = resource.getrlimit(what)
        resource.setrlimit(what, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
