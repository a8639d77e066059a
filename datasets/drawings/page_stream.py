"""Pages that a network learns from, drawn one after the other by processes beside it."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path

import numpy as np
from topomerge.datasets.drawings.pages import sample_drawing
from topomerge.datasets.drawings.shapes import DrawingRecipe, DrawingShapes, build_drawing_shapes

from topomerge.types import Array, LogFn

Page = tuple[Array, Array]  # (h, w, 3) picture and (h, w) classes, uint8
_shapes: list[DrawingShapes] = []  # of a process that draws


def _keep_shapes(shapes: Sequence[DrawingShapes]) -> None:
    _shapes[:] = shapes


def _load_shapes(recipe: DrawingRecipe, cache: str) -> None:
    _keep_shapes(build_drawing_shapes(recipe, cache))


def _draw_page(seed: tuple[int, int, int], side: int) -> Page:
    drawing = sample_drawing(_shapes, np.random.default_rng(seed), side)
    return drawing.picture, drawing.classes


class PageStream:
    """Pages, each from a seed of its own: the n-th page follows from the seed and n alone.

    Args:
        recipe: of the plans that are drawn; cache: folder of what is made of them.
        side: px.
        jobs: processes that draw; 1: drawn here. They read the plans themselves; sent them, they would start in turn.
    """

    def __init__(
        self, recipe: DrawingRecipe, cache: str | Path, seed: tuple[int, int], side: int, jobs: int, log_line: LogFn
    ) -> None:
        self.shapes = build_drawing_shapes(recipe, cache, log_line)
        self.seed, self.side, self.jobs = seed, side, jobs
        spawn = multiprocessing.get_context("spawn")
        self.pool = ProcessPoolExecutor(jobs, spawn, _load_shapes, (recipe, str(cache))) if jobs > 1 else None

    def iter_pages(self, start: int, stop: int | None = None) -> Iterator[Page]:
        """Yield the pages from number `start` on."""
        if self.pool is None:
            _keep_shapes(self.shapes)
        coming: deque[Future[Page]] = deque()
        number = start
        while stop is None or number < stop or coming:
            while self.pool is not None and len(coming) < 4 * self.jobs and (stop is None or number < stop):
                coming.append(self.pool.submit(_draw_page, (*self.seed, number), self.side))
                number += 1
            if coming:
                yield coming.popleft().result()
            else:
                yield _draw_page((*self.seed, number), self.side)
                number += 1

    def close(self) -> None:
        """Stop the processes."""
        if self.pool is not None:
            self.pool.shutdown(cancel_futures=True)
