"""Windows, niches and cupboards of the maps that were joined -> those of the joined map (method 4).

Those that the joined cells show are not taken: walls that two maps show a little apart look like reveals, and the cells are
coarser than those in which they are seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from topomerge.extraction.elevations.fixtures import fixtures_in_map
from topomerge.extraction.elevations.windows import in_map, same_windows
from topomerge.fusion.resampling import Laying
from topomerge.types import FIXTURE_DTYPE, WINDOW_DTYPE, Array, TopometricMap
from topomerge.types.arrays import within_turn


def laid_windows(part: TopometricMap, laying: Laying) -> Array:
    """(W,) WINDOW_DTYPE of a part in the joined map, without rooms."""
    windows = _laid(part.windows, laying, ("width", "sill", "head"), np.pi)
    windows["rooms"] = -1
    return windows


def laid_fixtures(part: TopometricMap, laying: Laying) -> Array:
    """(F,) FIXTURE_DTYPE of a part in the joined map, without a room."""
    fixtures = _laid(part.fixtures, laying, ("width", "depth", "bottom", "top"), 2 * np.pi)
    fixtures["room"] = -1
    return fixtures


def _laid(rows: Array, laying: Laying, lengths: Sequence[str], full_turn: float) -> Array:
    """Rows with `centre` and `direction` in the joined map, the columns of lengths at its scale."""
    rows = rows.copy()
    if len(rows):
        rows["centre"] = laying.apply(rows["centre"])
        rows["direction"] = within_turn(rows["direction"] + laying.pose.yaw, full_turn)
        for name in lengths:
            rows[name] *= laying.pose.scale
    return rows


def with_joined_windows(joined: TopometricMap, parts: Sequence[Array]) -> TopometricMap:
    """The joined map with the windows of its parts, each once: as the part saw it that is the surest of it.

    Args:
        parts: WINDOW_DTYPE of `laid_windows`.
    """
    windows = np.concatenate([np.zeros(0, WINDOW_DTYPE), *parts])
    first = [int(group[0]) for group in same_windows(windows)]
    return replace(joined, windows=in_map(joined, windows[first]))


def with_joined_fixtures(joined: TopometricMap, parts: Sequence[Array]) -> TopometricMap:
    """The joined map, which has its windows, with the niches and cupboards of its parts, each once.

    Args:
        parts: FIXTURE_DTYPE of `laid_fixtures`.
    """
    rows = np.concatenate([np.zeros(0, FIXTURE_DTYPE), *parts])
    return replace(joined, fixtures=fixtures_in_map(joined, rows))
