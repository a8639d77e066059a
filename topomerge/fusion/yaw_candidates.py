"""Turns of one map against another under which their walls are parallel."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy import fft, ndimage

from topomerge.matching.plan_fields import DIRECTION_STEP
from topomerge.matching.poses import wrapped
from topomerge.types import Array

YAW_PEAKS = 10  # of the correlated direction profiles
QUARTER_PEAKS = 3  # peaks that are tried in all quarters,
QUARTER_GAP = np.radians(3.0)  # where no other peak is as near
SAME_YAW = np.radians(0.5)  # of two yaws that are nearer one is tried


def yaw_candidates(a: Array, b: Array, peaks: int = YAW_PEAKS) -> list[float]:
    """Yaws (rad) that turn b's direction profile into a's, best first; each with its half turn, the best ones in all quarters:
    where one map shows the walls of one direction only, those of the other direction are the nearest peak."""
    blur = 1.5 / DIRECTION_STEP
    a, b = (ndimage.gaussian_filter1d(p, blur / 2, mode="wrap") for p in (a, b))
    a, b = a / max(a.max(), 1e-9), b / max(b.max(), 1e-9)
    match = fft.irfft(fft.rfft(a) * np.conj(fft.rfft(b)), len(a))
    wide = ndimage.maximum_filter1d(match, int(4 / DIRECTION_STEP) + 1, mode="wrap")
    tops = np.flatnonzero((match >= wide) & (match > 0.1 * match.max()))
    tops = tops[np.argsort(-match[tops], kind="stable")][:peaks]
    yaws = []
    for k in tops:
        left, at, right = match[k - 1], match[k], match[(k + 1) % len(match)]
        bend = left - 2 * at + right
        shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
        yaws += [wrapped(np.radians((k + shift) * DIRECTION_STEP) + half) for half in (0.0, np.pi)]
    for yaw in yaws[: 2 * QUARTER_PEAKS]:
        aside = wrapped(yaw + np.pi / 2)
        if all(abs(wrapped(aside - other)) > QUARTER_GAP for other in yaws):
            yaws.append(aside)
    return yaws


def distinct_yaws(yaws: Iterable[float]) -> list[float]:
    """Those (rad) that are not near one before them: matched rooms often propose what the walls did."""
    out: list[float] = []
    for yaw in yaws:
        if all(abs(wrapped(yaw - other)) > SAME_YAW for other in out):
            out.append(yaw)
    return out
