"""From where to where walls stand; what ends well below a ceiling is a partition, or a cupboard and no wall."""

from __future__ import annotations

import numpy as np
import shapely

from topomerge.structure.face_points import FacePoints
from topomerge.structure.floors import room_levels
from topomerge.types import Array, TopometricMap

HEIGHT_REACH = 0.06  # m beside a wall, in which its cells are
HEIGHT_BIN = 0.1  # m along it
CEILING_REACH = 0.25  # m: what is no farther below a ceiling is of it
PARTITION = 0.5  # m below the ceiling: what ends so far below is no wall up to it
DOOR_NEAR = 0.4  # m
LEAST_BINS = 4  # over which a ceiling was seen, to say that a wall ends below


def with_heights(map: TopometricMap, walls: Array, points: FacePoints) -> Array:
    """The walls from the lower floor beside them to the higher ceiling.

    Those over which the ceiling was seen, and nothing between it and their own top, end there; of which one side only was seen,
    these are cupboards and left out, if no door is in them.

    Args:
        walls: WALL_DTYPE of one storey.
        points: of the storey.
    """
    levels, seen = room_levels(map)
    tree = shapely.STRtree(shapely.points(points.at))
    furniture = np.zeros(len(walls), bool)
    for k, wall in enumerate(walls):
        beside = wall["rooms"][wall["rooms"] >= 0]
        wall["low"], wall["high"] = levels[beside, 0].min(), levels[beside, 1].max()
        beside = beside[seen[beside]]
        if len(beside):
            top = _own_top(wall, points, tree, float((levels[beside, 1] - levels[beside, 0]).min()))
            if np.isfinite(top):
                wall["high"], furniture[k] = wall["low"] + top, wall["faces"] == 1 and not _near_door(wall, map)
    return walls[~furniture]


def _near_door(wall: Array, map: TopometricMap) -> bool:
    """Is a door of its rooms in a wall? Cupboards have none."""
    line = shapely.LineString([wall["start"], wall["end"]])
    own = np.isin(map.edges["rooms"], wall["rooms"][wall["rooms"] >= 0]).any(axis=1)
    return bool((shapely.distance(line, shapely.points(map.edges["centre"][own, :2])) < DOOR_NEAR).any())


def _own_top(wall: Array, points: FacePoints, tree: shapely.STRtree, ceiling: float) -> float:
    """m above the floor, where a wall ends below a ceiling that is so high; inf: it does not, or that was not seen."""
    line = shapely.LineString([wall["start"], wall["end"]])
    rows = tree.query(line, predicate="dwithin", distance=wall["thickness"] / 2 + HEIGHT_REACH)
    along = (wall["end"] - wall["start"]) / max(line.length, 1e-9)
    place = ((points.at[rows] - wall["start"]) @ along / HEIGHT_BIN).astype(np.int64)
    place = np.clip(place, 0, int(line.length / HEIGHT_BIN))
    roof = points.height[rows] > ceiling - CEILING_REACH
    covered, top = np.zeros(int(line.length / HEIGHT_BIN) + 1, bool), np.zeros(int(line.length / HEIGHT_BIN) + 1)
    covered[place[roof]] = True
    np.maximum.at(top, place[~roof], points.height[rows][~roof])
    if covered.sum() < max(LEAST_BINS, len(covered) / 2):
        return np.inf
    reached = float(np.quantile(top[covered], 0.8))
    return reached if 0 < reached < ceiling - PARTITION else np.inf
