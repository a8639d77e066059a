"""Windows of the maps that were joined -> windows of the joined map (method 4).

Those that the joined cells show are not taken: walls that two maps show a little apart look like reveals, and the cells are
coarser than those in which windows are seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from topomerge.extraction.elevations.windows import in_map, same_windows
from topomerge.fusion.resampling import Laying
from topomerge.types import WINDOW_DTYPE, Array, TopometricMap


def laid_windows(part: TopometricMap, laying: Laying) -> Array:
    """(W,) WINDOW_DTYPE of a part in the joined map, without rooms."""
    windows = part.windows.copy()
    windows["rooms"] = -1
    if len(windows):
        windows["centre"] = laying.apply(windows["centre"])
        windows["direction"] = (windows["direction"] + laying.pose.yaw) % np.pi
        for name in ("width", "sill", "head"):
            windows[name] *= laying.pose.scale
    return windows


def with_joined_windows(joined: TopometricMap, parts: Sequence[Array]) -> TopometricMap:
    """The joined map with the windows of its parts, each once: as the part saw it that is the surest of it.

    Args:
        parts: WINDOW_DTYPE of `laid_windows`.
    """
    windows = np.concatenate([np.zeros(0, WINDOW_DTYPE), *parts])
    first = [int(group[0]) for group in same_windows(windows)]
    return replace(joined, windows=in_map(joined, windows[first]))
