"""Ends of walls are brought together: at corners, where one ends at another, and where two go on in one line."""

from __future__ import annotations

import numpy as np
import shapely

from topomerge.types import Array

JOINT_REACH = 0.7  # m beyond the end of a wall
IN_LINE = np.cos(np.radians(8.0))
CROSSING = np.sin(np.radians(20.0))
THROUGH = 0.1  # m that an end may lie beyond the middle of the wall that it meets
INTO_ROOM = 0.03  # m by which a wall may reach into a room where it is lengthened


def joined(walls: Array, rooms: shapely.Geometry) -> Array:
    """The walls with each end at the middle of the wall that it meets; at a corner, both cover it.

    Args:
        walls: WALL_DTYPE of one storey.
        rooms: the outlines of the rooms, m: no wall is lengthened into them.
    """
    out = walls.copy()
    tree = shapely.STRtree([shapely.LineString([w["start"], w["end"]]) for w in walls])
    inner = rooms.buffer(-INTO_ROOM)
    for i, wall in enumerate(walls):
        for name, other in (("start", "end"), ("end", "start")):
            tip, way = wall[name], wall[name] - wall[other]
            length = float(np.hypot(*way))
            if length < 1e-6:
                continue
            way = way / length
            near = tree.query(shapely.Point(tip), predicate="dwithin", distance=2 * JOINT_REACH)
            more = _more(tip, way, float(wall["thickness"]), walls[near[near != i]])
            if more is not None and more > -length / 2:
                new = tip + way * more
                if more < 0 or not _inside(inner, tip, new, way, float(wall["thickness"])):
                    out[name][i] = new
    return out


def _inside(rooms: shapely.Geometry, tip: Array, new: Array, way: Array, thickness: float) -> bool:
    """Would the longer part of a wall stand in a room?"""
    part = shapely.LineString([tip, new]).buffer(max(thickness / 2 - 0.01, 0.01), cap_style="flat")
    return bool(shapely.area(shapely.intersection(part, rooms)) > 0.1 * max(part.area, 1e-9))


def _more(tip: Array, way: Array, thickness: float, others: Array) -> float | None:
    """m by which a wall that ends at `tip`, going `way`, is lengthened; None: it meets nothing."""
    best: float | None = None
    for other in others:
        line = other["end"] - other["start"]
        length = float(np.hypot(*line))
        if length < 1e-6:
            continue
        line = line / length
        turn = way[0] * line[1] - way[1] * line[0]
        if abs(way @ line) > IN_LINE:
            starts = [other["start"], other["end"]]
            ahead = [float((p - tip) @ way) for p in starts]
            off = min(abs(float((p - tip) @ (-way[1], way[0]))) for p in starts)
            if off < (thickness + other["thickness"]) / 2 and 0 <= min(ahead) <= JOINT_REACH:
                return min(ahead) / 2
        elif abs(turn) > CROSSING:
            apart = other["start"] - tip
            more = float(apart[0] * line[1] - apart[1] * line[0]) / turn
            place = float((tip + way * more - other["start"]) @ line)
            if not -THROUGH <= more <= JOINT_REACH or not -JOINT_REACH <= place <= length + JOINT_REACH:
                continue
            corner = place < thickness or place > length - thickness
            more += other["thickness"] / 2 if corner else 0.0
            best = more if best is None or abs(more) < abs(best) else best
    return best
