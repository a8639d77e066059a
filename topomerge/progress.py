"""How work tells how far it is: steps of the method to whoever listens, and a command to the program that started it, by lines of
stderr, one for each step forward."""

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
Teller = Callable[[float, str], None]
_listener: ContextVar[Teller | None] = ContextVar("listener", default=None)


@contextmanager
def report_steps(tell: Teller | None) -> Iterator[None]:
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
    """Was this process started by one that wants to be told?"""
    return os.environ.get(PROGRESS_VARIABLE) == "lines"


def build_progress_teller(task: str) -> Teller:
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
