"""Poses of a single scan on the storeys of an atlas: looked for in large cells, ranked by a few of its columns, and described."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft, ndimage

from topomerge.fusion.atlas.place_index import COARSE_CELL, IndexedStorey, draw_points, turn_points
from topomerge.matching.poses import PlanFields, PoseHypothesis, wrap_yaw
from topomerge.registration.judge import Judge
from topomerge.registration.search import find_yaw_candidates
from topomerge.types import Array, Sim3

FARTHEST, CLEAR_WEIGHT, PEAKS = 30.0, 0.75, 16  # m of a scan that is searched by; of a wall on clear floor; of each yaw
FEATURES = (
    "sharp", "agree", "opposed", "conflict", "off", "missed", "blocked", "unlike_ceiling", "furniture", "moved", "level",
)  # fmt: skip
# As logarithms: a wall that was not seen, or a moved cupboard, says little more when it is large (docs/adr/0037).
AGAINST = slice(2, 7)  # of them
MOST_COLUMNS = 400.0  # of walls, of which more tell no more
WALL_ON_CLEAR, CLEAR_ON_WALL = 0.5, 2.0  # of shares of columns, against walls that meet


def search_coarsely(
    storeys: Sequence[IndexedStorey], query: PlanFields, most: int, of_storey: int
) -> list[tuple[float, int, Sim3]]:
    """Search storeys in large cells: score, number of the storey and pose without height, best first.

    Args:
        most: poses, at most.
        of_storey: ... of one storey.
    """
    found: list[tuple[float, int, Sim3]] = []
    turned = _TurnedQuery(query)
    for k, storey in enumerate(storeys):
        own = turned.correlate(storey)
        # Of each storey: right poses that were lost were 80th to 250th of all, but 9th at worst in their own (docs/adr/0037).
        found += [(score, k, pose) for score, pose in sorted(own, key=lambda f: -f[0])[:of_storey]]
    return sorted(found, key=lambda f: (-f[0], f[1]))[:most]


class _TurnedQuery:
    """A scan in large cells, at each turn and size of image once."""

    def __init__(self, query: PlanFields) -> None:
        self.query = query
        self.walls, self.clear = query.walls, query.plan.compute_points(query.core)
        both = np.concatenate([self.walls, self.clear])
        self.reach = min(float(np.hypot(*np.ptp(both, axis=0))), FARTHEST)
        self.cache: dict[tuple[int, tuple[int, int]], tuple[Array, Array, Array, float]] = {}

    def correlate(self, storey: IndexedStorey) -> list[tuple[float, Sim3]]:
        """Score, and pose without height, at the best peaks of each likely yaw."""
        coarse = storey.coarse
        nx, ny = (_find_size(n, self.reach) for n in coarse.walls.shape)
        room = ((0, nx - coarse.walls.shape[0]), (0, ny - coarse.walls.shape[1]))
        walls, clear = (np.pad(image, room) for image in (coarse.walls, coarse.clear))
        near = np.minimum(ndimage.gaussian_filter(walls, 0.6) * 1.6, 1.0)
        agree, against = fft.rfft2(near - CLEAR_WEIGHT * clear), fft.rfft2(walls) * CLEAR_WEIGHT
        found: list[tuple[float, Sim3]] = []
        for yaw in find_yaw_candidates(storey.directions, self.query.profile, 3):
            step = round(float(np.degrees(yaw - coarse.turn))) % 360
            own, free, low, total = self._draw(step, (nx, ny))
            image = fft.irfft2(agree * own - against * free, (nx, ny)) / total
            for score, i, j in _find_peaks(image, coarse.walls.shape):
                shift = coarse.low + np.array([i, j]) * COARSE_CELL - low
                x, y = turn_points(shift[None], coarse.turn)[0].tolist()
                found.append((score, Sim3(wrap_yaw(coarse.turn + np.radians(step)), (x, y, 0.0))))
        return found

    def _draw(self, step: int, size: tuple[int, int]) -> tuple[Array, Array, Array, float]:
        if (step, size) not in self.cache:
            walls, clear = (turn_points(points, np.radians(step)) for points in (self.walls, self.clear))
            low = np.concatenate([walls, clear]).min(axis=0)
            cells = (COARSE_CELL / self.query.plan.edge) ** 2
            drawn = draw_points(walls - low, size, 3.0), draw_points(clear - low, size, cells)
            spectra = [np.conj(fft.rfft2(image)) for image in drawn]
            self.cache[step, size] = (*spectra, low, max(float(drawn[0].sum()), 1.0))  # type: ignore[assignment]
        return self.cache[step, size]


def _find_size(cells: int, reach: float) -> int:
    """Cells of an image that holds a storey and a scan beside it; few different ones, so that much is shared."""
    return int(fft.next_fast_len(int(np.ceil((cells + reach / COARSE_CELL) / 16)) * 16, real=True))


def _find_peaks(image: Array, shape: tuple[int, ...]) -> list[tuple[float, int, int]]:
    """Score and shift, in cells, of the highest peaks; a shift beyond the storey is one back."""
    tops = np.where(image >= ndimage.maximum_filter(image, 3, mode="wrap"), image, -np.inf).ravel()
    best = np.argpartition(-tops, PEAKS)[:PEAKS]
    peaks = []
    for flat in best[np.lexsort((best, -tops[best]))].tolist():
        i, j = divmod(flat, image.shape[1])
        if np.isfinite(tops[flat]):
            peaks.append((float(tops[flat]), i - image.shape[0] * (i > shape[0]), j - image.shape[1] * (j > shape[1])))
    return peaks


def score_roughly(fields: PlanFields, query: PlanFields, poses: Sequence[PoseHypothesis], sample: int) -> list[float]:
    """Score refined poses by some columns: walls that meet, less walls of the scan on the map's clear floor, and less what the
    scan saw to be clear on the map's walls."""
    walls, clear = (points[:: max(len(points) // sample, 1)] for points in (query.walls, query.plan.compute_points(query.core)))
    return [
        pose.score
        - WALL_ON_CLEAR * _measure_share(walls, fields.core, fields, pose.transform)
        - CLEAR_ON_WALL * _measure_share(clear, fields.plan.wall, fields, pose.transform)
        for pose in poses
    ]


def _measure_share(points: Array, mask: Array, fields: PlanFields, pose: Sim3) -> float:
    """Share of points (n, 2) of a scan that lie on columns of a mask."""
    at = turn_points(points, pose.yaw) + pose.translation[:2]
    cells = np.floor((at - fields.plan.origin) / fields.plan.edge).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < mask.shape)).all(axis=1)]
    return float(mask[cells[:, 0], cells[:, 1]].sum()) / max(len(points), 1)


