"""What a format reader hands over: pieces of a file, in the file's own frame and unit.

Every format lives in a module of its own with one function ``read(path, options) -> Iterator[Piece]``; `topomerge.io.points`
turns the pieces into point clouds. A reader that meets a fault raises `InputError`; any other exception is turned into one
at the door.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.types import Array, TrueRoom, VoxelGrid

LFS_POINTER = b"version https://git-lfs.github.com/spec/v1"
BLOCK_POINTS = 1 << 19  # points a reader hands over at a time
MOST_POINTS = 100_000_000  # points that a sampled or extruded file may become; more is a wrong unit, not a building


@dataclass(frozen=True)
class Piece:
    """Some of the points of a file. `free` and `rooms` describe the whole file and come with its first piece; `poses` come with
    the first piece whose points need them, and are counted by `pose_of` over all pieces."""

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


def refuse_pointer(path: Path) -> None:
    """Refuse a file that Git LFS put in place of the one that is wanted.

    Raises:
        InputError: it is a pointer of Git LFS.
    """
    with path.open("rb") as stream:
        if stream.read(len(LFS_POINTER)) == LFS_POINTER:
            raise InputError(f"{path}: is a Git LFS pointer, not the file; run `git lfs pull`")


def leads_outside(path: Path) -> bool:
    """Is it a link to a place outside of its folder? What stands there is not for the one who reads a message."""
    return not path.resolve().is_relative_to(path.parent.resolve())


def read_head(path: Path, kind: str, magic: bytes, length: int) -> bytes:
    """The first bytes of a file that must start with `magic`.

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
        raise damaged(path, kind, "its header is cut short")
    return head


def cut_short(path: Path, have: int, promised: int, what: str = "points") -> InputError:
    """The error for a file that ends before what its header promises."""
    return InputError(
        f"{path}: holds {have:,} of the {promised:,} {what} that its header promises; the file is cut short, copy it again"
    )


def damaged(path: Path, kind: str, reason: object) -> InputError:
    """The error for a file that is not what its name says. Of a link to another place nothing is quoted."""
    text = " ".join(str(reason).split())[:160] or type(reason).__name__
    if leads_outside(path):
        text = "it is a link out of its folder, so nothing of it is shown"
    return InputError(f"{path}: damaged, or not {kind} ({text}); export it again")


def too_many(path: Path, count: float, spacing: float) -> InputError:
    """The error for a surface that would become an absurd number of points."""
    return InputError(
        f"{path}: would become {count:.1e} points at a spacing of {spacing:g} m; check --unit, or give a larger --spacing"
    )


def single(values: Array) -> Array:
    """The values as float32; what is beyond its reach is infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(np.float32)


def bytes8(colors: Array) -> Array:
    """(n, 3) uint8 colours from bytes, 16-bit integers or floats in 0..1 or 0..255."""
    if colors.dtype == np.uint8 or not len(colors):
        return np.ascontiguousarray(colors, np.uint8)
    values = np.nan_to_num(single(colors), nan=0.0, posinf=0.0, neginf=0.0)
    top = float(values.max())
    if np.issubdtype(colors.dtype, np.floating) and top <= 1.0:
        values = values * 255.0
    elif top > 255.0:
        values = values / 257.0
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
