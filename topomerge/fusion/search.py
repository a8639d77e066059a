"""Candidate poses of one map in another: heights from floors, yaw from wall directions, translation by correlation (method 3).

Free space decides: walls on walls count for a pose, walls of one map on seen-empty ground of the other against it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import fft, ndimage

from topomerge.fusion.storey_plan import BAND, LOW, Plan
from topomerge.kernels import align
from topomerge.types import Array, Sim3

COARSE = 0.2  # m, cells of the correlation; wider where maps are large
LARGEST = 1300  # cells along a side of the correlated image
LAMBDA = 0.75  # weight of a wall on free ground, against one on a wall
MARGIN = 0.25  # m that free ground keeps from anything standing
HEAD, HANG = 10, 0.15  # band from 2.0 m above the floor on; m below a ceiling that still are it
LINTEL = 0.5  # m from walls: nearer, what is above a head is part of the wall
TALL = 0b11 << 10  # 2.0 to 2.5 m above the floor: little furniture is that high
DEGREE = 0.5  # of the direction profile
PEAKS, PER_YAW, KEPT = 10, 12, 100
QUARTERS, TURNED = 3, np.radians(3.0)  # peaks that are tried in all quarters, where no other peak is as near
APART = 0.6  # m between peaks of one yaw
SIGMAS = (0.3, 0.15, 0.08)  # m
SAMPLE = 1500  # wall columns that a pose is refined by
SAME_LEVEL = 0.4  # m
SAME = (0.4, np.radians(2.0), 0.03)  # m, rad, log scale: poses nearer than that are one
REACH = 1.0  # m, of the distance field


@dataclass(frozen=True, eq=False)
class View:
    """A plan with what poses are judged by; made once a plan."""

    plan: Plan

    @cached_property
    def kind(self) -> Array:
        """(H, W) uint8: 0 unknown, 1 wall, 2 free, 3 clutter."""
        p = self.plan
        return (align.WALL * p.wall + align.FREE * p.free + align.CLUTTER * p.clutter).astype(np.uint8)

    @cached_property
    def to_wall(self) -> Array:
        """(H, W) float32 m to the nearest wall, at most `REACH`."""
        return _distance(self.plan.wall, self.plan.cell)

    @cached_property
    def field(self) -> tuple[Array, Array]:
        """`to_wall` with a rim of `REACH`, and the corner of it, m: poses are drawn back from beyond the outer walls, too."""
        rim = int(np.ceil(REACH / self.plan.cell))
        return _distance(np.pad(self.plan.wall, rim), self.plan.cell), self.plan.origin - rim * self.plan.cell

    @cached_property
    def to_any(self) -> Array:
        """(H, W) float32 m to anything that stands."""
        return _distance(self.plan.wall | self.plan.clutter, self.plan.cell)

    @cached_property
    def core(self) -> Array:
        """(H, W) bool: free ground `MARGIN` from anything that stands."""
        return self.plan.free & (self.to_any >= MARGIN)

    @cached_property
    def face(self) -> Array:
        """(H, W, 2) float32 unit vector towards empty space; 0 where both sides of a wall were seen, or none."""
        blurred = ndimage.gaussian_filter(self.plan.free.astype(np.float32), 0.25 / self.plan.cell)
        slope = np.stack(np.gradient(blurred), axis=-1)
        length = np.linalg.norm(slope, axis=-1, keepdims=True)
        return np.where(length > 0.02, slope / np.maximum(length, 1e-6), 0.0).astype(np.float32)

    @cached_property
    def walls(self) -> Array:
        """(n, 2) m."""
        return self.plan.points(self.plan.wall)

    @cached_property
    def directions(self) -> Array:
        """(n,) rad in [0, pi): of the wall that each column of `walls` belongs to."""
        image = ndimage.gaussian_filter(self.plan.wall.astype(np.float32), 0.15 / self.plan.cell)
        x, y = np.gradient(image)
        double = (x + 1j * y) ** 2
        smooth = [ndimage.gaussian_filter(part, 0.3 / self.plan.cell)[self.plan.wall] for part in (double.imag, double.real)]
        out: Array = (np.arctan2(*smooth) / 2 + np.pi / 2) % np.pi
        return out

    @cached_property
    def tall(self) -> Array:
        """(n,) bool: is the wall higher than furniture? All are where the map did not look that high."""
        high = (self.plan.bits[self.plan.wall] & np.uint32(TALL)) == TALL
        return high if high.mean() > 0.25 else np.ones_like(high)

    @cached_property
    def hung(self) -> Array:
        """(H, W) uint8: 2 where something hangs below the ceiling and above a head, 1 where nothing does, 0 where no ceiling was
        seen or a wall or the lintel of a door is near."""
        p = self.plan
        top = np.floor((np.nan_to_num(p.high, nan=-1e3) - HANG - p.low - LOW) / BAND)  # the first band that may be the ceiling's
        seen = np.isfinite(p.high) & p.free & (top > HEAD) & (self.to_wall >= LINTEL)
        below = np.left_shift(np.uint32(1), np.clip(top, 0, 31).astype(np.uint32)) - np.uint32(1)
        something = (p.bits & below & ~np.uint32((1 << HEAD) - 1)) > 0
        out: Array = (seen * (1 + something)).astype(np.uint8)
        return out

    @cached_property
    def middle(self) -> Array:
        """(2,) m, of the walls."""
        return self.walls.mean(axis=0) if len(self.walls) else self.plan.points(self.plan.known).mean(axis=0)

    @cached_property
    def profile(self) -> Array:
        """(360,) how sharply the walls line up along each direction, in steps of half a degree over half a turn."""
        return direction_profile(self.walls, self.plan.cell)


@dataclass(frozen=True)
class Candidate:
    """A pose found by search: T_ab and how it scored."""

    pose: Sim3
    score: float
    given: bool = False  # as a hypothesis, from matched rooms


def _distance(mask: Array, cell: float) -> Array:
    import edt

    if not mask.any():
        return np.full(mask.shape, REACH, np.float32)
    return np.minimum(edt.edt(~mask, anisotropy=(cell, cell)), REACH).astype(np.float32)


def direction_profile(walls: Array, cell: float, most: int = 6000) -> Array:
    """(360,) float64: for each direction in steps of 0.5 degrees, how much the walls' projection across it is heaped up."""
    if not len(walls):
        return np.zeros(int(180 / DEGREE))
    rng = np.random.default_rng(0)
    points = walls if len(walls) <= most else walls[rng.permutation(len(walls))[:most]]
    points = points - points.mean(axis=0) + rng.uniform(-cell / 2, cell / 2, points.shape)  # else the raster lines up at 0 and 90
    angles = np.radians(np.arange(0, 180, DEGREE))
    across = points @ np.stack([-np.sin(angles), np.cos(angles)])
    rows = np.floor(across / 0.2).astype(np.int64)
    rows -= rows.min()
    width = int(rows.max()) + 1
    flat = (rows + np.arange(len(angles)) * width).ravel()
    heaps = np.bincount(flat, minlength=len(angles) * width).reshape(len(angles), width).astype(float)
    sharp: Array = (heaps**2).sum(axis=1) / len(points)
    return np.clip(sharp - np.median(sharp), 0, None)


