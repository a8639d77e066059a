"""Where a map lies in the frame of another one: its pose, and how it is bent before it is posed."""

from __future__ import annotations

from dataclasses import dataclass

from topomerge.types.arrays import Array
from topomerge.types.deformation import Deformation
from topomerge.types.similarity import Sim3

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
