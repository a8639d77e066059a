"""What scripts have in common: lines are printed as they come, a fault is one line and status 1, Ctrl-C is status 130."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable

from topomerge.errors import InputError


def print_lines(lines: Iterable[object]) -> int:
    """Print lines as they are made; the exit status of the script."""
    try:
        for line in lines:
            print(line, flush=True)
    except InputError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def exit_status(name: str, work: Callable[[], None], after_interrupt: str = "start it again to go on") -> int:
    """Do the work of a script; the exit status: 0 done, 1 a fault of the input, 130 interrupted.

    Args:
        name: of the script, before what it says.
        work: prints its results by itself.
        after_interrupt: what one may do after Ctrl-C.
    """
    try:
        work()
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"{name}: interrupted; {after_interrupt}", file=sys.stderr)
        return 130
    return 0
