"""How work tells how far it is and how long it takes: steps of the method to whoever listens, and a command to the program that
started it, by lines of stderr, one for each step forward."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

PROGRESS_VARIABLE = "TOPOMERGE_PROGRESS"  # set to "lines" by who wants them
PROGRESS_MARK = "@progress "  # a line begins with this; JSON follows: task, share, text
EVERY = 0.1  # s between two lines of a task that does the same thing
Progress = Callable[[float, str], None]  # share of the work that is done, what is being done
_listener: ContextVar[Progress | None] = ContextVar("listener", default=None)


@contextmanager
def report_steps(tell: Progress | None) -> Iterator[None]:
    """Report the steps that are told within the context (`tell_step`); None: to nobody."""
    token = _listener.set(tell)
    try:
        yield
    finally:
        _listener.reset(token)


def tell_step(share: float, text: str) -> None:
    """Tell which step begins, and the share of the work that is done, if anybody listens."""
    tell = _listener.get()
    if tell is not None:
        tell(share, text)


def is_progress_asked() -> bool:
    """Return whether this process was started by one that wants to be told."""
    return os.environ.get(PROGRESS_VARIABLE) == "lines"


def build_progress_teller(task: str) -> Progress:
    """Build what tells the share of a task that is done, and what is being done."""
    last: tuple[float, str] = (0.0, "")

    def tell(share: float, text: str = "") -> None:
        nonlocal last
        now = time.monotonic()
        if share < 1 and text == last[1] and now - last[0] < EVERY:
            return
        last = now, text
        listed = {"task": task, "share": round(min(max(float(share), 0.0), 1.0), 4), "text": text}
        sys.stderr.write(f"{PROGRESS_MARK}{json.dumps(listed)}\n")
        sys.stderr.flush()

    return tell


class Stopwatch:
    """Measures steps: such as follow one another (`begin`, `end`; or `lap`), and such as come again and again (`measure`)."""

    def __init__(self, progress: Progress | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self.progress = progress
        self._step: str | None = None
        self._started = self._lap = self._began = time.perf_counter()

    def begin(self, step: str, done: float) -> None:
        """Begin a step, at which this share of all work is done."""
        self.end()
        if self.progress is not None:
            self.progress(done, step)
        self._step, self._began = step, time.perf_counter()

    def end(self) -> dict[str, float]:
        """End the last step; return step -> s."""
        if self._step is not None:
            self.seconds[self._step] = round(time.perf_counter() - self._began, 4)
        self._step = None
        return self.seconds

    @property
    def elapsed(self) -> float:
        """Seconds since the stopwatch was made."""
        return time.perf_counter() - self._started

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
        """Build the progress for news from within a step that takes the work from one share done to another."""
        if self.progress is None:
            return None
        progress = self.progress
        return lambda done, text: progress(begin + done * (end - begin), text)
