"""Hypotheses of poses, the fields they are judged by, and their refinement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.kernels import registration, run_in_slices
from topomerge.structure.lines import DIRECTION_STEP, compute_direction_profile
from topomerge.types import Array, Sim3

LARGEST_LOG_ODDS = 7.0


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """A pose of map b in the frame of map a that may be right, from its proposal to its verification.

    Args:
        transform: T_ab.
        score: what the last step ranks hypotheses by: the agreement of walls in `registration.search`, m of walls in
            `matching.consistency`, log odds that it is right, seen by itself, after `registration.verify.rank`.
        probability: that it is right, beside all others; with "none of them" these sum to 1.
        features: what it was judged by, name -> number.
        from_rooms: was it proposed by matched rooms? Correlation never pushes such a one out.
        rooms: (M, 2) int64 rooms of a and of b that are one room then; a room may be in several.
        fit: (M,) float64 0..1, how well each of these pairs fits (share of floor in common).
    """

    transform: Sim3
    score: float = 0.0
    probability: float = 0.0
    features: Mapping[str, float] = field(default_factory=dict)
    from_rooms: bool = False
    rooms: Array = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    fit: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def log_odds(self) -> float:
        """Of its probability, between -7 and 7."""
        p = float(np.clip(self.probability, 1e-6, 1 - 1e-6))
        return float(np.clip(np.log(p / (1 - p)), -LARGEST_LOG_ODDS, LARGEST_LOG_ODDS))


@dataclass(frozen=True, eq=False)
class PoseArrays:
    """H poses u -> scale * R(yaw) u + shift.

    Args:
        yaw: (H,) rad.
        shift: (H, 3) m.
        scale: (H,).
        weight: (H,) how much speaks for each, as the similarity of the rooms that suggested it.
    """

    yaw: Array
    shift: Array
    scale: Array
    weight: Array

    @classmethod
    def from_transforms(cls, transforms: Sequence[Sim3]) -> PoseArrays:
        """Return given poses, of weight 1."""
        yaw, scale = (np.array([getattr(t, name) for t in transforms], np.float64) for name in ("yaw", "scale"))
        return cls(yaw, np.array([t.translation for t in transforms], np.float64).reshape(-1, 3), scale, np.ones(len(yaw)))

    def __len__(self) -> int:
        return len(self.yaw)

    def take(self, rows: Array) -> PoseArrays:
        """Return the poses in the given rows."""
        return PoseArrays(self.yaw[rows], self.shift[rows], self.scale[rows], self.weight[rows])

    def get_transform(self, row: int) -> Sim3:
        """Return one of the poses, its yaw in [-pi, pi)."""
        x, y, z = self.shift[row].tolist()
        return Sim3(wrap_yaw(float(self.yaw[row])), (x, y, z), float(self.scale[row]))

    def inverse(self) -> PoseArrays:
        """Return the poses of a in the frame of b."""
        c, s = np.cos(-self.yaw) / self.scale, np.sin(-self.yaw) / self.scale
        x, y, z = self.shift.T
        back = -np.stack([c * x - s * y, s * x + c * y, z / self.scale], axis=1)
        return PoseArrays(-self.yaw, back, 1 / self.scale, self.weight)

    def place_point(self, point: Array) -> Array:
        """Return (H, 3) m, where the poses put a point (3,)."""
        c, s = self.scale * np.cos(self.yaw), self.scale * np.sin(self.yaw)
        x, y, z = point
        return np.stack([c * x - s * y, s * x + c * y, self.scale * z], axis=1) + self.shift


def concatenate_poses(*parts: PoseArrays) -> PoseArrays:
    """Return the poses of all parts, one after the other."""
    names = ("yaw", "shift", "scale", "weight")
    return PoseArrays(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


@dataclass(frozen=True)
class PoseTolerance:
    """Poses that differ by less count as one: m in each horizontal direction, rad, logarithm of the scale, m of height."""

    metres: float
    radians: float
    log_scale: float
    height: float = 0.8


def find_distinct_poses(poses: PoseArrays, point: Array, tolerance: PoseTolerance, number: int | None = None) -> Array:
    """Return (n,) int64 rows of the first of each group of poses that are one.

    Args:
        poses: best first.
        point: (3,) m, of b, where poses are compared: its middle, as a frame's origin may lie far off.
        tolerance: how near poses are that are one.
        number: of poses after which to stop.
    """
    at = poses.place_point(point)
    size = np.log(poses.scale)
    selected: list[int] = []
    for row in range(len(poses)):
        rows = np.array(selected, np.int64)
        same = np.abs(at[rows, :2] - at[row, :2]).max(axis=1, initial=0.0) < tolerance.metres
        same &= np.abs(at[rows, 2] - at[row, 2]) < tolerance.height
        same &= np.abs(_wrap_angles(poses.yaw[rows] - poses.yaw[row])) < tolerance.radians
        same &= np.abs(size[rows] - size[row]) < tolerance.log_scale
        if not same.any():
            selected.append(row)
            if len(selected) == number:
                break
    return np.array(selected, np.int64)


def select_distinct_hypotheses(
    hypotheses: Sequence[PoseHypothesis], point: Array, tolerance: PoseTolerance
) -> list[PoseHypothesis]:
    """Return the first of each group of hypotheses whose poses are one. Arguments as of `find_distinct_poses`."""
    return [
        hypotheses[row]
        for row in find_distinct_poses(PoseArrays.from_transforms([h.transform for h in hypotheses]), point, tolerance).tolist()
    ]


def wrap_yaw(yaw: float) -> float:
    """Return the same angle in [-pi, pi)."""
    return float((yaw + np.pi) % (2 * np.pi) - np.pi)


def _wrap_angles(angles: Array) -> Array:
    """Return the same angles in [-pi, pi)."""
    out: Array = (angles + np.pi) % (2 * np.pi) - np.pi
    return out


def pose_difference(p: Sim3, q: Sim3, anchor: Array) -> tuple[float, float, float]:
    """Return how far two poses are apart: m at the anchor, rad, log scale.

    Args:
        anchor: (3,) m, a point of the moved map: the frame's origin may lie far away, where a small turn is a long way.
    """
    moved = float(np.linalg.norm(p.apply(anchor[None])[0] - q.apply(anchor[None])[0]))
    turned = abs(float((p.yaw - q.yaw + np.pi) % (2 * np.pi) - np.pi))
    return moved, turned, abs(float(np.log(p.scale / q.scale)))


FREE_MARGIN = 0.25  # m that free ground keeps from anything standing
DISTANCE_CAP = 1.0  # m, of the distance fields
HEAD_HEIGHT = 2.0  # m above the floor
CEILING_SLACK = 0.15  # m below a ceiling that still are it
LINTEL_REACH = 0.5  # m from walls: nearer, what is above a head is part of the wall
TALL_HEIGHTS = (2.0, 2.5)  # m above the floor: little furniture is that high


@dataclass(frozen=True, eq=False)
class PlanFields:
    """A plan with what poses are judged by; made once a plan."""

    plan: StoreyPlan

    @cached_property
    def kind(self) -> Array:
        """(nx, ny) uint8: 0 unknown, 1 wall, 2 free, 3 clutter."""
        p = self.plan
        return (
            registration.WALL_STATE * p.wall + registration.FREE_STATE * p.free + registration.CLUTTER_STATE * p.clutter
        ).astype(np.uint8)

    @cached_property
    def to_wall(self) -> Array:
        """(nx, ny) float32 m to the nearest wall, at most `DISTANCE_CAP`."""
        return compute_distance(self.plan.wall, self.plan.edge)

    @cached_property
    def field(self) -> tuple[Array, Array]:
        """`to_wall` with a rim of `DISTANCE_CAP`, and its corner, m: poses are drawn back from beyond the outer walls, too."""
        rim = int(np.ceil(DISTANCE_CAP / self.plan.edge))
        return compute_distance(np.pad(self.plan.wall, rim), self.plan.edge), self.plan.origin - rim * self.plan.edge

    @cached_property
    def to_any(self) -> Array:
        """(nx, ny) float32 m to anything that stands."""
        return compute_distance(self.plan.wall | self.plan.clutter, self.plan.edge)

    @cached_property
    def core(self) -> Array:
        """(nx, ny) bool: free ground `FREE_MARGIN` from anything that stands."""
        return self.plan.free & (self.to_any >= FREE_MARGIN)

    @cached_property
    def face(self) -> Array:
        """(nx, ny, 2) float32 unit vector towards empty space; 0 where both sides of a wall were seen, or none."""
        blurred = ndimage.gaussian_filter(self.plan.free.astype(np.float32), 0.25 / self.plan.edge)
        slope = np.stack(np.gradient(blurred), axis=-1)
        length = np.linalg.norm(slope, axis=-1, keepdims=True)
        return np.where(length > 0.02, slope / np.maximum(length, 1e-6), 0.0).astype(np.float32)

    @cached_property
    def walls(self) -> Array:
        """(n, 2) m."""
        return self.plan.compute_points(self.plan.wall)

    @cached_property
    def directions(self) -> Array:
        """(n,) rad in [0, pi): of the wall that each column of `walls` belongs to."""
        image = ndimage.gaussian_filter(self.plan.wall.astype(np.float32), 0.15 / self.plan.edge)
        x, y = np.gradient(image)
        double = (x + 1j * y) ** 2
        smooth = [ndimage.gaussian_filter(part, 0.3 / self.plan.edge)[self.plan.wall] for part in (double.imag, double.real)]
        out: Array = (np.arctan2(*smooth) / 2 + np.pi / 2) % np.pi
        return out

    @cached_property
    def tall(self) -> Array:
        """(n,) bool: is the wall higher than furniture? All are where the map did not look that high."""
        mask = self.plan.profile.dtype.type(self.plan.bands.build_mask(*TALL_HEIGHTS))
        tall: Array = (self.plan.profile[self.plan.wall] & mask) == mask
        return tall if tall.mean() > 0.25 else np.ones_like(tall)

    @cached_property
    def hung(self) -> Array:
        """(nx, ny) uint8: 2 where something hangs below the ceiling and above a head, 1 where nothing does, 0 where no ceiling
        was seen or a wall or the lintel of a door is near."""
        p = self.plan
        step, below = p.bands.step, p.bands.below
        ceiling = np.nan_to_num(p.ceiling_height, nan=-1e3) - CEILING_SLACK - p.floor_height
        top = np.floor((ceiling + below * step) / step)  # the first band that may be the ceiling's
        head = round(HEAD_HEIGHT / step) + below
        seen = np.isfinite(p.ceiling) & p.free & (top > head) & (self.to_wall >= LINTEL_REACH)
        under = np.left_shift(np.uint32(1), np.clip(top, 0, 31).astype(np.uint32)) - np.uint32(1)
        hanging = (p.profile & under & ~np.uint32((1 << head) - 1)) > 0
        out: Array = (seen * (1 + hanging)).astype(np.uint8)
        return out

    @cached_property
    def middle(self) -> Array:
        """(2,) m, of the walls."""
        return self.walls.mean(axis=0) if len(self.walls) else self.plan.compute_points(self.plan.explored).mean(axis=0)

    @cached_property
    def profile(self) -> Array:
        """(360,) how sharply the walls line up along each direction, in steps of half a degree over half a turn."""
        return compute_direction_profile(self.walls, self.plan.edge)

    @property
    def main_direction(self) -> float:
        """rad in [0, pi): the direction along which the walls line up most sharply."""
        return float(np.radians(float(self.profile.argmax()) * DIRECTION_STEP))


def compute_distance(mask: Array, edge: float) -> Array:
    """Return (nx, ny) float32 m from the middle of each column to the nearest masked one, at most `DISTANCE_CAP`."""
    import edt

    if not mask.any():
        return np.full(mask.shape, DISTANCE_CAP, np.float32)
    return np.minimum(edt.edt(~mask, anisotropy=(edge, edge)), DISTANCE_CAP).astype(np.float32)


SAME_POSE = PoseTolerance(0.4, float(np.radians(2.0)), 0.03)


@dataclass(frozen=True)
class RefineSettings:
    """Settings of refining poses by walls.

    Args:
        sigmas: m, of the weights of walls by their distance, round by round.
        rounds: of each sigma.
        sample: wall columns that a pose is refined by, at most.
        same_level: m by which floors of one storey may differ.
        unseen_level: m, likewise where a floor was not seen: its guess may be off by more.
        same_pose: refined poses that are nearer are one.
    """

    sigmas: tuple[float, ...] = (0.3, 0.15, 0.08)
    rounds: int = 5
    sample: int = 1500
    same_level: float = 0.5
    unseen_level: float = 1.2
    same_pose: PoseTolerance = SAME_POSE


REFINE = RefineSettings()


def pair_storeys(
    a: Sequence[PlanFields], b: Sequence[PlanFields], offset: float, scale: float = 1.0
) -> list[tuple[PlanFields, PlanFields]]:
    """Return the storeys of a and of b that lie on one level under an offset of heights, m, and a scale of b."""
    pairs = []
    for v in a:
        for w in b:
            unseen = not np.isfinite((v.plan.levels[0], w.plan.levels[0])).all() or v.plan.sliced or w.plan.sliced
            gap = abs(v.plan.floor_guess - (scale * w.plan.floor_guess + offset))
            if gap < (REFINE.unseen_level if unseen else REFINE.same_level):
                pairs.append((v, w))
    return pairs


def refine(
    a: Sequence[PlanFields],
    b: Sequence[PlanFields],
    hypotheses: Sequence[PoseHypothesis],
    scaled: bool = False,
    sample: int = REFINE.sample,
) -> list[PoseHypothesis]:
    """Return the hypotheses moved to where b's walls lie on those of a, without duplicates; the best first, by the share of walls
    that meet.

    Those under which no storeys lie on one level are left out.

    Args:
        a, b: the storeys of the two maps.
        scaled: is the scale refined, too?
        sample: wall columns of b that a pose is refined by, at most.
    """
    moved: list[PoseHypothesis] = []
    levels: dict[float, list[PoseHypothesis]] = {}
    for hypothesis in hypotheses:
        levels.setdefault(hypothesis.transform.translation[2], []).append(hypothesis)
    for offset, group in levels.items():
        pairs = [p for p in pair_storeys(a, b, offset, group[0].transform.scale) if len(p[0].walls) and len(p[1].walls)]
        if pairs:
            moved += _refine_group(*max(pairs, key=lambda p: min(len(p[0].walls), len(p[1].walls))), group, scaled, sample)
    moved.sort(key=lambda h: -h.score)
    return select_distinct_hypotheses(moved, np.append(b[0].middle, 0.0), REFINE.same_pose)


def _refine_group(
    v: PlanFields, w: PlanFields, group: Sequence[PoseHypothesis], scaled: bool, sample: int
) -> list[PoseHypothesis]:
    """Return the hypotheses of one offset of heights, moved by the walls of one storey of each map."""
    walls = w.walls
    if len(walls) > sample:
        walls = walls[np.random.default_rng(0).permutation(len(walls))[:sample]]
    middle = walls.mean(axis=0)
    start = np.array([[*_place_point(h.transform, middle), h.transform.yaw, np.log(h.transform.scale)] for h in group])
    field = (*v.field, v.plan.edge)
    about = np.ascontiguousarray(walls - middle)

    def refine(first: int, last: int) -> tuple[Array, Array]:
        moved: tuple[Array, Array] = registration.refine(
            about, *field, start[first:last], np.array(REFINE.sigmas), REFINE.rounds, scaled
        )
        return moved

    poses, score = (np.concatenate(part) for part in zip(*run_in_slices(refine, len(start), 1), strict=True))
    moved = []
    for hypothesis, (x, y, yaw, size), value in zip(group, poses, score, strict=True):
        turned = Sim3(wrap_yaw(yaw), (0.0, 0.0, 0.0), float(np.exp(size)))
        at = np.array([x, y]) - _place_point(turned, middle)
        transform = replace(turned, translation=(float(at[0]), float(at[1]), hypothesis.transform.translation[2]))
        moved.append(replace(hypothesis, transform=transform, score=float(value) / len(walls)))
    return moved


def _place_point(transform: Sim3, point: Array) -> Array:
    """Return (2,) m, where a transform puts a point (2,)."""
    out: Array = transform.apply(np.array([[*point, 0.0]]))[0, :2]
    return out
