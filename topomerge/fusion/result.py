"""The result of a merge: whether two maps belong together, where, which rooms are the same, and the joined map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from topomerge.archive import convert_to_plain
from topomerge.errors import InputError
from topomerge.fusion.atlas.pairs import serialise_contradiction
from topomerge.fusion.transfer import LANDMARK_PARAMETER
from topomerge.landmarks.evidence import LandmarkEvidence
from topomerge.landmarks.settle import Observation
from topomerge.matching.match import describe_map
from topomerge.registration.pipeline import Registration
from topomerge.registration.places import Places
from topomerge.types import Array, Deformation, Placement, Sim3, TopometricMap, convert_pose_to_files
from topomerge.writers import WRITERS

if TYPE_CHECKING:
    from topomerge.fusion.atlas.result import AtlasResult

BEND_PARAMETER = "bend"  # of a joined map: how the maps that it was joined of were bent
AROUND = np.array([(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)]) / 2  # m: places that stand for a room without a floor
MERGE_FORMAT = 1
MERGE_STEPS = ("read", "extract", "embed", "match", "fuse")


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


def fit_room_moves(map: TopometricMap, bend: Deformation) -> RoomMoves:
    """Return the rigid move that fits the bending of each room's floor best (least squares)."""
    count = len(map.rooms)
    inside = map.navigable_room >= 0
    room, places = map.navigable_room[inside], map.navigable.compute_centroids(map.navigable.cells[inside])
    bare = np.setdiff1d(np.arange(count), room)
    room = np.concatenate([room, np.repeat(bare, len(AROUND))])
    places = np.concatenate([places, (map.rooms["centroid"][bare][:, None] + AROUND).reshape(-1, 3)])
    number = np.maximum(np.bincount(room, minlength=count), 1)[:, None]

    def mean(values: Array) -> Array:
        return np.column_stack([np.bincount(room, v, count) for v in values.T]) / number

    before, after = places[:, :2], bend.apply(places)[:, :2]
    centre, moved_centre = mean(before), mean(after)
    p, q = before - centre[room], after - moved_centre[room]
    dot, cross = mean(np.column_stack([(p * q).sum(axis=1), p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]])).T
    covariance = np.full((count, 3, 3), np.nan)
    for i in np.unique(bend.room[bend.room >= 0]):
        of_room = bend.covariance[bend.room == i]
        of_room = of_room[np.isfinite(of_room).all(axis=(1, 2))]
        if i < count and len(of_room):
            covariance[i] = of_room.mean(axis=0)
    return RoomMoves(centre, moved_centre - centre, np.arctan2(cross, dot), covariance)


def serialise_bend(map: TopometricMap, placement: Placement) -> dict[str, Any]:
    """Serialise how a map was bent: its pieces, and each room in the joined map (docs/outputs.md)."""
    assert placement.bend is not None
    moves, pose = fit_room_moves(map, placement.bend), placement.pose
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


def add_bends(joined: TopometricMap, placements: Mapping[int, Placement], sources: Sequence[str]) -> TopometricMap:
    """Let the joined map remember how the maps it was joined of were bent; as it is where all are rigid.

    Args:
        placements: k -> where map k lies in the joined frame.
        sources: of all maps.
    """
    bent = [
        {"map": k, "source": sources[k], "transform": p.pose.matrix.tolist(), "deformation": p.bend.to_json()}
        for k, p in placements.items()
        if p.bend is not None
    ]
    return replace(joined, parameters={**joined.parameters, BEND_PARAMETER: bent}) if bent else joined


def read_bends(joined: TopometricMap) -> dict[int, Placement]:
    """Read how the maps that a map was joined of were bent: what `add_bends` put there, also after `save_map` and `load_map`.

    Returns:
        One for each bent map, by its number; none of a map that was extracted, or joined of rigid ones.

    Raises:
        InputError: something else stands there.
    """
    listed = joined.parameters.get(BEND_PARAMETER, ())
    try:
        if not isinstance(listed, list | tuple):
            raise ValueError("no list")
        return dict(_parse_placement(entry) for entry in listed)
    except InputError as error:
        raise InputError(f"{joined.source or 'map'}: {error}") from error
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        reason = " ".join(str(error).split())[:100]
        raise InputError(f"{joined.source or 'map'}: damaged bending ({reason}); merge the maps again") from error


