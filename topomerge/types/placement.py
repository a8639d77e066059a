"""Where a map lies in another's frame: a pose, and a deformation where the map has drifted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.types.grid import Array, Sim3

INVERSE_ROUNDS = 30
INVERSE_STEP = 1e-9  # m, a smaller correction ends the search for the place that is moved to a point
BLENDED_PIECES = 24  # nearest ones that have a say in the move of a place; the weight of others is nil
LATTICE_STEPS = 6.0  # nodes of the lattice within the reach of a piece
MOST_NODES = 2000  # of the lattice along an axis
MARGIN = 2.0  # times the reach, of the lattice around the middles of the pieces
BETWEEN_STOREYS = 0.3  # m: below a floor by less, a point belongs to the storey above; moves are blended over as much again
PIECE_LIMIT, FARTHEST_ANCHOR = 200_000, 1e9  # pieces that a file may declare, and m from the origin


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
        """Return (n, 2) m by which the points (n, 2) are moved."""
        from topomerge.kernels.bend import interpolate_nodes

        out: Array = interpolate_nodes(
            np.ascontiguousarray(points, np.float64), self.origin, self.step, np.ascontiguousarray(self.shifts, np.float64)
        )
        return out

    def apply(self, points: Array) -> Array:
        """Return the points (n, 2), moved."""
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


@dataclass(frozen=True, eq=False)
class Deformation:
    """Moves of the pieces of a map, in its own frame. Heights stay.

    Args:
        anchors: (n, 2) float64 m, the middle of each piece.
        storey: (n,) int, of each piece.
        floors: (S,) m, height of the floor of each storey, ascending.
        moves: (n, 4) float64: shift x, y in m, turn in rad and logarithm of the scale, about the anchor.
        covariance: (n, 3, 3) of shift and turn, m and rad; nan where nothing says how sure they are.
        room: (n,) int32, the room that a piece is of or in, -1 none.
        reach: m, over which the moves of neighbouring pieces are blended (standard deviation of their weights).
    """

    anchors: Array
    storey: Array
    floors: Array
    moves: Array
    covariance: Array
    room: Array
    reach: float

    def __len__(self) -> int:
        return len(self.anchors)

    @cached_property
    def fields(self) -> tuple[ShiftField | None, ...]:
        """The shifts of each storey; None of one without pieces."""
        return tuple(self._field(self.storey == s) for s in range(len(self.floors)))

    def _field(self, chosen: Array) -> ShiftField | None:
        anchors, moves = self.anchors[chosen], self.moves[chosen]
        if not len(anchors):
            return None
        wide = float(np.ptp(anchors, axis=0).max()) + 2 * MARGIN * self.reach
        step = max(self.reach / LATTICE_STEPS, wide / MOST_NODES)
        low = anchors.min(axis=0) - MARGIN * self.reach
        shape = np.maximum(np.ceil((np.ptp(anchors, axis=0) + 2 * MARGIN * self.reach) / step).astype(int) + 1, 2)
        nodes = low + step * np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 2)
        return ShiftField(low, step, blended(nodes, anchors, moves, self.reach).reshape(*shape, 2))

    def storey_at(self, heights: Array) -> Array:
        """Return (n,) storey of each height, m: the last one whose floor is not above it."""
        out: Array = np.clip(np.searchsorted(self.floors - BETWEEN_STOREYS, heights, side="right") - 1, 0, None)
        return out

    def apply(self, points: Array) -> Array:
        """Return the points (n, 3), bent."""
        points = np.asarray(points, np.float64)
        if not len(self) or not len(points):
            return points.copy()
        out = points.copy()
        out[:, :2] += self._shifts(points)
        return out

    def _shifts(self, points: Array) -> Array:
        """Return (n, 2) m. Over the last decimetres below a floor the moves of two storeys are blended: pipes and walls go
        through."""
        if len(self.fields) == 1:
            only = self.fields[0]
            return np.zeros((len(points), 2)) if only is None else only.at(points[:, :2])
        own = self.storey_at(points[:, 2])
        below = np.maximum(own - 1, 0)
        above = points[:, 2] - self.floors[own] + BETWEEN_STOREYS  # m above the border between the two storeys
        weight = np.where(own > 0, np.clip(above / BETWEEN_STOREYS, 0, 1), 1.0)
        shifts = np.zeros((len(points), 2))
        for s, field in enumerate(self.fields):
            share = np.where(own == s, weight, 0.0) + np.where((below == s) & (own > 0), 1 - weight, 0.0)
            rows = np.flatnonzero(share > 0)
            if field is not None and len(rows):
                shifts[rows] += share[rows, None] * field.at(points[rows, :2])
        return shifts

    def undo(self, points: Array) -> Array:
        """Return the places (n, 3) that are bent to the given points (n, 3)."""
        points = np.asarray(points, np.float64)
        places = points.copy()
        for _ in range(INVERSE_ROUNDS):
            step = points - self.apply(places)
            places += step
            if not len(step) or np.abs(step).max() < INVERSE_STEP:
                break
        return places

    @property
    def farthest(self) -> float:
        """m by which bending moves a place of the map at most."""
        return max(float(np.linalg.norm(f.shifts, axis=-1).max()) for f in self.fields if f is not None)

    @property
    def least_growth(self) -> float:
        """The least factor by which a small area is changed; not above 0 where space is folded."""
        return min((f.growth[0] for f in self.fields if f is not None), default=1.0)

    def to_json(self) -> dict[str, Any]:
        """Return plain values, none rounded."""
        return {
            "floors_m": self.floors.tolist(),
            "reach_m": float(self.reach),
            "pieces": [
                {
                    "anchor": self.anchors[k].tolist(),
                    "storey": int(self.storey[k]),
                    "room": int(self.room[k]),
                    "shift_m": self.moves[k, :2].tolist(),
                    "turn_rad": float(self.moves[k, 2]),
                    "log_scale": float(self.moves[k, 3]),
                    "covariance": self.covariance[k].tolist() if np.isfinite(self.covariance[k]).all() else None,
                }
                for k in range(len(self))
            ],
        }

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> Deformation:
        """Build a deformation from what `to_json` gave.

        Raises:
            InputError: something else, or a deformation that folds space.
        """
        try:
            pieces: Sequence[Mapping[str, Any]] = values["pieces"]
            if len(pieces) > PIECE_LIMIT:
                raise ValueError(f"{len(pieces)} pieces")
            unsure = np.full((3, 3), np.nan)
            out = Deformation(
                np.array([p["anchor"] for p in pieces], np.float64).reshape(-1, 2),
                np.array([p["storey"] for p in pieces], np.int64),
                np.array(values["floors_m"], np.float64).reshape(-1),
                np.array([[*p["shift_m"], p["turn_rad"], p["log_scale"]] for p in pieces], np.float64).reshape(-1, 4),
                np.array([unsure if p["covariance"] is None else p["covariance"] for p in pieces], np.float64).reshape(-1, 3, 3),
                np.array([p["room"] for p in pieces], np.int32),
                float(values["reach_m"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"damaged bending ({' '.join(str(error).split())[:100]}); merge the maps again") from error
        if not out._sound():
            raise InputError("damaged bending (its moves fold space, or are none); merge the maps again")
        return out

    def _sound(self) -> bool:
        numbers = (self.anchors, self.moves, self.floors, np.array([self.reach]))
        finite = all(np.isfinite(x).all() for x in numbers) and 0.01 <= self.reach <= 1000
        stays = not len(self) or bool(self.storey.min() >= 0 and self.storey.max() < len(self.floors))
        near = finite and np.abs(self.anchors).max(initial=0) <= FARTHEST_ANCHOR
        return near and stays and self.least_growth > 0


def blended(points: Array, anchors: Array, moves: Array, reach: float) -> Array:
    """Return (n, 2) m: shifts of points (n, 2) by the moves (k, 4) of pieces about their anchors (k, 2), weighed by their
    nearness."""
    many = min(BLENDED_PIECES, len(anchors))
    from scipy.spatial import cKDTree  # here: SciPy takes a quarter of a second, and only bent maps need it

    from topomerge.kernels.bend import blend_moves

    distance, nearest = cKDTree(anchors).query(points, many)
    distance, nearest = distance.reshape(len(points), many), nearest.reshape(len(points), many)
    out: Array = blend_moves(points, distance, nearest, anchors, moves, reach)
    return out


LEAST_MOVE = 0.2  # of a cell, by which bending must move a place of a map


@dataclass(frozen=True, eq=False)
class Placement:
    """A map in the frame of another one: it is bent in its own frame, then posed.

    Args:
        pose: of the bent map in the other frame.
        bend: None where it is rigid.
    """

    pose: Sim3
    bend: Deformation | None = None

    @staticmethod
    def of(pose: Sim3, bend: Deformation | None, edge: float = 0.0) -> Placement:
        """Place a map; bend it only if the deformation moves anything, or, where cells have an `edge` of so many m, if they can
        tell: resampling thickens walls, and what a stiff map gives way by is less than that."""
        if bend is None or not len(bend) or not bend.moves.any():
            return Placement(pose)
        return Placement(pose, bend if bend.farthest > LEAST_MOVE * edge else None)

    def transform_points(self, points: Array) -> Array:
        """Take points (n, 3) m of the map into the other frame."""
        return self.pose.apply(points if self.bend is None else self.bend.apply(points))

    def invert_points(self, points: Array) -> Array:
        """Take points (n, 3) m of the other frame back into that of the map."""
        own = self.pose.inverse().apply(points)
        return own if self.bend is None else self.bend.undo(own)
