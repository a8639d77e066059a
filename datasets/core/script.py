"""What the scripts of this package have in common: lines are printed as they come, and a fault is one line and status 1."""

from __future__ import annotations

import sys
from collections.abc import Iterable

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
