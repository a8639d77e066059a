"""Many maps and where they lie -> one map: cells are fused one map after the other, rooms and doors found once, at the end."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from topomerge.extraction.convolution import convolve, moore
from topomerge.extraction.extract import PRESETS, extract
from topomerge.fusion.fuse import Fused, fuse
from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, STOREY_DTYPE, Sim3, TopometricMap, VoxelGrid


def join_many(maps: Iterable[TopometricMap], poses: Sequence[Sim3]) -> TopometricMap:
    """The joined map in the frame of the first one.

    Args:
        maps: two or more; only one at a time is held beside what is joined so far.
        poses: T_0k; the first is the identity.

    Raises:
        InputError: more maps than provenance can tell apart.
    """
    whole: TopometricMap | None = None
    usual, names = [], []
    for m, pose in zip(maps, poses, strict=True):
        usual.append(_usual(m.grid))
        names.append(m.source or "map")
        whole = m if whole is None else _bare(fuse(whole, m, pose))
    assert whole is not None
    noise = PRESETS["default"].noise * min(min(usual) / max(_usual(whole.grid), 1.0), 1.0)  # as `fuse._noise`, of many
    found = extract(whole.grid, name=" + ".join(names), carve=whole.free is None, noise=noise)
    rows = whole.grid.rows(whole.grid.locate(found.grid.centroids()))
    assert whole.provenance is not None
    provenance = np.where(rows >= 0, whole.provenance[rows], 0).astype(np.uint32)
    return replace(found, provenance=provenance, free=found.free if whole.free is None else whole.free)


def _usual(grid: VoxelGrid) -> float:
    """Median number of occupied neighbours of a cell."""
    return float(np.median(convolve(grid, moore()))) if len(grid) else 0.0


def _bare(fused: Fused) -> TopometricMap:
    """Fused cells as a map without rooms, to be fused with the next."""
    none = np.full(len(fused.grid), -1, np.int32)
    empty = fused.grid.subset(np.zeros(len(fused.grid), bool))
    return TopometricMap(
        grid=fused.grid,
        room=none,
        navigable=empty,
        navigable_room=none[:0],
        rooms=np.zeros(0, ROOM_DTYPE),
        edges=np.zeros(0, EDGE_DTYPE),
        storeys=np.zeros(0, STOREY_DTYPE),
        free=fused.free,
        provenance=fused.provenance,
    )
