"""Seconds a step, and news of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[[float, str], None]  # share of the work that is done, what is being done


class Stopwatch:
    """Measures steps: such as follow one another (`begin`, `end`; or `lap`), and such as come again and again (`measure`)."""

    def __init__(self, progress: Progress | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self.progress = progress
        self._step: str | None = None
        self.started = self._lap = self._began = time.perf_counter()

    def begin(self, step: str, done: float) -> None:
        """A step begins, at which this share of all work is done."""
        self.end()
        if self.progress is not None:
            self.progress(done, step)
        self._step, self._began = step, time.perf_counter()

    def end(self) -> dict[str, float]:
        """End the last step; returns step -> s."""
        if self._step is not None:
            self.seconds[self._step] = round(time.perf_counter() - self._began, 4)
        self._step = None
        return self.seconds

    def lap(self, step: str) -> None:
        """Add the seconds since the last lap, or since the stopwatch was made, to a step."""
        now = time.perf_counter()
        self.seconds[step] = self.seconds.get(step, 0.0) + now - self._lap
        self._lap = now

    @contextmanager
    def measure(self, step: str) -> Iterator[None]:
        """Add the seconds of a block to a step."""
        began = time.perf_counter()
        yield
        self.seconds[step] = self.seconds.get(step, 0.0) + time.perf_counter() - began

    def build_part_progress(self, begin: float, end: float) -> Progress | None:
        """News from within a step that takes the work from one share done to another."""
        if self.progress is None:
            return None
        progress = self.progress
        return lambda done, text: progress(begin + done * (end - begin), text)