def yaw_candidates(a: Array, b: Array, peaks: int = PEAKS) -> list[float]:
    """Yaws (rad) that turn b's direction profile into a's, best first; each with its half turn, the best ones in all quarters:
    where one map shows the walls of one direction only, those of the other direction are the nearest peak."""
    blur = 1.5 / DEGREE
    a, b = (ndimage.gaussian_filter1d(p, blur / 2, mode="wrap") for p in (a, b))
    a, b = a / max(a.max(), 1e-9), b / max(b.max(), 1e-9)
    match = fft.irfft(fft.rfft(a) * np.conj(fft.rfft(b)), len(a))
    wide = ndimage.maximum_filter1d(match, int(4 / DEGREE) + 1, mode="wrap")
    tops = np.flatnonzero((match >= wide) & (match > 0.1 * match.max()))
    tops = tops[np.argsort(-match[tops], kind="stable")][:peaks]
    found = []
    for k in tops:
        left, at, right = match[k - 1], match[k], match[(k + 1) % len(match)]
        bend = left - 2 * at + right
        shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
        found += [wrapped(np.radians((k + shift) * DEGREE) + half) for half in (0.0, np.pi)]
    for yaw in found[: 2 * QUARTERS]:
        aside = wrapped(yaw + np.pi / 2)
        if all(abs(wrapped(aside - other)) > TURNED for other in found):
            found.append(aside)
    return found


