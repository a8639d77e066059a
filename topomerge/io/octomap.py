"""OctoMap: a text header, then an octree, depth first; of two-byte nodes (.bt), or with the log-odds of each node (.ot).

Occupied leaves become points at the centres of their smallest cells, free leaves the cloud's free space.
Source: Hornung et al., "OctoMap", Autonomous Robots 2013, and the format's own header.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io.piece import BLOCK_POINTS, Piece, ReadOptions, build_damage_error
from topomerge.kernels.codecs import FREE_LEAF, LEAF_LEVEL, OCCUPIED_LEAF, read_full_octree_leaves, read_octree_leaves
from topomerge.types import Array, VoxelGrid

MAGICS = {".bt": b"# Octomap OcTree binary file", ".ot": b"# Octomap OcTree file"}
NODE_BYTES = {b"OcTree": 5, b"ColorOcTree": 8}  # of a full tree: log-odds, a colour, which children there are
CENTRE = 1 << (LEAF_LEVEL - 1)  # the cell whose lower corner is the origin of coordinates
LARGEST_CELL = 1e6  # units of the file, of the smallest cell
MOST_OCTOMAP_CELLS = 30_000_000  # smallest cells that leaves may be cut into
TRUSTED_CELLS, CELLS_A_BYTE = 1 << 20, 100  # beyond so many cells, at most so many a byte: a real map has 7


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read occupied cells as points, free cells as free space."""
    del options
    data = path.read_bytes()
    binary = path.suffix.lower() == ".bt"
    kind, resolution, body = _split(path, data, binary)
    leaves = read_octree_leaves(body) if binary else read_full_octree_leaves(body, NODE_BYTES[kind])
    if leaves is None:
        raise build_damage_error(path, "an OctoMap", f"its tree does not end where the file ends, after {len(data):,} bytes")
    keys, depths, states = leaves
    occupied, free = states == OCCUPIED_LEAF, states == FREE_LEAF
    most = min(MOST_OCTOMAP_CELLS, max(TRUSTED_CELLS, CELLS_A_BYTE * len(data)))
    cells = _split_leaves(keys[occupied], depths[occupied], most)
    if cells is None:
        raise InputError(f"{path}: has more than {most:,} occupied cells; store it at a coarser resolution")
    space = _split_leaves(keys[free], depths[free], most)
    warnings = () if space is not None else (f"more than {most:,} free cells: free space is left out",)
    grid = None if space is None else _build_grid(space, resolution)
    yield Piece(np.empty((0, 3)), free=grid, warnings=warnings, done=0.8)
    for start in range(0, len(cells), BLOCK_POINTS):
        yield Piece((cells[start : start + BLOCK_POINTS] - CENTRE + 0.5) * resolution, done=0.9)


def _split(path: Path, data: bytes, binary: bool) -> tuple[bytes, float, Array]:
    """Return the kind of the tree, resolution (m) and the bytes of the nodes."""
    if not data.startswith(MAGICS[".bt" if binary else ".ot"]):
        what, writer = ("a binary OctoMap (.bt)", "writeBinary") if binary else ("a full OctoMap (.ot)", "write")
        raise InputError(f"{path}: is not {what}; write it with octomap's {writer}")
    header = re.match(rb"(?s)(.{0,10000}?\n)data\r?\n", data)
    if header is None:
        raise build_damage_error(path, "an OctoMap", "its header has no end")
    values = dict(line.split(None, 1) for line in header[1].splitlines() if len(line.split(None, 1)) == 2)
    try:
        kind, resolution = values[b"id"].strip(), float(values[b"res"])
    except (KeyError, ValueError) as error:
        raise build_damage_error(path, "an OctoMap", "its header has no id or no res") from error
    able = [b"OcTree"] if binary else list(NODE_BYTES)
    if kind not in able:
        names = " and ".join(name.decode() for name in able)
        raise InputError(f"{path}: holds a tree of the kind {kind[:40].decode('latin-1')}; only {names} is read")
    if not 0 < resolution <= LARGEST_CELL:
        raise build_damage_error(path, "an OctoMap", f"res {resolution}")
    return kind, resolution, np.frombuffer(data, np.uint8, offset=header.end())


def _split_leaves(keys: Array, depths: Array, most: int) -> Array | None:
    """Return (n, 3) int32 smallest cells of leaves; None where they are too many."""
    sides = 1 << (LEAF_LEVEL - depths.astype(np.int64))
    if (sides**3).sum() > most:
        return None
    parts = []
    for side in np.unique(sides):
        offsets = np.indices((side, side, side), np.int32).reshape(3, -1).T
        parts.append((keys[sides == side][:, None, :] + offsets).reshape(-1, 3))
    return np.concatenate(parts) if parts else np.empty((0, 3), np.int32)


def _build_grid(cells: Array, resolution: float) -> VoxelGrid | None:
    if not len(cells):
        return None
    low = cells.min(axis=0)
    return VoxelGrid.from_cells(cells - low, (low - CENTRE) * resolution, resolution)
