"""Points -> voxel grid (seeds 2.2): one chunk at a time, so that a cloud may be larger than memory."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from numbers import Real

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.extraction.lattice_cells import LatticeCells
from topomerge.kernels import lookup, morton
from topomerge.types import Array, PointCloud, VoxelGrid

log = logging.getLogger(__name__)

# A group of points is a stray when it lies this far (m) from every larger group and holds less than this share of the cells.
STRAY_DISTANCE = 10.0
STRAY_SHARE = 0.01
STRAY_TOTAL_SHARE = 0.05  # of all cells may be strays
LARGE_VOLUME = 2e8  # cells: 200 x 200 x 5 m at 0.1 m; smaller grids cost little whatever is in them


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
    base, shape = _box(cells)
    if _volume(shape) > LARGE_VOLUME:
        connected = _without_strays(cells, edge)
        # Nothing is dropped unless that makes the grid much smaller: a wing that was scanned thinly is no stray. And where
        # much would go, the points are not strays: the unit is wrong.
        if _volume(_box(cells[connected])[1]) < _volume(shape) / 4 and connected.mean() > 1 - STRAY_TOTAL_SHARE:
            dropped = int(counts[~connected].sum())
            said = "1 stray point lies" if dropped == 1 else f"{dropped} stray points lie"
            warn(warnings, f"{said} more than {STRAY_DISTANCE:g} m from the rest: left out")
            cells, counts, sums = cells[connected], counts[connected], sums[connected]
            base, shape = _box(cells)
    if (shape > morton.AXIS_LIMIT).any() or _volume(shape) / 512 > lookup.MAX_BRICKS:
        extent = " x ".join(f"{s * edge:.0f}" for s in shape)
        raise InputError(f"the points span {extent} m: too large for {edge:g} m voxels; check --unit, or crop the file")
    size = (int(shape[0]), int(shape[1]), int(shape[2]))
    offset = (sums + counts[:, None] // 2) // counts[:, None]
    return VoxelGrid.from_cells(cells - base, base * edge, edge, size, {"count": counts, "offset": offset.astype(np.uint8)})


def _box(cells: Array) -> tuple[Array, Array]:
    low = cells.min(axis=0)
    return low, cells.max(axis=0) - low + 1


def _volume(shape: Array) -> float:
    """Cells of a box of whole bricks: what the lookup table has to cover."""
    return float(np.prod(((shape + 7) // 8 * 8).astype(np.float64)))


def warn(warnings: list[str] | None, message: str) -> None:
    """Keep a warning for the map that is being made, or log it where there is none."""
    if warnings is None:
        log.warning("%s", message)
    else:
        warnings.append(message)


def _without_strays(cells: Array, edge: float) -> Array:
    """(n,) bool: not in a small group of cells far from the rest. One stray return must not decide the size of the grid."""
    block = max(int(STRAY_DISTANCE / edge), 1)
    keys, of_block = np.unique(cells // block, axis=0, return_inverse=True)
    group = _groups(keys)[of_block.ravel()]
    size = np.bincount(group)
    keep = (size >= STRAY_SHARE * len(cells))[group]
    return keep if keep.any() else group == size.argmax()


def _groups(keys: Array) -> Array:
    """Connected groups of few, widely spread blocks: axes are first squeezed so that gaps cost no memory."""
    squeezed = np.empty_like(keys)
    for axis in range(3):
        values, inverse = np.unique(keys[:, axis], return_inverse=True)
        steps = np.minimum(np.diff(values, prepend=values[0]), 2)
        squeezed[:, axis] = np.cumsum(steps)[inverse.ravel()]
    if np.prod(squeezed.max(axis=0).astype(np.float64) + 1) > 5e8:
        raise InputError("the points are scattered over an extent that no building has: check --unit, or crop the file")
    dense = np.zeros(tuple(squeezed.max(axis=0) + 1), bool)
    dense[tuple(squeezed.T)] = True
    labels, _ = ndimage.label(dense, np.ones((3, 3, 3)))
    return labels[tuple(squeezed.T)] - 1
