"""Where in an atlas was a scan taken: building, storey, room and pose, or "not here", or "cannot tell between these".

Poses are looked for in large cells on all storeys, and where landmarks propose them. The best ones are refined and judged
closely. The odds of all of them and of "nowhere" are weighed against each other (Fox et al. 1999, with a sum over poses in place
of particles). Places that look alike share the odds, and none of them is believed then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.archive import convert_to_plain, read_weights_json
from topomerge.blas import limit_blas_threads
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.extraction.navigable import add_crossed_cells
from topomerge.extraction.scan import Scan, read_scan
from topomerge.fusion.atlas.place_index import (
    IndexedMap,
    IndexedStorey,
    PlaceIndex,
    compute_features,
    open_index,
    score_roughly,
    search_coarsely,
    turn_points,
)
from topomerge.io.maps import load_map
from topomerge.io.points import read_chunks
from topomerge.landmarks.evidence import LandmarkScorer
from topomerge.landmarks.proposals import propose_poses
from topomerge.matching.poses import PlanFields, PoseHypothesis, refine, wrap_yaw
from topomerge.progress import Stopwatch
from topomerge.registration.judge import Judge
from topomerge.registration.search import find_yaw_candidates
from topomerge.registration.storeys import build_plans
from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, STOREY_DTYPE, Array, Sim3, TopometricMap, VoxelGrid

TALL = (1.5, 2.0)  # m above the floor: what a single scan shows up there is taken for a wall
LEAST_WALLS = 10  # columns of walls; a scan with fewer tells nothing
TELLING = 160  # ...; of the validation's scans none with fewer is believed, so that they are never "not here", either
NEAR, TURNED = 0.8, np.radians(8.0)  # m and rad: poses that are nearer are one
PLACE_SIGMA, INDEPENDENT = 0.08, 0.1  # m that a wall is off, and share of its columns that count
FEW = 4.0  # poses, as which what is usual counts among those of a scan
LOOSE = 5.0  # m: how far a pose may slide where no wall holds it


@dataclass(frozen=True)
class LocateSettings:
    """Settings of `locate`.

    Args:
        sure: probability from which on a place, or a few places together, is told.
        absent: probability, against the likeliest place alone, from which on "not here" is told.
        coarse: poses that are refined.
        coarse_of_storey: … of one storey.
        sample: columns of the scan by which these are refined and ranked.
        judged: poses that are judged closely.
        shown: runners-up that are told.
        alike: places between which it "cannot tell", at most.
    """

    sure: float = 0.9
    absent: float = 0.99  # from .95 on 9 of 167 scans of a map were told so wrongly, from .99 on 1 (docs/adr/0037)
    coarse: int = 240
    coarse_of_storey: int = 24
    sample: int = 400
    judged: int = 24
    shown: int = 5
    alike: int = 6


LOCATE = LocateSettings()


@dataclass(frozen=True, eq=False)
class Query:
    """A scan that is looked for.

    Args:
        fields: its plan.
        place: (3,) m, of the sensor at the end, or the middle of what was seen.
        map: with its landmarks; None where it has none.
    """

    fields: PlanFields
    place: Array
    map: TopometricMap | None = None


@dataclass(frozen=True)
class Place:
    """Where a scan may have been taken.

    Args:
        map: name in the atlas.
        building: number of the component of the atlas.
        storey, room: of that map, lowest first; -1: no room is there.
        pose: takes points of the scan into the frame of the map.
        at: (3,) m, of the sensor in the map.
        covariance: (3, 3) of x, y (m) and yaw (rad) of the sensor there.
        probability: that it is there.
        room_name: as a sign or a name in the map says.
    """

    map: str
    building: int
    storey: int
    room: int
    pose: Sim3
    at: tuple[float, float, float]
    covariance: tuple[tuple[float, ...], ...]
    probability: float
    room_name: str = ""

    def describe(self) -> str:
        """Describe it in a line."""
        room = f"room {self.room}" + (f" ({self.room_name})" if self.room_name else "") if self.room >= 0 else "no room"
        x, y, _ = self.at
        yaw = round(float(np.degrees(self.pose.yaw)))  # a whole number: there is no -0
        return (
            f"{self.map}, storey {self.storey}, {room}, at ({x:.2f}, {y:.2f}) m, facing {yaw} degrees, "
            f"probability {self.probability:.2f}"
        )


@dataclass(frozen=True)
class Location:
    """The answer.

    Args:
        status: "located", "ambiguous" or "not here".
        places: most likely first: the one, those between which it cannot be told, or what came nearest; then runners-up.
        told: how many of them are the answer.
        nowhere: probability that it is at no place of the atlas.
        reason: in words.
        seconds: step -> s.
    """

    status: str
    places: tuple[Place, ...]
    told: int
    nowhere: float
    reason: str
    seconds: dict[str, float] = field(default_factory=dict)

    def serialise(self) -> dict[str, Any]:
        """Return plain values, for JSON; no room is None."""
        places = [
            {
                **asdict(p),
                "room": p.room if p.room >= 0 else None,
                "pose": p.pose.matrix.round(6),
                "yaw_deg": round(float(np.degrees(p.pose.yaw)), 3),
            }
            for p in self.places
        ]
        listing = {**asdict(self), "places": places, "format": 1}
        plain: dict[str, Any] = convert_to_plain(listing)
        return plain


@limit_blas_threads
def locate(atlas: str | Path | PlaceIndex, scan: Any, settings: LocateSettings = LOCATE) -> Location:
    """Find where in an atlas a scan was taken.

    Args:
        atlas: its folder, or its index (`open_index`), which is quicker for many scans.
        scan: name of a file, a cloud, chunks of one, (N, 3) points, cells, or a map.

    Raises:
        InputError: no atlas, or a scan that can't be read or shows no walls.
    """
    watch = Stopwatch()
    index = atlas if isinstance(atlas, PlaceIndex) else open_index(atlas)
    watch.lap("index")
    query = scan if isinstance(scan, Query) else prepare_query(scan)
    watch.lap("scan")
    judged = find_places(index, query, settings)
    answer = decide(index, query, judged, settings)
    watch.lap("search")
    return replace(answer, seconds={step: round(s, 4) for step, s in watch.seconds.items()})


def prepare_query(scan: Any) -> Query:
    """Prepare a scan.

    Raises:
        InputError: it can't be read, or shows hardly any walls.
    """
    if isinstance(scan, str | Path):
        scan = load_map(scan) if Path(scan).suffix.lower() == ".tmap" else read_chunks(scan)
    if isinstance(scan, TopometricMap):
        return _build_query(build_plans(scan), None, scan if len(scan.landmarks) else None)
    read = add_crossed_cells(read_scan(scan, 0.1, level=not isinstance(scan, np.ndarray)))
    free = read.crossed if read.free is None else read.free
    if free is None:
        free = _find_seen_space(read)
    plans = [_raise_tall_columns(plan) for plan in build_plans(read.grid, free)]
    bare = _build_bare_map(read, free) if len(read.landmarks) else None
    return _build_query(plans, read.places[-1] if len(read.places) else None, bare)


def _find_seen_space(scan: Scan) -> VoxelGrid | None:
    """Find the cells that are empty in a scan of which nobody knows where it was taken; None where it shows no floor."""
    try:
        return extract(scan.grid).free
    except InputError:
        return None


def _raise_tall_columns(plan: Any) -> Any:
    """Return a plan in which all that is tall is a wall: a single scan shows too little of a wall far away."""
    if plan.sliced:
        return plan
    tall = plan.standing & plan.is_occupied(*TALL)
    return replace(plan, wall=plan.wall | tall, inside=plan.inside & ~tall)


def _build_query(plans: Sequence[Any], place: Array | None, map: TopometricMap | None) -> Query:
    """Build a query of the storey that shows most."""
    fields = PlanFields(max(plans, key=lambda p: int(p.wall.sum())))
    if len(fields.walls) < LEAST_WALLS:
        raise InputError("the scan shows hardly any walls: nothing can be compared; turn the sensor, or walk a few metres")
    if place is None:
        ground = fields.plan.compute_points(fields.plan.free)
        middle = np.median(ground, axis=0) if len(ground) else fields.middle
        place = np.append(middle, fields.plan.floor_guess)
    return Query(fields, np.asarray(place, float), map)


def _build_bare_map(scan: Scan, free: VoxelGrid | None) -> TopometricMap:
    """Build a map without rooms, for the landmarks of a scan."""
    nowhere = np.zeros(0, np.int32)
    floor = VoxelGrid.from_cells(np.zeros((0, 3), np.int32), scan.grid.origin, scan.grid.edge, scan.grid.shape)
    tables = np.zeros(0, ROOM_DTYPE), np.zeros(0, EDGE_DTYPE), np.zeros(0, STOREY_DTYPE)
    return TopometricMap(
        scan.grid, np.full(len(scan.grid), -1, np.int32), floor, nowhere, *tables, free=free, landmarks=scan.landmarks
    )


@dataclass(frozen=True, eq=False)
class JudgedPose:
    """A pose of the scan on a storey.

    Args:
        storey: number in the index.
        features: `FEATURES` of it.
        odds: logarithm, against another pose of which nothing is known.
        testimony: part of them that landmarks give.
    """

    storey: int
    pose: Sim3
    features: Array
    odds: float
    testimony: float = 0.0


def find_places(index: PlaceIndex, query: Query, settings: LocateSettings) -> list[JudgedPose]:
    """Find and judge poses of a scan, likeliest first."""
    named = [k for k, _ in index.landmarks.rank(query.map)] if query.map is not None else []
    rough: list[tuple[float, int, PoseHypothesis]] = []
    by_storey: dict[int, list[PoseHypothesis]] = {}
    for score, storey, pose in search_coarsely(index.storeys, query.fields, settings.coarse, settings.coarse_of_storey):
        by_storey.setdefault(storey, []).append(PoseHypothesis(pose, score))
    scorers: dict[int, LandmarkScorer] = {}
    for number in named[: settings.shown]:
        scorers[number] = LandmarkScorer(index.maps[number].load(), query.map)  # type: ignore[arg-type]
        for k, own in enumerate(index.storeys):
            if own.map == number:
                by_storey.setdefault(k, []).extend(_propose(scorers[number], own, query.fields))
    for k, hypotheses in by_storey.items():
        fields, _ = index.storeys[k].load()
        raised = [_put_on_floor(h, fields, query.fields) for h in hypotheses]
        moved = refine([fields], [query.fields], raised, sample=settings.sample)
        rough += zip(score_roughly(fields, query.fields, moved, settings.sample), repeat(k), moved, strict=False)
    rough.sort(key=lambda r: (-r[0], r[1]))
    chosen, kept = [], rough[: settings.judged]
    kept += [r for r in rough[settings.judged :] if r[2].from_rooms]
    for k in dict.fromkeys(storey for _, storey, _ in kept):
        fields, _ = index.storeys[k].load()
        judge = Judge([fields], [query.fields])
        scorer = scorers.get(index.storeys[k].map)
        chosen += [_judge(judge, k, h, scorer) for _, storey, h in kept if storey == k]
    return sorted(chosen, key=lambda j: -j.odds)


def _propose(scorer: LandmarkScorer, storey: IndexedStorey, query: PlanFields) -> list[PoseHypothesis]:
    fields, _ = storey.load()
    yaws = find_yaw_candidates(fields.profile, query.profile)
    poses = propose_poses(scorer, False, yaws, [fields.plan.floor_guess - query.plan.floor_guess])
    return [PoseHypothesis(pose, from_rooms=True) for pose in poses]


def _put_on_floor(hypothesis: PoseHypothesis, fields: PlanFields, query: PlanFields) -> PoseHypothesis:
    x, y, _ = hypothesis.transform.translation
    height = fields.plan.floor_guess - query.plan.floor_guess
    return replace(hypothesis, transform=Sim3(hypothesis.transform.yaw, (x, y, float(height))))


def _judge(judge: Judge, storey: int, hypothesis: PoseHypothesis, scorer: LandmarkScorer | None) -> JudgedPose:
    pose = hypothesis.transform
    features = compute_features(judge, hypothesis)
    weights = load_odds()
    testimony = float(np.clip(scorer.score(pose).support, -10.0, 20.0)) if scorer is not None else 0.0
    return JudgedPose(storey, pose, features, float(features @ weights["weight"]) + testimony, testimony)


def load_odds() -> dict[str, Any]:
    """Load the weights of `FEATURES` and what makes the odds of "nowhere" (`train.py task=locate_odds`)."""
    return read_weights_json("topomerge.fusion.atlas", "locate_odds.json")


def decide(index: PlaceIndex, query: Query, judged: Sequence[JudgedPose], settings: LocateSettings = LOCATE) -> Location:
    """Decide what to tell of judged poses."""
    if not judged:
        return Location("not here", (), 0, 1.0, "the scan fits nowhere in the atlas")
    none = compute_nowhere(judged)
    chances, nowhere = compute_probabilities(judged, none)
    places: list[tuple[Place, Array]] = []
    for pose, p in zip(judged, chances.tolist(), strict=True):
        own = index.maps[index.storeys[pose.storey].map]
        position = _place_in_building(own, pose.pose, query.place)
        same = [k for k, (q, at) in enumerate(places) if q.building == own.building and _is_same(at, position)]
        if same:  # another map of the same building shows the place, too, or a pose next to it
            first, at = places[same[0]]
            places[same[0]] = replace(first, probability=first.probability + p), at
        else:
            places.append((_build_place(index, pose, query, p), position))
    ranked = sorted((p for p, _ in places), key=lambda p: -p.probability)
    shown = tuple(ranked[: settings.alike + settings.shown])
    return _word(shown, nowhere, settings, len(query.fields.walls) >= TELLING)


def compute_nowhere(judged: Sequence[JudgedPose]) -> float:
    """Compute the odds of "nowhere" by the mean ones of the poses: what a scan like this reaches by chance."""
    odds = load_odds()
    return float(odds["nowhere"]) + float(odds["chance"]) * measure_chance([j.odds - j.testimony for j in judged], odds["usual"])


def measure_chance(odds: Sequence[float] | Array, usual: float) -> float:
    """Measure the mean odds of poses; of few ones together with what is usual."""
    return float(np.sum(odds) + FEW * usual) / (len(odds) + FEW)


def compute_probabilities(judged: Sequence[JudgedPose], none: float) -> tuple[Array, float]:
    """Return (n,) the probability of each pose, and that of none of them."""
    odds = np.array([*(j.odds for j in judged), none])
    weight = np.exp(odds - odds.max())
    weight /= weight.sum()
    return weight[:-1], float(weight[-1])


def _place_in_building(own: IndexedMap, pose: Sim3, place: Array) -> Array:
    """Return (4,) x, y, z m and yaw of the sensor in the frame of the building."""
    whole = own.pose @ pose
    return np.append(whole.apply(place[None])[0], whole.yaw)


def _is_same(a: Array, b: Array) -> bool:
    return bool(np.hypot(*(a - b)[:2]) < NEAR and abs(a[2] - b[2]) < 1.5 and abs(wrap_yaw(float(a[3] - b[3]))) < TURNED)


def _word(places: tuple[Place, ...], nowhere: float, settings: LocateSettings, telling: bool) -> Location:
    best = places[0]
    if best.probability >= settings.sure:
        return Location("located", places[: 1 + settings.shown], 1, nowhere, best.describe())
    sums = np.cumsum([p.probability for p in places[: settings.alike]])
    if nowhere < 0.5 and sums[-1] >= settings.sure:
        told = int(np.searchsorted(sums, settings.sure)) + 1
        if len({(p.building, p.storey) for p in places[:told]}) == 1:
            where = f"it is in {best.map}, storey {best.storey}, but cannot tell between {told} places there"
        else:
            where = f"cannot tell between {told} places that look alike"
        return Location("ambiguous", places, told, nowhere, where)
    if nowhere >= settings.absent * (nowhere + best.probability) and telling:
        reason = f"not here ({nowhere:.2f}): nothing in the atlas fits well enough"
        return Location("not here", places[: settings.shown], 0, nowhere, reason)
    reason = "the scan shows too little"
    if telling:
        reason = "too many places fit about as well" if nowhere < 0.5 else f"no place fits well ({nowhere:.2f} that it is none)"
    return Location("ambiguous", places, 0, nowhere, f"cannot tell: {reason}; turn the sensor or walk on, so that it shows more")


def _build_place(index: PlaceIndex, judged: JudgedPose, query: Query, probability: float) -> Place:
    storey = index.storeys[judged.storey]
    own = index.maps[storey.map]
    fields, rooms = storey.load()
    at = judged.pose.apply(query.place[None])[0]
    cell = np.floor((at[:2] - fields.plan.origin) / fields.plan.edge).astype(np.int64)
    inside = bool(((cell >= 0) & (cell < rooms.shape)).all())
    room = int(rooms[tuple(cell)]) if inside else -1
    covariance = measure_covariance(query, judged.pose)
    x, y, z = at.round(3).tolist()
    rounded = tuple(tuple(float(f"{v:.3g}") for v in row) for row in covariance.tolist())
    name = own.rooms[room] if 0 <= room < len(own.rooms) else ""
    return Place(own.name, own.building, storey.number, room, judged.pose, (x, y, z), rounded, probability, name)


def measure_covariance(query: Query, pose: Sim3) -> Array:
    """Measure (3, 3) of x, y (m) and yaw (rad) of the sensor: by which way the walls face that hold it.

    Along a bare corridor nothing does, and the pose may slide there.
    """
    fields = query.fields
    across = fields.directions + np.pi / 2 + pose.yaw
    normal = np.column_stack([np.cos(across), np.sin(across)])
    arm = turn_points(fields.walls - query.place[:2], pose.yaw)
    rows = np.column_stack([normal, normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]])
    information = INDEPENDENT * rows.T @ rows / PLACE_SIGMA**2 + np.diag([LOOSE**-2, LOOSE**-2, 1.0])
    return np.asarray(np.linalg.inv(information) + np.diag([0.02**2, 0.02**2, np.radians(0.3) ** 2]))
