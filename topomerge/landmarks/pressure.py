"""What air pressure says of the storey, after the drift of the day.

Pressure falls by `FALL` a metre, and drifts by a storey's worth within an hour. Where both maps passed one place, the difference
of their readings is that of the day and of the two barometers: the same at all places, near 0 if the sessions overlap in time.
Sessions that are hours apart say only whether it is the same at all places.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from topomerge.landmarks.radio import MOST_RATIO, SAME_STOREY, STOREY_HEIGHT, WRONG
from topomerge.types import Array, Landmarks, Sim3, TopometricMap

FALL = 0.12  # hPa a metre
NOISE = 0.06  # hPa, standard deviation of the mean of a place
BAROMETERS = 0.15  # hPa, by which two of them differ (standard deviation)
DRIFT = 1e-4  # hPa a second, of the day
LEVEL = 0.5  # m of height, and
PLACE = 3.0  # m, of a place whose readings are averaged
NEAR = 5.0  # m between a place of a and one of b
CHANGED = 0.2  # probability that a pose on another place pairs two levels
MOST_PLACES = 10.0  # that count as independent: a session's noise is slow
POSSIBLE = (300.0, 1100.0)  # hPa


def score_pressure(a: TopometricMap, b: TopometricMap, pose: Sim3) -> dict[str, float]:
    """Score a pose T_ab by barometric pressure.

    Returns:
        Log likelihood ratio of each alternative of the posterior against this pose ("here": 0), below 0 where pressure speaks for
        this pose. Only "storey" (sessions near each other in time) and "elsewhere" (levels change at other places) are told.
    """
    scores = dict.fromkeys(("here", *WRONG), 0.0)
    places = _average_places(a.landmarks, Sim3()), _average_places(b.landmarks, pose)
    if not len(places[0]) or not len(places[1]):
        return scores
    difference, gap = _pair_places(*places)
    if not len(difference):
        return scores
    share = min(1.0, MOST_PLACES / len(difference))
    step, own = FALL * STOREY_HEIGHT, np.sqrt(2) * NOISE
    if np.isfinite(gap):
        sigma = np.sqrt(own**2 / (len(difference) * share) + BAROMETERS**2 + (DRIFT * gap) ** 2)
        scores["storey"] = _compare(np.array([difference.mean()]), step, sigma, 0.0)
    scores["elsewhere"] = share * _compare(difference - np.median(difference), step, own, 1 - CHANGED)
    return {name: float(np.clip(value, -MOST_RATIO, MOST_RATIO)) for name, value in scores.items()}


def _compare(difference: Array, step: float, sigma: float, same: float) -> float:
    """Log likelihood ratio of differences (n,), hPa, that are one step up or down, or 0 with a probability, against all 0."""
    one = [-0.5 * ((difference - shift) / sigma) ** 2 for shift in (0.0, -step, step)]
    shares = np.log(np.maximum([same, (1 - same) / 2, (1 - same) / 2], 1e-12))
    return float(np.sum(np.logaddexp.reduce([p + s for p, s in zip(one, shares, strict=True)]) - one[0]))


def _average_places(landmarks: Landmarks, pose: Sim3) -> Array:
    """(n, 5) x, y, z (m, under a pose), pressure (hPa) and time (s; nan: not known) of each place."""
    table = landmarks.table[landmarks.is_kind("pressure")]
    good = np.isfinite(table["position"]).all(axis=1) & (table["number"] > POSSIBLE[0]) & (table["number"] < POSSIBLE[1])
    table = table[good]
    if not len(table):
        return np.zeros((0, 5))
    values = np.column_stack([pose.apply(table["position"]), table["number"], table["time"]])
    cell = np.floor(values[:, :3] / (PLACE, PLACE, LEVEL)).clip(-1e9, 1e9).astype(np.int64)
    _, place = np.unique(cell, axis=0, return_inverse=True)
    place = place.ravel()
    return np.column_stack([np.bincount(place, column) for column in values.T]) / np.bincount(place)[:, None]


def _pair_places(a: Array, b: Array) -> tuple[Array, float]:
    """hPa by which b reads more than a at each place of b that a passed, too, and the least time, s, between the sessions."""
    stretched = [p[:, :3] * (1, 1, NEAR / SAME_STOREY) for p in (a, b)]
    distance, nearest = cKDTree(stretched[0]).query(stretched[1], distance_upper_bound=NEAR)
    met = np.isfinite(distance)
    first, second = a[nearest[met]], b[met]
    height = first[:, 2] - second[:, 2]
    times = np.abs(first[:, 4] - second[:, 4])
    gap = float(np.median(times[np.isfinite(times)])) if np.isfinite(times).any() else np.inf
    return second[:, 3] - first[:, 3] - FALL * height, gap
