"""How a command tells the program that started it how far it is: lines of stderr, one for each step forward."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable

PROGRESS_VARIABLE = "TOPOMERGE_PROGRESS"  # set to "lines" by who wants them
PROGRESS_MARK = "@progress "  # a line begins with this; JSON follows: task, share, text
EVERY = 0.1  # s between two lines of a task that does the same thing


def is_progress_asked() -> bool:
    """Was this process started by one that wants to be told?"""
    return os.environ.get(PROGRESS_VARIABLE) == "lines"


def build_progress_teller(task: str) -> Callable[[float, str], None]:
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
