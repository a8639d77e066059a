"""Where a map lies in the joined one, bent and posed: of points, of each room, and in files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.fusion.bend.deformation import Deformation
from topomerge.types import Array, Sim3, TopometricMap

BEND_PARAMETER = "bend"  # of a joined map: how the maps that it was joined of were bent
ROUNDING = 1e-6  # by which a matrix in a file may miss a similarity that keeps the vertical, times the size of its numbers
AROUND = np.array([(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)]) / 2  # m: places that stand for a room without a floor


@dataclass(frozen=True, eq=False)
class Placement:
    """A map in the frame of the joined map: it is bent in its own frame, then posed.

    Args:
        map: its number.
        source: the file that it came from.
        pose: of the bent map in the joined one.
        bend: None where it is rigid.
    """

    map: int
    source: str
    pose: Sim3
    bend: Deformation | None = None

    def apply(self, points: Array) -> Array:
        """(n, 3) points of the map, in the joined one."""
        return self.pose.apply(points if self.bend is None else self.bend.apply(points))

    def undo(self, points: Array) -> Array:
        """(n, 3) points of the joined map, in this one."""
        own = self.pose.inverse().apply(points)
        return own if self.bend is None else self.bend.undo(own)


@dataclass(frozen=True, eq=False)
class RoomMoves:
    """By how much bending moves each of the R rooms of a map, in the map's own frame.

    Args:
        centre: (R, 2) m, the middle of each room's floor.
        shift: (R, 2) m, of that middle.
        turn: (R,) rad.
        covariance: (R, 3, 3) of shift and turn, m and rad: the mean of those of the room's pieces, which is not below that of
            their mean; nan where nothing says how sure they are.
    """

    centre: Array
    shift: Array
    turn: Array
    covariance: Array


def room_moves(map: TopometricMap, bend: Deformation) -> RoomMoves:
    """The rigid move that fits the bending of each room's floor best (least squares)."""
    count = len(map.rooms)
    inside = map.navigable_room >= 0
    room, places = map.navigable_room[inside], map.navigable.centroids(map.navigable.cells[inside])
    bare = np.setdiff1d(np.arange(count), room)
    room = np.concatenate([room, np.repeat(bare, len(AROUND))])
    places = np.concatenate([places, (map.rooms["centroid"][bare][:, None] + AROUND).reshape(-1, 3)])
    number = np.maximum(np.bincount(room, minlength=count), 1)[:, None]

    def mean(values: Array) -> Array:
        return np.column_stack([np.bincount(room, v, count) for v in values.T]) / number

    before, after = places[:, :2], bend.apply(places)[:, :2]
    centre, there = mean(before), mean(after)
    p, q = before - centre[room], after - there[room]
    dot, cross = mean(np.column_stack([(p * q).sum(axis=1), p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]])).T
    covariance = np.full((count, 3, 3), np.nan)
    for i in np.unique(bend.room[bend.room >= 0]):
        of_room = bend.covariance[bend.room == i]
        of_room = of_room[np.isfinite(of_room).all(axis=(1, 2))]
        if i < count and len(of_room):
            covariance[i] = of_room.mean(axis=0)
    return RoomMoves(centre, there - centre, np.arctan2(cross, dot), covariance)


def bend_to_json(map: TopometricMap, placement: Placement) -> dict[str, Any]:
    """How a map was bent, as plain values: the pieces in its own frame, and each room in the joined one (docs/outputs.md)."""
    assert placement.bend is not None
    moves, pose = room_moves(map, placement.bend), placement.pose
    turning = np.eye(3)
    turning[:2, :2] = pose.matrix[:2, :2]
    shifts = moves.shift @ turning[:2, :2].T
    rooms = []
    for i, turn in enumerate(moves.turn.tolist()):
        about = Sim3(turn).apply(np.array([[*moves.centre[i], 0.0]]))[0]
        x, y = (moves.centre[i] + moves.shift[i] - about[:2]).tolist()
        covariance = turning @ moves.covariance[i] @ turning.T
        rooms.append(
            {
                "room": i,
                "transform": (pose @ Sim3(turn, (x, y, 0.0))).matrix.tolist(),
                "shift_m": shifts[i].tolist(),
                "length_m": float(np.hypot(*shifts[i])),
                "turn_deg": float(np.degrees(turn)),
                "covariance": covariance.tolist() if np.isfinite(covariance).all() else None,
            }
        )
    return {**placement.bend.to_json(), "rooms": rooms}


def with_bends(joined: TopometricMap, placements: Sequence[Placement]) -> TopometricMap:
    """The joined map, that remembers how the maps it was joined of were bent; as it is where all are rigid."""
    bent = [
        {"map": p.map, "source": p.source, "transform": p.pose.matrix.tolist(), "deformation": p.bend.to_json()}
        for p in placements
        if p.bend is not None
    ]
    return replace(joined, parameters={**joined.parameters, BEND_PARAMETER: bent}) if bent else joined


def bends_of(joined: TopometricMap) -> tuple[Placement, ...]:
    """How the maps that a map was joined of were bent: what `with_bends` put there, also after `save_map` and `load_map`.

    Returns:
        One for each bent map; none of a map that was extracted, or joined of rigid ones.

    Raises:
        InputError: something else stands there.
    """
    listed = joined.parameters.get(BEND_PARAMETER, ())
    try:
        if not isinstance(listed, list | tuple):
            raise ValueError("no list")
        return tuple(_placement(entry) for entry in listed)
    except InputError as error:
        raise InputError(f"{joined.source or 'map'}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = " ".join(str(error).split())[:100]
        raise InputError(f"{joined.source or 'map'}: damaged bending ({reason}); merge the maps again") from error


def _placement(entry: Mapping[str, Any]) -> Placement:
    number, source = entry["map"], entry["source"]
    if not isinstance(number, int) or isinstance(number, bool) or number < 0 or not isinstance(source, str):
        raise ValueError(f"map {number!r}")
    pose = similarity(np.array(entry["transform"], np.float64))
    return Placement(number, source, pose, Deformation.from_json(entry["deformation"]))


def similarity(matrix: Array) -> Sim3:
    """The similarity of a (4, 4) matrix.

    Raises:
        ValueError: it is none that keeps the vertical.
    """
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or matrix[2, 2] <= 0:
        raise ValueError("a transform that is none")
    x, y, z = matrix[:3, 3].tolist()
    pose = Sim3(float(np.arctan2(matrix[1, 0], matrix[0, 0])), (x, y, z), float(matrix[2, 2]))
    if not np.allclose(pose.matrix, matrix, rtol=0, atol=ROUNDING * max(pose.scale, 1.0)):
        raise ValueError("a transform that is none")
    return pose


def placements(
    maps: Sequence[TopometricMap], transforms: Mapping[int, Sim3], bends: Mapping[int, Deformation]
) -> list[Placement]:
    """Where each map that has a transform lies, and the first one, ascending.

    Args:
        maps: what was merged.
        transforms: k -> T_0k.
        bends: k -> how map k is bent; rigid ones are left out.
    """
    poses = {0: Sim3(), **transforms}
    bent = {k: bend for k, bend in bends.items() if len(bend)}
    return [Placement(k, maps[k].source, poses[k], bent.get(k)) for k in sorted(poses)]
