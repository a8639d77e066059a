"""Translations of one plan in another, in many turned positions, by correlation of their rasters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from topomerge.matching.plan_fields import PlanFields
from topomerge.types import Array


@dataclass(frozen=True)
class SearchSettings:
    """Args:
    cell: m, of the correlated images; wider where maps are large.
    largest_image: cells along a side of them.
    conflict_weight: of a wall on free ground, against one on a wall.
    least_walls: columns of walls; storeys with fewer are not searched.
    height_gap: m by which offsets of heights differ at least.
    per_yaw: peaks of each yaw.
    peak_distance: m between these.
    hypotheses: that are refined, beside those of matched rooms.
    """

    cell: float = 0.2
    largest_image: int = 1300
    conflict_weight: float = 0.75
    least_walls: int = 20
    height_gap: float = 0.4
    per_yaw: int = 24
    peak_distance: float = 0.6
    hypotheses: int = 200


SEARCH = SearchSettings()


class Correlator:
    """Correlates one plan with another in many turned positions; what concerns the fixed one is transformed once."""

    def __init__(self, a: PlanFields, b: PlanFields, scale: float = 1.0) -> None:
        spans = [np.ptp(v.plan.points(v.plan.explored), axis=0) for v in (a, b)]
        reach = float(np.hypot(*spans[1])) * scale
        self.cell = max(SEARCH.cell, (float(spans[0].max()) + reach + 4) / SEARCH.largest_image)
        self.a, self.b = a, b
        self.low = a.plan.origin
        shape = np.array(a.plan.wall.shape) * a.plan.edge
        self.size = [fft.next_fast_len(int(np.ceil((s + reach) / self.cell)) + 4, real=True) for s in shape]
        wall = np.minimum(self._image(a.walls - self.low), 1.0)
        near = ndimage.gaussian_filter(wall, 0.2 / self.cell) * 2
        core = self._image(a.plan.points(a.core) - self.low) * (a.plan.edge / self.cell) ** 2
        self.agree = fft.rfft2(near - SEARCH.conflict_weight * np.minimum(core, 1.0))
        self.against = fft.rfft2(wall) * SEARCH.conflict_weight
        self.cores = b.plan.points(b.core)
        self.span = np.ceil(shape / self.cell)  # a shift beyond the fixed plan is one back

    def _image(self, points: Array) -> Array:
        cells = np.floor(points / self.cell).astype(np.int64)
        flat = cells[:, 0] * self.size[1] + cells[:, 1]
        image: Array = np.bincount(flat, minlength=self.size[0] * self.size[1]).reshape(self.size).astype(np.float32)
        return image

    def translations(self, yaw: float, number: int = SEARCH.per_yaw, scale: float = 1.0) -> list[tuple[float, float, float]]:
        """(score, x, y): the translations of T_ab at the best peaks that are `peak_distance` from each other."""
        c, s = scale * np.cos(yaw), scale * np.sin(yaw)
        turn = np.array([[c, s], [-s, c]])
        walls, cores = self.b.walls @ turn, self.cores @ turn
        low = np.concatenate([walls, cores]).min(axis=0)
        wall = np.minimum(self._image(walls - low), 1.0)
        core = np.minimum(self._image(cores - low) * (self.b.plan.edge * scale / self.cell) ** 2, 1.0)
        product = self.agree * np.conj(fft.rfft2(wall)) - self.against * np.conj(fft.rfft2(core))
        return self._peaks(fft.irfft2(product, self.size), self.low - low, number)

    def _peaks(self, image: Array, start: Array, number: int) -> list[tuple[float, float, float]]:
        pool = min(number * (2 * round(SEARCH.peak_distance / self.cell) + 1) ** 2, image.size - 1)
        flat = image.ravel()
        best = np.argpartition(flat, -pool)[-pool:]
        best = best[flat[best] > 0]
        best = best[np.lexsort((best, -flat[best]))]
        shift = np.column_stack(np.unravel_index(best, image.shape)).astype(float)
        shift = np.where(shift > self.span, shift - self.size, shift)
        peaks: list[tuple[float, float, float]] = []
        while len(best) and len(peaks) < number:
            x, y = (start + shift[0] * self.cell).tolist()
            peaks.append((float(flat[best[0]]), x, y))
            far = np.abs(shift - shift[0]).max(axis=1) * self.cell > SEARCH.peak_distance
            best, shift = best[far], shift[far]
        return peaks
