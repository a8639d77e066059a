"""Points -> voxel grid (seeds 2.2): one chunk at a time, so that a cloud may be larger than memory."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from numbers import Real

import numpy as np

from topomerge.errors import InputError
from topomerge.extraction.lattice_cells import LatticeCells
from topomerge.extraction.strays import box_volume, largest_place, without_strays
from topomerge.kernels import lookup, morton
from topomerge.types import Array, PointCloud, VoxelGrid

log = logging.getLogger(__name__)


def voxelise(cloud: PointCloud | Array | Iterable[PointCloud], edge: float = 0.1, warnings: list[str] | None = None) -> VoxelGrid:
    """Occupied cells of a point cloud, with the properties ``count``, the number of points in each, and ``offset``, where in it
    they lie on average (`cell_means`).

    V_min is a multiple of the edge length, so the cells of a cloud do not depend on what else is in the file or on its order.

    Args:
        cloud: a cloud, (N, 3) points in metres, or chunks of one cloud.
        edge: edge length of a cell, m.
        warnings: what the user should know is appended here.

    Raises:
        InputError: no finite point, or an extent that no building has.
    """
    if not (isinstance(edge, Real) and 0.001 <= edge <= 10):
        raise InputError(f"voxel size must be a number between 0.001 and 10 (m), not {edge!r}")
    if isinstance(cloud, PointCloud):
        chunks: Iterable[PointCloud] = [cloud]
    elif isinstance(cloud, np.ndarray):
        chunks = [PointCloud(cloud)]
    else:
        chunks = cloud
    lattice = LatticeCells(edge)
    for chunk in chunks:
        lattice.add(chunk)
    cells, counts, sums = lattice.all()
    if not len(cells):
        raise InputError("no finite point: nothing to voxelise")
    for told_apart in (without_strays, largest_place):
        kept, warning = told_apart(cells, counts, edge)
        if warning:
            warn(warnings, warning)
            cells, counts, sums = cells[kept], counts[kept], sums[kept]
    base, shape = _box(cells)
    if (shape > morton.AXIS_LIMIT).any() or box_volume(cells) / 512 > lookup.MAX_BRICKS:
        extent = " x ".join(f"{s * edge:.0f}" for s in shape)
        raise InputError(f"the points span {extent} m: too large for {edge:g} m voxels; check --unit, or crop the file")
    size = (int(shape[0]), int(shape[1]), int(shape[2]))
    offset = (sums + counts[:, None] // 2) // counts[:, None]
    return VoxelGrid.from_cells(cells - base, base * edge, edge, size, {"count": counts, "offset": offset.astype(np.uint8)})


def _box(cells: Array) -> tuple[Array, Array]:
    low = cells.min(axis=0)
    return low, cells.max(axis=0) - low + 1


def warn(warnings: list[str] | None, message: str) -> None:
    """Keep a warning for the map that is being made, or log it where there is none."""
    if warnings is None:
        log.warning("%s", message)
    else:
        warnings.append(message)
