"""Two maps bent onto each other: pieces registered by themselves, moved by as much as drift explains (method 4).

First the rigid pose is mended by what all pieces say; then, in windows that shrink, each piece is registered locally and a graph
of joints and measurements settles the moves of both maps (`graph`); last, walls are held against each other as lines. What no
usual drift explains is not bent: joints give way by a few standard deviations only, and a bending that nearly folds space is
refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.matching.poses import PlanFields, pair_storeys
from topomerge.registration.bend.alignment import Alignment
from topomerge.registration.bend.graph import SettledMoves
from topomerge.registration.bend.measure import LINE_SIGMAS, Window
from topomerge.registration.bend.pieces import Drift, select_drifts
from topomerge.registration.prepared import Prepared
from topomerge.types import Array, Sim3, are_within
from topomerge.types.placement import Deformation, ShiftField

FIRST_WINDOW = Window(1.2, 0.3, float(np.radians(3.0)))  # in which the rigid pose is mended
POSE_ROUNDS = 2
COARSE_LINES = 1  # rounds by lines before the drift of the maps is estimated
WINDOWS = (
    Window(0.8, 0.2, float(np.radians(2.0))),
    Window(0.4, 0.15, float(np.radians(1.0))),
    Window(0.2, 0.1, float(np.radians(0.5))),
)
LEAST_GROWTH = 0.6  # of a small area: below, space nearly folds
STIFFER = (1.0, 0.5, 0.25)  # times the drift, tried in turn until space does not fold
SHIFT_STEPS, MOST_MOVED = 0.5, 1.5  # m between the places at which the bending of a plan is computed, and around it
NEITHER_BENDS = "neither map bends"
NO_WALLS_NEAR = "no walls of the one map are near those of the other"
FOLDED = "bending would fold space"
DOUBTED = 0.25  # weight of a measurement that is voted out


def bend_plan(plan: StoreyPlan, forward: Callable[[Array], Array], back: Callable[[Array], Array]) -> StoreyPlan:
    """Return the plan after its columns were moved.

    Args:
        forward, back: places (n, 2) -> where they are moved to, and from where; inverses of each other.
    """
    nx, ny = plan.wall.shape
    rim = np.concatenate(
        [
            _sample_line((0, 0), (nx, 0)),
            _sample_line((nx, 0), (nx, ny)),
            _sample_line((nx, ny), (0, ny)),
            _sample_line((0, ny), (0, 0)),
        ]
    )
    rim = forward(plan.origin + rim * plan.edge)
    low = np.floor((rim.min(axis=0) - plan.origin) / plan.edge).astype(np.int64)
    high = np.ceil((rim.max(axis=0) - plan.origin) / plan.edge).astype(np.int64)
    shape = np.maximum(high - low, 1)
    origin = plan.origin + low * plan.edge
    columns = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 2)
    middles = origin + (columns + 0.5) * plan.edge
    source = np.floor((back(middles) - plan.origin) / plan.edge).astype(np.int64)
    inside = are_within(source, 0, (nx, ny))
    i, j = np.where(inside[:, None], source, 0).T

    def drawn(raster: Array, outside: float | bool | int) -> Array:
        return np.where(inside, raster[i, j], np.asarray(outside, raster.dtype)).reshape(shape)

    base = float(np.nanmedian(plan.floor)) if np.isfinite(plan.floor).any() else 0.0
    top = drawn(plan.top, np.inf) if isinstance(plan.top, np.ndarray) else plan.top
    return replace(
        plan, origin=origin, wall=drawn(plan.wall, False), inside=drawn(plan.inside, False), profile=drawn(plan.profile, 0),
        floor=drawn(plan.floor, base), ceiling=drawn(plan.ceiling, np.nan), top=top,
    )  # fmt: skip


def _sample_line(begin: tuple[int, int], end: tuple[int, int]) -> Array:
    """Return points every column from a corner to the next one."""
    many = max(abs(end[0] - begin[0]), abs(end[1] - begin[1]), 1)
    out: Array = np.linspace(begin, end, many + 1)
    return out


@dataclass(frozen=True, eq=False)
class Bend:
    """How two maps are bent onto each other.

    Args:
        transform: T_ab, which lays bent map b into the frame of bent map a.
        deformations: of a and of b, each in its own frame.
        features: what the bending itself tells of the pose: ``strain`` (misfit of the joints, in standard deviations of the usual
            drift), ``bent`` (m, root mean square of how far pieces of b moved against a), ``farthest`` (m, most of them),
            ``doubted`` (share of the pieces that were voted out), ``bent_pieces`` (number of those that were registered),
            ``rmse`` (m, root mean square distance of walls; nan where there are none).
        reason: why the maps stay as they are; empty where they are bent.
    """

    transform: Sim3
    deformations: tuple[Deformation, Deformation]
    features: dict[str, float] = field(default_factory=dict)
    reason: str = ""

    def bend_points(self, points: Array) -> Array:
        """Return points (n, 3) of b, moved so that the transform alone lays them where bending lays them on an unbent map a."""
        placed = self.transform.apply(self.deformations[1].apply(points))
        return self.transform.inverse().apply(self.deformations[0].undo(placed))

    def unbend_points(self, points: Array) -> Array:
        """Return the inverse of `bend_points`."""
        placed = self.deformations[0].apply(self.transform.apply(points))
        return self.deformations[1].undo(self.transform.inverse().apply(placed))

    def inverse(self) -> Bend:
        """Return the same bending seen from b."""
        return replace(self, transform=self.transform.inverse(), deformations=self.deformations[::-1])

    def bend_storeys(self, b: Sequence[PlanFields]) -> tuple[PlanFields, ...]:
        """Return the storeys of b, bent so that the transform lays them on an unbent map a; to be judged."""
        return tuple(self._bend_fields(fields) for fields in b) if not self.reason else tuple(b)

    def _bend_fields(self, fields: PlanFields) -> PlanFields:
        level, plan = fields.plan.floor_guess, fields.plan
        span = np.array(plan.wall.shape) * plan.edge
        rim = SHIFT_STEPS * np.ceil(MOST_MOVED / SHIFT_STEPS)
        low = plan.origin - rim
        nodes = np.ceil((span + 2 * rim) / SHIFT_STEPS).astype(int) + 1
        places = low + SHIFT_STEPS * np.stack(np.meshgrid(*(np.arange(n) for n in nodes), indexing="ij"), axis=-1).reshape(-1, 2)
        raised = np.column_stack([places, np.full(len(places), level)])
        moved = [(move(raised)[:, :2] - places).reshape(*nodes, 2) for move in (self.bend_points, self.unbend_points)]
        forward, back = (ShiftField(low, SHIFT_STEPS, shifts).apply for shifts in moved)
        return PlanFields(bend_plan(plan, forward, back))


def bend(a: Prepared, b: Prepared, pose: Sim3, *, drift: tuple[Drift, Drift] | None = None, scaled: bool = False) -> Bend:
    """Bend both maps, each in proportion to its drift, so that they agree under a pose near T_ab; rigid, and why, where nothing
    can be bent. `bend(b, a, pose.inverse())` gives the inverse.

    Args:
        pose: T_ab, right to about a metre.
        drift: of a and of b; of their sensors if None.
        scaled: is the scale free?
    """
    if b.order < a.order:  # so that nothing depends on which comes first
        return bend(b, a, pose.inverse(), drift=drift and drift[::-1], scaled=scaled).inverse()
    usual = drift or select_drifts((a.sensor, b.sensor))
    reason = _explain_rigid(a, b, pose, usual)
    if reason:
        return Bend(pose, (_build_rigid(a), _build_rigid(b)), reason=reason)
    mended = Alignment((a, b), (Sim3(), pose), [(0, 1)], scaled)
    for _ in range(POSE_ROUNDS):
        mended.correct_pose(FIRST_WINDOW)
    for alignment, settled in _iter_stiffer((a, b), mended.poses, [(0, 1)], scaled, usual):
        if settled is None:
            return Bend(pose, (_build_rigid(a), _build_rigid(b)), reason=NO_WALLS_NEAR)
        features = _features(alignment, settled)
        alignment.absorb_moves(shared=True)
        bent = alignment.build_deformations(settled)
        if min(d.least_growth for d in bent) >= LEAST_GROWTH:
            return Bend(alignment.poses[1], (bent[0], bent[1]), features)
    return Bend(pose, (_build_rigid(a), _build_rigid(b)), reason=FOLDED)


def bend_together(
    maps: Mapping[int, Prepared], poses: Mapping[int, Sim3], pairs: Sequence[tuple[int, int]], scaled: bool = False
) -> tuple[dict[int, Sim3], dict[int, Deformation], str]:
    """Bend maps that lie in one frame, all together: what two of them say moves the others, too, and cycles close.

    Args:
        poses: of the maps in the common frame.
        pairs: maps that see each other.
        scaled: are the scales of all but the first map free?

    Returns:
        The poses of the bent maps, the first one as it was; the deformations of those that are bent; why they stayed rigid,
        empty where they did not.
    """
    names = sorted(maps)
    place = {name: k for k, name in enumerate(names)}
    first = poses[names[0]]
    usual = select_drifts([maps[name].sensor for name in names])
    if all(d.rigid for d in usual):
        return dict(poses), {}, NEITHER_BENDS
    start = [first.inverse() @ poses[name] for name in names]
    seen = [(place[i], place[j]) for i, j in pairs]
    for alignment, settled in _iter_stiffer([maps[name] for name in names], start, seen, scaled, usual):
        if settled is None:
            return dict(poses), {}, NO_WALLS_NEAR
        alignment.absorb_moves(shared=True)
        bent = alignment.build_deformations(settled)
        if min(d.least_growth for d in bent) >= LEAST_GROWTH:
            moved = {name: first @ alignment.poses[place[name]] for name in names}
            return moved, {name: bent[k] for name, k in place.items() if len(bent[k]) and not usual[k].rigid}, ""
    return dict(poses), {}, FOLDED


def _iter_stiffer(
    maps: Sequence[Prepared], poses: Sequence[Sim3], pairs: Sequence[tuple[int, int]], scaled: bool, usual: Sequence[Drift]
) -> Iterator[tuple[Alignment, SettledMoves | None]]:
    """Yield the maps settled with their usual drift, then with less and less of it, for as long as they are asked for."""
    for share in STIFFER:
        alignment = Alignment(maps, poses, pairs, scaled)
        yield alignment, settle_all(alignment, [Drift(share * d.shift, share * d.turn) for d in usual])


def settle_all(alignment: Alignment, drifts: Sequence[Drift]) -> SettledMoves | None:
    """Move the pieces of all maps in windows that shrink, last by the lines of walls; None where no map sees walls of another."""
    settled = None
    for window in WINDOWS:
        parts = [alignment.measure_by_plan(*pair, window) for pair in alignment.pairs]
        if not sum(len(p.piece) for p in parts):
            return None
        settled = alignment.settle(parts, drifts)
    alignment.absorb_moves()
    for k, sigma in enumerate(LINE_SIGMAS):
        alignment.misfit[:] = 0.0
        parts = [alignment.measure_by_lines(*pair, sigma) for pair in alignment.pairs]
        # The drift is estimated once lines are near: so what is straight is not bent by noise (docs/adr/0014).
        settled = alignment.settle(parts, drifts, estimated=k >= COARSE_LINES)
    return settled


def _explain_rigid(a: Prepared, b: Prepared, pose: Sim3, drift: Sequence[Drift]) -> str:
    """Tell why two maps can't be bent onto each other; empty where they can."""
    if drift[0].rigid and drift[1].rigid:
        return NEITHER_BENDS
    if not pair_storeys(a.storeys, b.storeys, pose.translation[2], pose.scale):
        return "no storeys lie on one level"
    if min(len(a.pieces), len(b.pieces)) == 0:
        return "a map shows no walls"
    if max(len(m.pieces) if not d.rigid else 1 for m, d in zip((a, b), drift, strict=True)) < 2:
        return "the maps are one piece each"
    return ""


def _build_rigid(map: Prepared) -> Deformation:
    none = np.zeros(0, np.int64)
    floors = np.array([s.plan.floor_guess for s in map.storeys])
    return Deformation(np.zeros((0, 2)), none, floors, np.zeros((0, 4)), np.zeros((0, 3, 3)), none.astype(np.int32), 1.0)


def _features(alignment: Alignment, settled: SettledMoves) -> dict[str, float]:
    moved = np.linalg.norm(alignment.compute_relative_moves(1, 0)[:, :2], axis=1)
    return {
        "strain": float(np.sqrt(settled.strain.sum() / max(3 * len(settled.strain), 1))),
        "bent": float(np.sqrt((moved**2).mean())),
        "farthest": float(moved.max()),
        "doubted": float((settled.weights < DOUBTED).mean()) if len(settled.weights) else 0.0,
        "bent_pieces": float(len(settled.weights)) / 2,
        "rmse": alignment.rmse,
    }
