"""Ctrl-C and SIGTERM leave through the `finally` clauses that delete half-written files.

While a kernel is compiled, the compiler calls Python back, and what is raised there is lost: the work went on as if nobody had
asked. So the signal waits until the compiler has returned.
"""

from __future__ import annotations

import os
import signal
from types import FrameType

COMPILER = f"{os.sep}llvmlite{os.sep}"
ASK_AGAIN = 0.1  # s


def leave_on_signals() -> None:
    """From now on SIGINT raises KeyboardInterrupt and SIGTERM SystemExit(143), but never within the compiler."""
    asked: list[int] = []

    def leave(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        if hasattr(signal, "setitimer") and _within_compiler(frame):
            signal.setitimer(signal.ITIMER_REAL, ASK_AGAIN)
        elif asked[0] == signal.SIGINT:
            raise KeyboardInterrupt
        else:
            raise SystemExit(143)

    for name in ("SIGINT", "SIGTERM", "SIGALRM"):
        if hasattr(signal, name):  # Windows has no alarm
            signal.signal(getattr(signal, name), leave)


def _within_compiler(frame: FrameType | None) -> bool:
    """Is any function on the stack the compiler's?"""
    while frame is not None and COMPILER not in frame.f_code.co_filename:
        frame = frame.f_back
    return frame is not None
