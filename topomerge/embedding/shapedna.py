"""ShapeDNA: the smallest eigenvalues of a room's Laplacian (seeds 3.1.2; method 3; Reuter et al. 2006)."""

from __future__ import annotations

import numpy as np

from topomerge.embedding.laplacian import graph_laplacian, smallest_eigenvalues, surface_laplacian
from topomerge.embedding.room_cells import Descriptor, room_cells
from topomerge.errors import InputError
from topomerge.types import Array, TopometricMap

LAPLACIANS = ("surface", "graph")
NORMALISATIONS = ("weyl", "first", "none")
SHAPE_LEAST_CELLS = 8  # cells: fewer have no shape


def shapedna(
    laplacian: str = "surface", values: int = 32, normalise: str = "weyl", spacing: float = 0.25, largest: int = 5000
) -> Descriptor:
    """The descriptor: (R, values) float64, ascending in each row.

    Args:
        laplacian: ``"graph"``: of the 6-neighbourhood of the cells (thesis: 256 values); ``"surface"``: of the surface that the
            cells lie on, which depends less on how they were sampled.
        values: how many; a room with fewer cells gets the rest by Weyl's law.
        normalise: ``"weyl"``: by the slope of value over number, so that size falls out; ``"first"``: by the first one;
            ``"none"``: 1/m2 of the surface, no unit of the graph.
        spacing: m; the surface is described by one point in each cube of this size, so that walls two cells thick are one.
        largest: cells of the graph, or points of the surface; of more, coarser ones are taken: the time grows faster than their
            number, and the smallest eigenvalues hardly change.

    Raises:
        InputError: an option is unknown, or below its least value.
    """
    if laplacian not in LAPLACIANS:
        raise InputError(f"Laplacian {laplacian!r}: {', '.join(LAPLACIANS)} are possible")
    if normalise not in NORMALISATIONS:
        raise InputError(f"normalisation {normalise!r}: {', '.join(NORMALISATIONS)} are possible")
    if values < 1 or not spacing > 0 or largest < 100:
        raise InputError(f"ShapeDNA needs 1 value or more, spacing above 0 and 100 cells, not {values}, {spacing} and {largest}")

    def describe(map: TopometricMap) -> Array:
        out = np.zeros((len(map.rooms), values))
        for room, cells in enumerate(room_cells(map)):
            if len(cells) >= SHAPE_LEAST_CELLS:
                out[room] = spectrum(cells, map.grid.edge, laplacian, values, spacing, largest)
        return normalised(out, normalise)

    return describe


def spectrum(cells: Array, edge: float, laplacian: str, values: int, spacing: float, largest: int) -> Array:
    """(values,) smallest eigenvalues above 0 of one room's cells (n, 3); the last ones by Weyl's law if there are too few."""
    if laplacian == "graph":
        while len(cells) > largest:
            halved = cells // 2
            cells = halved[_firsts(halved)[0]]
        eigenvalues = smallest_eigenvalues(graph_laplacian(cells), values)
    else:
        points = thinned((cells + 0.5) * edge, spacing)
        while len(points) > largest:
            spacing *= max(float(np.sqrt(len(points) / largest)), 1.05)
            points = thinned((cells + 0.5) * edge, spacing)
        eigenvalues = smallest_eigenvalues(surface_laplacian(points), values)
    if not len(eigenvalues):
        return np.zeros(values)
    number = np.arange(1, values + 1)
    slope = _slope(eigenvalues[None])[0]
    return np.concatenate([eigenvalues, np.maximum(slope * number[len(eigenvalues) :], eigenvalues[-1])])


def thinned(points: Array, spacing: float) -> Array:
    """Middle of the points (n, 3) in each cube of a grid that is laid over them; all points if hardly any would be left."""
    cube = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    first, of = _firsts(cube)
    if len(first) < SHAPE_LEAST_CELLS:
        return points
    sums = np.stack([np.bincount(of, points[:, a]) for a in range(3)], axis=1)
    return sums / np.bincount(of)[:, None]


def _firsts(cells: Array) -> tuple[Array, Array]:
    """First row of each different cell (n, 3), in the order of x, y, z, and the number of its cell for each row: as `np.unique`
    of rows, which takes ten times as long."""
    low = cells.min(axis=0)
    wide = (np.ptp(cells, axis=0) + 1).astype(np.int64)
    x, y, z = (cells - low).astype(np.int64).T
    _, first, of = np.unique((x * wide[1] + y) * wide[2] + z, return_index=True, return_inverse=True)
    return first, of


def normalised(values: Array, how: str) -> Array:
    """Rows of eigenvalues made independent of size; rows of zeros stay."""
    if how == "none":
        return values
    unit = values[:, 0] if how == "first" else _slope(values)
    return values / np.where(unit > 0, unit, 1.0)[:, None]


def _slope(values: Array) -> Array:
    """Slope of the line through the origin that fits value over number: on a surface 4 pi / area, by Weyl's law."""
    number = np.arange(1, values.shape[1] + 1)
    return (values @ number) / (number @ number)
