"""A reader in a process of its own, for libraries that can end the process that they run in.

The child hands over its pieces on a pipe: a line of JSON, then the points as they lie in memory. Nothing is unpickled.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.piece import Options, Piece, damaged
from topomerge.types import TrueRoom


def read_apart(module: str, kind: str, path: Path, options: Options) -> Iterator[Piece]:
    """What ``module.read_here(path, options)`` yields: points, rooms and warnings.

    Args:
        module: of `topomerge.io`.
        kind: what the file should be, for messages.

    Raises:
        InputError: as the reader; or the child came to an end before it was done.
    """
    words = [sys.executable, "-c", f"from {__name__} import main; main()", module, str(path), json.dumps(asdict(options))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    child = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL, env=environment)
    assert child.stdout is not None
    try:
        while line := child.stdout.readline():
            told = json.loads(line)
            if "end" in told:
                return
            if "refused" in told:
                raise InputError(told["refused"])
            if "fault" in told:
                raise damaged(path, kind, told["fault"])
            yield _piece(told, child.stdout)
        raise damaged(path, kind, "the library that reads it broke down")
    finally:
        child.kill()
        child.communicate()


def _piece(told: dict[str, Any], stream: IO[bytes]) -> Piece:
    points = np.frombuffer(stream.read(24 * told["points"]), np.float64).reshape(-1, 3)
    rooms = tuple(TrueRoom(**{**room, "polygon": np.array(room["polygon"], float).reshape(-1, 2)}) for room in told["rooms"])
    return Piece(points, rooms=rooms, warnings=tuple(told["warnings"]), done=told["done"])


def main() -> None:
    """The child: module, path and options stand behind its name."""
    module, path, options = sys.argv[1:]
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)  # what a library prints is no piece
        for told, points in _told(module, Path(path), Options(**json.loads(options))):
            out.write(json.dumps(told).encode() + b"\n")
            out.write(points)
            out.flush()


def _told(module: str, path: Path, options: Options) -> Iterator[tuple[dict[str, Any], bytes]]:
    try:
        for piece in importlib.import_module(f"topomerge.io.{module}").read_here(path, options):
            points = np.ascontiguousarray(piece.points, np.float64)
            rooms = [{**vars(room), "polygon": np.asarray(room.polygon).tolist()} for room in piece.rooms]
            told = {"points": len(points), "rooms": rooms, "warnings": piece.warnings, "done": piece.done}
            yield told, points.tobytes()
    except InputError as error:
        yield {"refused": str(error)}, b""
    except MemoryError:
        yield {"refused": f"{path}: does not fit into memory; use a machine with more, or thin the file"}, b""
    except Exception as error:
        yield {"fault": f"{error}" or type(error).__name__}, b""
    else:
        yield {"end": True}, b""
