"""Evidence of access points in reach: readings as scans, how alike two scans are, and how that falls off with distance.

A scan is what was heard at one place: addresses and their strengths, dBm. Two scans are compared by the cosine of powers of their
readings, which a receiver's gain does not change; addresses that are heard everywhere, or at places far from each other, count
less. The law of it, on one storey and through floors, was fitted on real walks (`RADIO_LAW_FILE`; ``train.py task=radio_law``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from topomerge.archive import read_weights_json
from topomerge.errors import InputError
from topomerge.types import Array, Landmarks, Sim3, TopometricMap

RADIO_LAW_FILE = "radio_law.json"
WRONG = ("elsewhere", "storey", "half", "wing", "building", "outside")  # alternatives of `registration.posterior`
FLOOR, LOUDEST, POSSIBLE = -95.0, -40.0, (-130.0, 20.0)  # dBm: no weaker reading counts, no stronger one counts more; of readings
DECADE = 12.0  # dB by which the power of a reading grows by e
SPREAD = 20.0  # m, standard deviation of the places at which one address is loud: a wider one moves, or is two
LOUD_SHARE = 0.5  # of an address's greatest power, from which on it is loud
MOST_SCANS, MOST_ADDRESSES = 1000, 4096  # of a map; in common
POOLED = 2.0  # m, standard deviation of the bell by which scans of one map are pooled
PLACE = 3.0  # m: scans nearer than this to each other are one place
STOREY_HEIGHT, SAME_STOREY = 3.5, 1.9  # m between floors; heights that differ by less are of one storey
DISTANCE_EDGES = np.array([0, 2, 4, 6, 8, 10, 13, 16, 20, 25, 30, 40, 60, 100.0])  # m, of the law; the last class is open
LIKENESS_EDGES = np.array([0.005, 0.02, *np.arange(0.05, 0.8, 0.05), 0.8, 0.84, 0.88, 0.91, 0.94, 0.97])
APART = 3  # storeys: the same, the next, further ones
FINE = 0.5  # m, to which distances are told apart
NEAR = 20.0  # m: pairs of scans that a pose puts nearer than this testify
WING, OUTSIDE = (15.0, 60.0), (20.0, 100.0)  # m from where b's scans seem to be to where they are, by these alternatives
SHIFTS, DIRECTIONS = (12.0, 25.0, 45.0), 8  # m, by which a pose may be off, and to how many sides
STRETCHES = (0.6, 1.0, 1.7)  # metres of the mall that a metre of another building may be worth: walls stand closer, or further
LEAKY, LEAKY_DISTANCE = 0.1, 10.0  # probability that a floor of another building is as light as so many m of one storey
REPLACED = 0.02  # probability that all access points were replaced between two maps
FOREIGN = 0.02  # probability that two scans of two buildings are alike at all
N_POSE_FEATURES = 4
MOST_RATIO = 8.0  # of a log likelihood ratio: radio never says more
SUSPECTS = 3  # addresses that say the most: what is left without any one of them is believed


@dataclass(frozen=True, eq=False)
class RadioScans:
    """Scans of one map.

    Args:
        position: (n, 3) m; nan: not known.
        power: (n, k) sparse, power of each address in each scan, from 0.
        addresses: (k) in lower case.
        storey: (n,) of the landmarks, -1: not known.
    """

    position: Array
    power: sparse.csr_matrix
    addresses: tuple[str, ...]
    storey: Array

    def __len__(self) -> int:
        return len(self.position)

    def select(self, rows: Array) -> RadioScans:
        """Return some of the scans."""
        return replace(self, position=self.position[rows], power=self.power[rows], storey=self.storey[rows])

    @cached_property
    def share(self) -> Array:
        """(n,) one over how many scans of this map stand at the same place: places, not scans, are independent."""
        if not len(self):
            return np.zeros(0)
        tree = cKDTree(self.position)
        return 1.0 / np.maximum(tree.query_ball_point(self.position, PLACE, return_length=True), 1)


def collect_radio_scans(landmarks: Landmarks, placed: bool = True, most: int = MOST_SCANS) -> RadioScans:
    """Collect readings into scans.

    Readings of one group, source and place are one scan; of an address that it holds twice the stronger one counts. Readings that
    are no possible strength are left out.

    Args:
        landmarks: of any kinds.
        placed: leave out scans whose place is not known.
        most: so many scans are kept, evenly out of all.
    """
    table = landmarks.table[landmarks.is_kind("radio")]
    good = (table["number"] > POSSIBLE[0]) & (table["number"] < POSSIBLE[1])
    good &= np.isfinite(table["position"][:, :2]).all(axis=1) | (not placed)
    good &= landmarks.get_values()[landmarks.is_kind("radio")] != ""  # RTAB-Map knows no addresses
    table = table[good]
    names: dict[str, int] = {}
    column = np.array([names.setdefault(v.strip().lower(), len(names)) for v in landmarks.values], np.int64)
    first, scan = np.unique(_hash_scans(table), return_index=True, return_inverse=True)[1:]
    power = np.expm1((np.clip(table["number"], FLOOR, LOUDEST) - FLOOR) / DECADE)
    cell = scan * max(len(names), 1) + column[table["value"]] if len(table) else np.zeros(0, np.int64)
    order = np.lexsort((power, cell))
    last = order[np.append(np.diff(cell[order]) > 0, True)] if len(order) else order
    matrix = sparse.csr_matrix((power[last], (scan[last], column[table["value"][last]])), shape=(len(first), len(names)))
    rows = np.argsort(first, kind="stable")  # in the order of the landmarks
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, most).round().astype(int))] if len(rows) > most else rows
    position = table["position"][first[rows]].reshape(-1, 3)
    heights = position[np.isfinite(position[:, 2]), 2]
    position[:, 2] = np.where(np.isfinite(position[:, 2]), position[:, 2], np.median(heights) if len(heights) else 0.0)
    return RadioScans(position, matrix[rows], tuple(names), table["storey"][first[rows]])


def _hash_scans(table: Array) -> Array:
    """Return (n,) int64 that is equal for readings of one scan: of one group, source and place."""
    place = np.nan_to_num(table["position"], nan=0.0, posinf=0.0, neginf=0.0)
    columns = [table["group"], table["source"], *np.round(np.clip(place, -1e9, 1e9) * 100).T]
    code = np.zeros(len(table), np.uint64)
    for values in columns:
        code = (code ^ values.astype(np.int64).view(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        code ^= code >> np.uint64(29)
    return code.view(np.int64)


@dataclass(frozen=True, eq=False)
class Likeness:
    """How alike the scans of two maps are.

    Args:
        a, b: (n, k), (m, k) float32, weighted powers of the addresses that both know.
        square: (n,), (m,) squares of the lengths, of all addresses.
    """

    a: Array
    b: Array
    square: tuple[Array, Array]

    def compute(self, without: int = -1) -> Array:
        """Compute (n, m) float32 cosines; of all addresses, or without one of those that both know."""
        dot, squares = self.a @ self.b.T, self.square
        if without >= 0:
            left, right = self.a[:, without], self.b[:, without]
            dot = dot - np.outer(left, right)
            squares = squares[0] - left**2, squares[1] - right**2
        length = np.sqrt(np.outer(np.maximum(squares[0], 1e-9), np.maximum(squares[1], 1e-9)))
        return np.asarray(np.clip(dot / length, 0.0, 1.0), np.float32)

    def find_suspects(self, near: Array) -> list[int]:
        """Find the addresses that say the most of pairs (n, m) of scans that a pose puts near each other."""
        lengths = [np.sqrt(np.maximum(s, 1e-9))[:, None] for s in self.square]
        total = ((self.a / lengths[0]) * (near.astype(np.float32) @ (self.b / lengths[1]))).sum(axis=0)
        order = np.argsort(-total, kind="stable")[:SUSPECTS]
        return [int(k) for k in order if total[k] > 0]


def compare_scans(a: RadioScans, b: RadioScans) -> Likeness:
    """Compare the scans of two maps, each pooled with those of its map around it: one scan misses much of what can be heard."""
    column = {name: k for k, name in enumerate(b.addresses)}
    common = [(k, column[name]) for k, name in enumerate(a.addresses) if name in column]
    left, right = (np.array([pair[side] for pair in common], np.int64) for side in (0, 1))
    weights = [_compute_address_weights(scans) for scans in (a, b)]
    both = np.sqrt(weights[0][left] * weights[1][right])
    weights[0][left] = weights[1][right] = both
    totals = [weight * np.asarray(scans.power.sum(axis=0)).ravel() for scans, weight in zip((a, b), weights, strict=True)]
    most = np.sort(np.argsort(-np.minimum(totals[0][left], totals[1][right]), kind="stable")[:MOST_ADDRESSES])
    parts, squares = [], []
    for scans, weight, own, total in zip((a, b), weights, (left[most], right[most]), totals, strict=True):
        rest = np.setdiff1d(np.argsort(-total, kind="stable")[: 2 * MOST_ADDRESSES], own)[:MOST_ADDRESSES]
        pooled = [
            (_build_pooling(scans.position) @ (scans.power[:, at].multiply(weight[None, at]).toarray())).astype(np.float32)
            for at in (own, rest)
        ]
        parts.append(pooled[0])
        squares.append(sum((part**2).sum(axis=1) for part in pooled))
    return Likeness(parts[0], parts[1], (squares[0], squares[1]))


def _build_pooling(position: Array) -> sparse.csr_matrix:
    """Build the (n, n) weights of the scans around each scan, that sum to 1; bell-shaped, of standard deviation `POOLED`."""
    near = cKDTree(position).query_pairs(2.5 * POOLED, output_type="ndarray")
    i = np.concatenate([near[:, 0], near[:, 1], np.arange(len(position))])
    j = np.concatenate([near[:, 1], near[:, 0], np.arange(len(position))])
    weight = np.exp(-((position[i] - position[j]) ** 2).sum(axis=1) / (2 * POOLED**2))
    matrix = sparse.csr_matrix((weight, (i, j)), shape=(len(position), len(position)))
    return sparse.diags(1 / np.asarray(matrix.sum(axis=1)).ravel()) @ matrix


def _compute_address_weights(scans: RadioScans) -> Array:
    """Return the (k,) weights of addresses: less for what is heard everywhere, and for what is loud at places far from each
    other."""
    power, n = scans.power, max(len(scans), 1)
    top = power.max(axis=0).toarray().ravel() if len(scans) and power.shape[1] else np.zeros(power.shape[1])
    mean = np.asarray(power.sum(axis=0)).ravel() / n
    rare = np.sqrt(np.log1p(top / np.maximum(mean, 1e-9)))
    loud = power.tocoo()
    pick = loud.data >= LOUD_SHARE * top[loud.col]
    row, col = loud.row[pick], loud.col[pick]
    count = np.maximum(np.bincount(col, minlength=len(top)), 1)
    place = np.nan_to_num(scans.position[:, :2])
    place = place - (place.mean(axis=0) if len(place) else 0.0)
    variance = np.zeros(len(top))
    for axis in (0, 1):
        x = place[row, axis]
        mean_x = np.bincount(col, x, minlength=len(top)) / count
        variance += np.maximum(np.bincount(col, x**2, minlength=len(top)) / count - mean_x**2, 0.0)
    weight: Array = rare / (1 + variance / SPREAD**2)
    return weight


@dataclass(frozen=True, eq=False)
class RadioLaw:
    """How alike two scans are at a distance.

    Args:
        log_density: (APART, D, K) log probability of each class of likeness, by storeys apart and class of distance.
        discount: factor of log likelihoods, as pairs of scans are not independent; `pose_discount` that of positions.
        blur: m, standard deviation of a pose beside what its likelihood says: positions of scans are not exact.
        pose_odds: weights of the log odds that a pose is right, of `radio_search.compute_pose_features`; empty: not fitted.
    """

    log_density: Array
    discount: float = 1.0
    pose_discount: float = 1.0
    blur: float = 0.5
    pose_odds: tuple[float, ...] = ()

    @cached_property
    def fine(self) -> Array:
        """(APART, F, K) log probability at every `FINE` m."""
        middles = np.append((DISTANCE_EDGES[:-1] + DISTANCE_EDGES[1:]) / 2, DISTANCE_EDGES[-1] * 1.2)
        at = np.arange(0.0, middles[-1] + FINE, FINE)
        shape = (APART, len(at), self.log_density.shape[2])
        out = np.empty(shape)
        for s in range(shape[0]):
            for k in range(shape[2]):
                out[s, :, k] = np.interp(at, middles, self.log_density[s, :, k])
        return out

    def mix(self, shares: Array, apart: int = 0) -> Array:
        """Return (K,) log probabilities at a mixture of distances, (F,) shares of the fine ones."""
        return np.asarray(np.log(shares / shares.sum() @ np.exp(self.fine[apart])))

    def mix_between(self, low: float, high: float) -> Array:
        """Return (K,) log probabilities at distances of one storey between two, m."""
        at = np.arange(self.fine.shape[1]) * FINE
        return self.mix(((at >= low) & (at <= high)).astype(float))

    @cached_property
    def floors(self) -> Array:
        """(APART, F, K) as `fine`, for floors that may be lighter than those of the mall."""
        step = int(LEAKY_DISTANCE / FINE)
        out = self.fine.copy()
        for s in range(1, APART):
            further = self.fine[0][np.minimum(np.arange(out.shape[1]) + s * step, out.shape[1] - 1)]
            out[s] = np.logaddexp(np.log1p(-LEAKY) + out[s], np.log(LEAKY) + further)
        return out


def classify_likeness(likeness: Array) -> Array:
    """Return the class of each likeness, of the law."""
    return np.digitize(likeness, LIKENESS_EDGES)


def convert_law(data: Mapping[str, Any]) -> RadioLaw:
    """Convert what stands in a file of a law.

    Raises:
        InputError: damaged.
    """
    try:
        density = np.array(data["log_density"], float)
        odds = tuple(float(weight) for weight in data["pose_odds"])
        law = RadioLaw(density, float(data["discount"]), float(data["pose_discount"]), float(data["blur"]), odds)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{RADIO_LAW_FILE}: not the law of this version ({error}); install the package again") from error
    numbers = np.array([law.discount, law.pose_discount, law.blur])
    right = density.shape == (APART, len(DISTANCE_EDGES), len(LIKENESS_EDGES) + 1) and bool(np.isfinite(density).all())
    right &= len(odds) == N_POSE_FEATURES and bool(np.isfinite(odds).all())
    if not right or not (np.isfinite(numbers) & (numbers > 0)).all():
        raise InputError(f"{RADIO_LAW_FILE}: not the law of this version; install the package again")
    return law


@cache
def load_radio_law() -> RadioLaw:
    """Load the law that ships, or the one in its place.

    Raises:
        InputError: damaged.
    """
    return convert_law(read_weights_json("topomerge.landmarks", RADIO_LAW_FILE))


def measure_apart(a: Array, b: Array) -> tuple[Array, Array]:
    """Measure the distance, m in the plane, and the storeys (0, 1, 2 or more) between positions (n, 3) and (m, 3)."""
    distance = np.sqrt((a[:, None, 0] - b[None, :, 0]) ** 2 + (a[:, None, 1] - b[None, :, 1]) ** 2)
    height = np.abs(a[:, None, 2] - b[None, :, 2])
    apart = np.where(height < SAME_STOREY, 0, np.clip(np.round(height / STOREY_HEIGHT), 1, APART - 1))
    return distance, apart.astype(np.int64)


def score_radio(a: TopometricMap, b: TopometricMap, pose: Sim3, law: RadioLaw | None = None) -> dict[str, float]:
    """Score a pose by radio.

    Args:
        pose: T_ab, takes b into a.
        law: None: the one that ships.

    Returns:
        Log likelihood ratio of each alternative of the posterior against this pose ("here": 0); all 0 where radio says nothing.
        Below 0 speaks for this pose. None is beyond `MOST_RATIO`, and none rests on one address.
    """
    law = law or load_radio_law()
    scans = collect_radio_scans(a.landmarks), collect_radio_scans(b.landmarks)
    return score_scans(*scans, pose, law)


def score_scans(a: RadioScans, b: RadioScans, pose: Sim3, law: RadioLaw) -> dict[str, float]:
    """Score a pose T_ab of scans, as `score_radio`."""
    nothing = dict.fromkeys(("here", *WRONG), 0.0)
    if not len(a) or not len(b):
        return nothing
    moved = pose.apply(b.position)
    apart = measure_apart(a.position, moved)
    middle = a.position.mean(axis=0) * 2
    half = measure_apart(a.position, np.column_stack([middle[:2] - moved[:, :2], moved[:, 2]]))
    near = (apart[0] < NEAR) & (apart[1] == 0)
    if not near.any():
        return nothing
    i, j = np.nonzero(near)
    gap = a.position[i, :2] - moved[j, :2]
    shifted = [[np.hypot(*(gap - shift).T) for shift in _build_shifts(size)] for size in SHIFTS]
    likeness = compare_scans(a, b)
    shares = np.outer(a.share, b.share)
    suspects = likeness.find_suspects(near)
    scores = [_compare_alternatives(likeness.compute(k), apart, half[0], shifted, shares, law) for k in (-1, *suspects)]
    out = np.array([[score[name] for name in WRONG] for score in scores])
    if not suspects:  # no address in common: of one only, nothing is left
        least = out[0]
    else:  # what is left without any one of them
        least = np.where((out > 0).all(axis=0), out.min(axis=0), np.where((out < 0).all(axis=0), out.max(axis=0), 0.0))
    return {"here": 0.0, **dict(zip(WRONG, np.clip(least, -MOST_RATIO, MOST_RATIO).tolist(), strict=True))}


def _build_shifts(size: float) -> Array:
    angle = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    return size * np.column_stack([np.cos(angle), np.sin(angle)])


def _compare_alternatives(
    likeness: Array, apart: tuple[Array, Array], half: Array, shifted: Sequence[Sequence[Array]], shares: Array, law: RadioLaw
) -> dict[str, float]:
    """Return the log likelihood ratio of each of `WRONG` against this pose, before it is limited.

    Args:
        half: (n, m) m between scans, were b turned by half a turn.
        shifted: for each of `SHIFTS` and each direction, (p,) m between the pairs that are near, were b shifted so.
    """
    kind = classify_likeness(likeness)
    near = (apart[0] < NEAR) & (apart[1] == 0)
    k, w, last = kind[near], shares[near], law.fine.shape[1] - 1
    places = min(float((shares * near).max(axis=1).sum()), float((shares * near).max(axis=0).sum()))

    def add(log_density: Array) -> float:
        """Return the log likelihood of places that testify once each, by the mean of their pairs."""
        return law.discount * places * float(np.average(log_density, weights=w))

    def at(distance: Array, table: Array = law.fine[0]) -> float:
        """Return the log likelihood if pairs are that far apart, whatever a metre of this building is worth."""
        steps = [np.minimum((distance * stretch / FINE).astype(int), last) for stretch in STRETCHES]
        return float(np.logaddexp.reduce([add(table[step, k]) for step in steps]) - np.log(len(STRETCHES)))

    foreign = np.full(len(LIKENESS_EDGES) + 1, np.log(FOREIGN / len(LIKENESS_EDGES)))
    foreign[0] = np.log1p(-FOREIGN)
    other = add(foreign[k])

    def choose(*parts: float) -> float:
        """Return the log likelihood of models that are alike likely, unless all access points were replaced."""
        mean = np.logaddexp.reduce(parts) - np.log(len(parts))
        return float(np.logaddexp(np.log1p(-REPLACED) + mean, np.log(REPLACED) + other))

    here = choose(at(apart[0][near]))
    far = (apart[0] >= DISTANCE_EDGES[5]) & (apart[1] == 0)
    steps = np.minimum((apart[0][far] / FINE).astype(int), last)
    usual = law.mix(np.bincount(steps, shares[far], minlength=last + 1)) if far.any() else law.mix_between(*WING)
    shown = np.bincount(kind[far], shares[far], minlength=len(foreign))
    own = add(np.log((shown + np.exp(usual)) / (shown.sum() + 1))[k])  # as alike as the other pairs of these maps are
    moved = [choose(*(at(distance) for distance in directions)) for directions in shifted]
    out = {
        "elsewhere": choose(add(usual[k]), own, *moved),
        "storey": choose(at(apart[0][near], law.floors[1])),
        "half": choose(at(half[near])),
        "wing": choose(add(law.mix_between(*WING)[k]), own, *moved[1:]),
        "building": other,
        "outside": choose(add(law.mix_between(*OUTSIDE)[k]), own, *moved[1:]),
    }
    return {name: value - here for name, value in out.items()}