def compute_features(judge: Judge, hypothesis: PoseHypothesis) -> Array:
    """Compute (11,) `FEATURES` of a refined pose: shares of the scan's walls times the root of their number, as neighbours depend
    on each other, and what floor, ceiling and furniture show.

    Of what speaks against a pose logarithms count: one moved wall is as little as ten.
    """
    pose = hypothesis.transform
    seen, back = judge.tally(pose)
    features = judge(pose)
    column = judge.b[0].plan.edge ** 2
    total = max(float(seen[10]), column)
    root = float(np.sqrt(min(total / column, MOST_COLUMNS)))
    shares = np.array([seen[1], seen[2], seen[3], seen[0] - seen[1:4].sum(), back[0] - back[1] - back[2]]) / total
    clutter, met = seen[6] + back[6], seen[7] + back[7]
    by_chance = (seen[9] + back[9]) / max(float(seen[8] + back[8]), 1e-6)
    lift = float(met - by_chance * clutter) / 0.4
    blocked = (seen[4] - seen[5]) / max(float(seen[4]), 1e-6) * np.sqrt(min(seen[4] / column, 1000.0))
    ceiling = min(features["ceilings"], 0.4) * min(features["ceiling_area"] / 10.0, 1.0)
    rest = [blocked, ceiling, np.sign(lift) * np.log1p(abs(lift)), np.sqrt(max(float(clutter - met), 0.0) / 0.4)]
    found = np.array([hypothesis.score * root, *(shares * root), *rest, min(features["level"], 0.5)])
    found[AGAINST] = np.sign(found[AGAINST]) * np.log1p(np.abs(found[AGAINST]))
    return found