def wrapped(yaw: float) -> float:
    """The same angle in [-pi, pi)."""
    return float((yaw + np.pi) % (2 * np.pi) - np.pi)


def heights(a: Sequence[Plan], b: Sequence[Plan], scale: float = 1.0) -> list[float]:
    """z offsets that bring a storey of b to one of a: by their floors, or by their ceilings where a floor was not seen."""
    found: list[float] = []
    for p in a:
        for q in b:
            if np.isfinite(p.floor) and np.isfinite(q.floor):
                offset = p.floor - scale * q.floor
            elif np.isfinite(p.ceiling) and np.isfinite(q.ceiling):
                offset = p.ceiling - scale * q.ceiling
            else:
                offset = p.guess - scale * q.guess
            if all(abs(offset - o) > SAME_LEVEL for o in found):
                found.append(float(offset))
    return found


def pairs_at(a: Sequence[View], b: Sequence[View], offset: float, scale: float = 1.0) -> list[tuple[View, View]]:
    """The storeys that lie on one level under a z offset. Where a floor was not seen, its guess may be off by more."""
    found = []
    for v in a:
        for w in b:
            unseen = not (np.isfinite(v.plan.floor) and np.isfinite(w.plan.floor)) or v.plan.sliced or w.plan.sliced
            if abs(v.plan.guess - (scale * w.plan.guess + offset)) < (1.2 if unseen else SAME_LEVEL + 0.1):
                found.append((v, w))
    return found


class Correlator:
    """Correlates one plan with another in many turned positions; what concerns the fixed one is transformed once."""

    def __init__(self, a: View, b: View, scale: float = 1.0) -> None:
        spans = [np.ptp(v.plan.points(v.plan.known), axis=0) for v in (a, b)]
        reach = float(np.hypot(*spans[1])) * scale
        self.cell = max(COARSE, (float(spans[0].max()) + reach + 4) / LARGEST)
        self.a, self.b = a, b
        self.low = a.plan.origin
        shape = np.array(a.plan.wall.shape) * a.plan.cell
        self.size = [fft.next_fast_len(int(np.ceil((s + reach) / self.cell)) + 4, real=True) for s in shape]
        wall = np.minimum(self._image(a.walls - self.low), 1.0)
        near = ndimage.gaussian_filter(wall, 0.2 / self.cell) * 2
        core = self._image(a.plan.points(a.core) - self.low) * (a.plan.cell / self.cell) ** 2
        self.agree = fft.rfft2(near - LAMBDA * np.minimum(core, 1.0))
        self.against = fft.rfft2(wall) * LAMBDA
        self.cores = b.plan.points(b.core)
        self.span = np.ceil(shape / self.cell)  # a shift beyond the fixed plan is one back

    def _image(self, points: Array) -> Array:
        cells = np.floor(points / self.cell).astype(np.int64)
        flat = cells[:, 0] * self.size[1] + cells[:, 1]
        image: Array = np.bincount(flat, minlength=self.size[0] * self.size[1]).reshape(self.size).astype(np.float32)
        return image

    def translations(self, yaw: float, many: int = PER_YAW, scale: float = 1.0) -> list[tuple[float, float, float]]:
        """(score, x, y): the translations of T_ab at the best peaks that are `APART` from each other."""
        c, s = scale * np.cos(yaw), scale * np.sin(yaw)
        turn = np.array([[c, s], [-s, c]])
        walls, cores = self.b.walls @ turn, self.cores @ turn
        low = np.concatenate([walls, cores]).min(axis=0)
        wall = np.minimum(self._image(walls - low), 1.0)
        core = np.minimum(self._image(cores - low) * (self.b.plan.cell * scale / self.cell) ** 2, 1.0)
        product = self.agree * np.conj(fft.rfft2(wall)) - self.against * np.conj(fft.rfft2(core))
        return self._peaks(fft.irfft2(product, self.size), self.low - low, many)

    def _peaks(self, image: Array, start: Array, many: int) -> list[tuple[float, float, float]]:
        pool = min(many * (2 * round(APART / self.cell) + 1) ** 2, image.size - 1)
        flat = image.ravel()
        best = np.argpartition(flat, -pool)[-pool:]
        best = best[flat[best] > 0]
        best = best[np.lexsort((best, -flat[best]))]
        shift = np.column_stack(np.unravel_index(best, image.shape)).astype(float)
        shift = np.where(shift > self.span, shift - self.size, shift)
        found: list[tuple[float, float, float]] = []
        while len(best) and len(found) < many:
            x, y = (start + shift[0] * self.cell).tolist()
            found.append((float(flat[best[0]]), x, y))
            far = np.abs(shift - shift[0]).max(axis=1) * self.cell > APART
            best, shift = best[far], shift[far]
        return found


