"""Shifts in the plane on a lattice: what bends one storey of a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from topomerge.kernels.bend import interpolated
from topomerge.types import Array

INVERSE_ROUNDS = 30
INVERSE_STEP = 1e-9  # m, a smaller correction ends the search for the place that is moved to a point


@dataclass(frozen=True, eq=False)
class ShiftField:
    """Shifts at the nodes of a square lattice, bilinear between them, constant beyond: continuous, so that no wall is torn.

    Args:
        origin: (2,) m, node (0, 0).
        step: m between nodes.
        shifts: (nx, ny, 2) m, at least two nodes along each axis.
    """

    origin: Array
    step: float
    shifts: Array

    def at(self, points: Array) -> Array:
        """(n, 2) m by which the points (n, 2) are moved."""
        out: Array = interpolated(np.asarray(points, np.float64), self.origin, self.step, np.asarray(self.shifts, np.float64))
        return out

    def apply(self, points: Array) -> Array:
        """The points (n, 2), moved."""
        return np.asarray(points, np.float64) + self.at(points)

    @property
    def growth(self) -> tuple[float, float]:
        """Least and greatest factor by which a small area is changed: the determinant of the Jacobian, exact within the cells of
        the lattice up to its bilinear term (it is taken at their corners, where it is extreme). Not above 0: space is folded."""
        s = self.shifts / self.step
        du, dv = np.diff(s, axis=0), np.diff(s, axis=1)
        dets = []
        for du_side in (du[:, :-1], du[:, 1:]):
            for dv_side in (dv[:-1], dv[1:]):
                dets.append((1 + du_side[..., 0]) * (1 + dv_side[..., 1]) - du_side[..., 1] * dv_side[..., 0])
        both = np.stack(dets)
        return float(both.min()), float(both.max())
