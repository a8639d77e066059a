"""What is true about a map that was joined of two: rooms that either saw, and the way of each place back to where it truly is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from topomerge.datasets.simulation.floor_truth import NOT_JUDGED, Truth

from topomerge.types import Array, Sim3


def joined_truth(a: Truth, b: Truth, transform: Sim3, lay: tuple[Callable[[Array], Array], Callable[[Array], Array]]) -> Truth:
    """What is true about the joined map, in the frame of a.

    A place of the joined map is moved to where it truly is as the nearest place of either map is: drift that merging has left
    does not count against the rooms of a single map, and counts no more against those of the joined one.

    Args:
        a, b: about the two maps, each in its own frame and with anchors.
        transform: true T_ab.
        lay: where the points (n, 3) of a and of b lie in the joined map.
    """
    anchors = [move(t.anchors) for move, t in zip(lay, (a, b), strict=True)]
    right = [a.anchors + a.drift, transform.apply(b.anchors + b.drift)]
    return replace(
        a,
        raster=np.where(a.raster != NOT_JUDGED, a.raster, b.raster),
        visited=a.visited | b.visited,
        anchors=np.concatenate(anchors),
        drift=np.concatenate([there - here for there, here in zip(right, anchors, strict=True)]),
    )
