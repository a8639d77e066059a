"""The folder of the real data, of which benchmarks draw plans and maps."""

from __future__ import annotations

import os
from pathlib import Path

from topomerge.errors import InputError


def real_data() -> Path:
    """The folder that TOPOMERGE_DATA names.

    Raises:
        InputError: it names none: without real plans, the same command would measure other pairs than those of the tables.
    """
    folder = os.environ.get("TOPOMERGE_DATA", "")
    if not Path(folder).is_dir() or not folder:
        raise InputError(f"TOPOMERGE_DATA must name the folder of the real data (it is {folder or 'not set'})")
    return Path(folder)