def _parse_placement(entry: Mapping[str, Any]) -> tuple[int, Placement]:
    number, source = entry["map"], entry["source"]
    if not isinstance(number, int) or isinstance(number, bool) or number < 0 or not isinstance(source, str):
        raise ValueError(f"map {number!r}")
    pose = Sim3.from_matrix(np.array(entry["transform"], np.float64))
    return number, Placement(pose, Deformation.from_json(entry["deformation"]))


def build_placements(transforms: Mapping[int, Sim3], bends: Mapping[int, Deformation]) -> dict[int, Placement]:
    """Place each map that has a transform, and the first one, ascending.

    Args:
        transforms: k -> T_0k.
        bends: k -> how map k is bent; rigid ones are left out.
    """
    poses = {0: Sim3(), **transforms}
    bent = {k: bend for k, bend in bends.items() if len(bend)}
    return {k: Placement(poses[k], bent.get(k)) for k in sorted(poses)}


@dataclass(frozen=True)
class RoomMatch:
    """A room of one map that is a room of another.

    Args:
        maps: which maps, by their place in the list that was merged.
        rooms: one room of each.
        probability: that they are one (of the merge, times `odds.compute_match_probability`).
    """

    maps: tuple[int, int]
    rooms: tuple[int, int]
    probability: float