def search(a: Sequence[View], b: Sequence[View], hypotheses: Sequence[Sim3] = (), yaws: Sequence[float] = ()) -> list[Candidate]:
    """Candidate poses T_ab of known scale, refined, best first.

    Args:
        a, b: the storeys of the two maps.
        hypotheses: poses to refine beside those that are found.
        yaws: further yaws to try, rad.
    """
    found: list[Candidate] = [Candidate(h, 0.0, True) for h in hypotheses]
    for offset in heights([v.plan for v in a], [w.plan for w in b]):
        for v, w in pairs_at(a, b, offset):
            if len(v.walls) < 20 or len(w.walls) < 20:
                continue
            correlator = Correlator(v, w)
            for yaw in [*yaw_candidates(v.profile, w.profile), *yaws, *(h.yaw for h in hypotheses)]:
                for score, x, y in correlator.translations(yaw):
                    found.append(Candidate(Sim3(yaw, (x, y, offset)), score))
    found.sort(key=lambda c: (not c.given, -c.score))
    return refined(a, b, found[: KEPT + len(hypotheses)])


def refined(a: Sequence[View], b: Sequence[View], candidates: Sequence[Candidate], scaled: bool = False) -> list[Candidate]:
    """Candidates moved to where b's walls lie on those of a, without duplicates, best first."""
    out: list[Candidate] = []
    levels: dict[float, list[Candidate]] = {}
    for candidate in candidates:
        levels.setdefault(candidate.pose.translation[2], []).append(candidate)
    for offset, group in levels.items():
        pairs = [p for p in pairs_at(a, b, offset, group[0].pose.scale) if len(p[0].walls) and len(p[1].walls)]
        if pairs:
            out += _refined(*max(pairs, key=lambda p: min(len(p[0].walls), len(p[1].walls))), group, scaled)
    out.sort(key=lambda c: -c.score)
    return distinct(out, np.append(b[0].middle, 0.0))


def _refined(v: View, w: View, group: Sequence[Candidate], scaled: bool) -> list[Candidate]:
    walls = w.walls
    if len(walls) > SAMPLE:
        walls = walls[np.random.default_rng(0).permutation(len(walls))[:SAMPLE]]
    middle = walls.mean(axis=0)
    start = np.array([[*c.pose.apply(np.array([[*middle, 0.0]]))[0, :2], c.pose.yaw, np.log(c.pose.scale)] for c in group])
    poses, score = align.refine(walls - middle, *v.field, v.plan.cell, start, np.array(SIGMAS), 5, scaled)
    out = []
    for candidate, (x, y, yaw, size), value in zip(group, poses, score, strict=True):
        turned = Sim3(wrapped(yaw), (0.0, 0.0, 0.0), float(np.exp(size)))
        at = np.array([x, y]) - turned.apply(np.array([[*middle, 0.0]]))[0, :2]
        pose = replace(turned, translation=(float(at[0]), float(at[1]), candidate.pose.translation[2]))
        out.append(replace(candidate, pose=pose, score=float(value) / len(walls)))
    return out


def distinct(candidates: Iterable[Candidate], middle: Array, same: tuple[float, float, float] = SAME) -> list[Candidate]:
    """The first of each group of poses that are one: they agree about b's middle, the yaw and the scale."""
    kept: list[Candidate] = []
    at: list[Array] = []
    for candidate in candidates:
        here = np.append(candidate.pose.apply(middle[None])[0], [candidate.pose.yaw, np.log(candidate.pose.scale)])
        if not any(_same(here, other, same) for other in at):
            kept.append(candidate)
            at.append(here)
    return kept


def _same(p: Array, q: Array, same: tuple[float, float, float]) -> bool:
    return bool(
        np.abs(p[:2] - q[:2]).max() < same[0]
        and abs(p[2] - q[2]) < 2 * SAME_LEVEL
        and abs(wrapped(p[3] - q[3])) < same[1]
        and abs(p[4] - q[4]) < same[2]
    )