@dataclass(frozen=True, eq=False)
class MergeResult:
    """The result of `merge`.

    Args:
        status: "merged" or "abstained".
        probability: that the best transform is right, calibrated on simulated pairs.
        reason: in words.
        transforms: k -> T_0k, which maps points of map k into the frame of map 0; empty where nothing is believed. Of files that
            were tilted see `file_transforms`.
        matches: rooms that are one under the transforms.
        seconds: of ``embed``, ``match`` and ``fuse`` (registration, fusing, extracting rooms again); ``read`` and ``extract``
            are 0 where the maps were made before.
        map: the joined map with the provenance of its cells (bit k: map k saw it), or None.
        maps: what was merged.
        registration: the evidence, of two maps.
        atlas: the evidence, of more than two.
        warnings: what the user should know.
        descriptor: of the rooms, by which they were matched where walls were not believed.
        bends: k -> how map k is bent in its own frame, before its transform is applied; rigid ones are left out.
        points: k -> name of the file beside merge.json that holds the points of map k, of those that `merge --points` wrote.
        settle: of two maps of which not everything is sure, what to look at next, the best first.
        decided: what somebody decided: maps i < j -> the pose that was fixed, or None where they do not belong together.
    """

    status: str
    probability: float
    reason: str
    transforms: Mapping[int, Sim3] = field(default_factory=dict)
    matches: tuple[RoomMatch, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    map: TopometricMap | None = None
    maps: tuple[TopometricMap, ...] = ()
    registration: Registration | None = None
    atlas: AtlasResult | None = None
    warnings: tuple[str, ...] = ()
    descriptor: str = ""
    bends: Mapping[int, Deformation] = field(default_factory=dict)
    points: Mapping[int, str] = field(default_factory=dict)
    settle: tuple[Observation, ...] = ()
    decided: Mapping[tuple[int, int], Sim3 | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.status not in ("merged", "abstained"):
            raise ValueError(f"status must be merged or abstained, not {self.status!r}")
        if self.map is not None:  # whoever has only the joined map can bend what it was joined of, too
            object.__setattr__(self, "map", add_bends(self.map, self.placements, [m.source for m in self.maps]))

    @property
    def merged(self) -> bool:
        """Is the merge to be trusted?"""
        return self.status == "merged"

    @property
    def placements(self) -> dict[int, Placement]:
        """k -> where the points of map k lie in the joined frame, of every map that is part of it; none where nothing is."""
        return build_placements(self.transforms, self.bends) if self.transforms else {}

    @property
    def file_transforms(self) -> dict[int, Array]:
        """k -> (4, 4) float64 that takes points of the file of map k into the frame of that of map 0: as `transforms` do, unless
        a cloud was tilted and has been levelled."""
        into = self.maps[0].levelling if self.transforms else np.eye(4)
        return {k: convert_pose_to_files(pose, self.maps[k].levelling, into) for k, pose in self.transforms.items()}

    def save(self, folder: str | Path) -> None:
        """Write merge.json and report.html, and where there is a joined map merged.ply and map.tmap; all of them or none.

        Files of an earlier merge are replaced, or removed where this one has none; others in the folder are left alone.

        Raises:
            InputError: the folder can't be made or written.
        """
        WRITERS["merge"](self, folder)


def serialise_merge(result: MergeResult) -> dict[str, Any]:
    """Return `merge.json` as plain values: see docs/outputs.md. Numbers are not rounded: national grids need all digits."""
    registration = result.registration
    rmse = registration.features.get("rmse", float("nan")) if registration else float("nan")
    residuals = result.atlas.residuals if result.atlas else {1: rmse}
    matrices = result.file_transforms
    transforms = {str(k): serialise_transform(pose, residuals[k], matrices[k]) for k, pose in result.transforms.items()}
    listing = {
        "format": MERGE_FORMAT,
        "status": result.status,
        "probability": min(max(float(result.probability), 0.0), 1.0),
        "reason": result.reason,
        "descriptor": result.descriptor,
        "maps": [describe_map(m) for m in result.maps],
        "transforms": transforms,
        "bend": {str(k): serialise_bend(result.maps[k], p) for k, p in result.placements.items() if p.bend is not None},
        "matches": [{"maps": m.maps, "rooms": m.rooms, "probability": round(m.probability, 4)} for m in result.matches],
        "decided": [{"maps": pair, "accepted": pose is not None} for pair, pose in sorted(result.decided.items())],
        "seconds": {step: round(float(result.seconds.get(step, 0.0)), 4) for step in MERGE_STEPS},
        "points": {str(k): name for k, name in sorted(result.points.items())},
        "alternatives": {name: round(p, 6) for name, p in registration.posterior.items()} if registration else {},
        "places": serialise_places(registration.places) if registration and registration.places else [],
        "contradictions": [serialise_contradiction(c) for c in result.atlas.contradictions] if result.atlas else [],
        "evidence": {"landmarks": (registration.landmarks if registration else LandmarkEvidence()).serialise()},
        "settle": [{**o.serialise(), "words": o.describe([m.title for m in result.maps])} for o in result.settle],
    }
    if result.map is not None and LANDMARK_PARAMETER in result.map.parameters:
        listing["landmarks"] = result.map.parameters[LANDMARK_PARAMETER]
    plain_listing: dict[str, Any] = convert_to_plain(listing)
    return plain_listing


def serialise_places(places: Places) -> list[dict[str, Any]]:
    """Serialise the scored places: their middles in the frame of the first map, m, how much floor both maps saw of
    it, m2, and the log odds that it is one place and no look-alike."""
    c = places.crops
    each = zip(c.middle.tolist(), c.area.tolist(), places.log_odds.tolist(), strict=True)
    return [{"at": [round(v, 2) for v in at], "m2": round(m2, 1), "log_odds": round(odds, 2)} for at, m2, odds in each]


def serialise_transform(pose: Sim3, rmse: float, matrix: Array, into: int = 0) -> dict[str, Any]:
    """Return a pose in the frame of another map as plain values.

    Args:
        rmse: of its surfaces, or of its measurements, m; nan where there are none.
        matrix: (4, 4), the pose between the files of both maps (`convert_pose_to_files`).
        into: the other map.
    """
    return {
        "into": into,
        "matrix": matrix.tolist(),
        "scale": pose.scale,
        "yaw_deg": pose.yaw * 57.29577951308232,
        "rmse_m": rmse if rmse == rmse else None,  # nan: slices have no planes to measure it by
    }
