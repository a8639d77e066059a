"""Poses and places from radio alone: which pose lays scans on those that are alike, and which map or storey readings are from.

The best partners of each scan vote for a turn and a shift (Hough 1962; Ballard 1981); each of the best ones is refined by the law
of likeness over all pairs of scans, first up to `COARSE` and then up to `EXACT`: what is alike at larger distances differs from
place to place, and would bend the pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, sparse

from topomerge.landmarks.radio import (
    FINE,
    LIKENESS_EDGES,
    PLACE,
    STRETCHES,
    RadioLaw,
    RadioScans,
    classify_likeness,
    collect_radio_scans,
    compare_scans,
    load_radio_law,
)
from topomerge.types import Array, Landmarks, Sim3, TopometricMap

PARTNERS = 3  # of each scan, that vote
TURN, CELL = np.radians(2.5), 4.0  # rad and m: of the votes
TURNS_APART, CELLS_APART = np.radians(15.0), 10.0  # poses that differ by less are one: rad and, of b's middle, m
COARSE, EXACT = 25.0, 13.0  # m, up to which pairs of scans tell a pose
REFINED = 400  # scans of a map, by which candidates are refined
LEAST_PLACES = 3  # of each map: fewer have no turn
RIGHT = 5.0  # m that b's scans may be off in the mean
# Probability from which on a pose is told as sure: 55 of 240 trials on storeys that were left out, none of these wrong.
SURE = 0.95
LIKELY, EXACT_ENOUGH = 0.9, 2.5  # chance, and m of the standard deviation of b's middle, from which on a pose is tried on walls


@dataclass(frozen=True, eq=False)
class RadioPose:
    """A pose that radio proposes; iterates as ``pose, score``.

    Args:
        pose: T_ab.
        score: log likelihood ratio against scans that have nothing to do with each other.
        probability: that b's scans lie within `RIGHT` of where they are.
        covariance: (3, 3) of x, y (m, of the middle of b's scans) and yaw (rad).
        sigma: standard deviation of where b's scans lie, m.
        places: that the map with fewer has: how much testifies.
        chance: that this is the pose, and not another one or none, by the law alone.
    """

    pose: Sim3
    score: float
    probability: float
    covariance: Array
    sigma: float
    places: float
    chance: float

    def __iter__(self) -> Iterator[Sim3 | float]:
        return iter((self.pose, self.score))

    @property
    def is_sure(self) -> bool:
        """Is it told as sure?"""
        return self.probability >= SURE

    @property
    def is_worth_trying(self) -> bool:
        """Is it proposed to a search of walls, which tell more?"""
        return self.chance >= LIKELY and float(np.sqrt(max(np.trace(self.covariance[:2, :2]), 0.0))) <= EXACT_ENOUGH


def compute_pose_features(poses: Sequence[RadioPose]) -> Array:
    """Compute (4,) features of the odds that the likeliest of some poses is right: 1, and the logarithms of its standard
    deviation, of its score above the next one's, and of how many places testify.

    The law alone is too sure where few do: what is alike at a distance differs from place to place, and a walk's readings share
    one phone and one way of laying them out.
    """
    best, rivals = poses[0], [pose.score for pose in poses[1:2]]
    margin = best.score - max([0.0, *rivals])
    return np.array([1.0, *np.log([best.sigma, max(margin, 0.1), max(best.places, 1.0)])])


def propose_radio_poses(a: TopometricMap, b: TopometricMap, n: int = 5, law: RadioLaw | None = None) -> list[RadioPose]:
    """Propose poses T_ab by radio alone, likeliest first; upright, of one scale.

    Args:
        n: so many at most.
        law: None: the one that ships.
    """
    return propose_scan_poses(collect_radio_scans(a.landmarks), collect_radio_scans(b.landmarks), n, law or load_radio_law())


def propose_scan_poses(a: RadioScans, b: RadioScans, n: int, law: RadioLaw) -> list[RadioPose]:
    """Propose poses of scans, as `propose_radio_poses`."""
    if min(a.share.sum(), b.share.sum()) < LEAST_PLACES:
        return []
    likeness = compare_scans(a, b).compute()
    if not (likeness > LIKENESS_EDGES[0]).any():
        return []
    middle = b.position.mean(axis=0)
    height = _find_height(likeness, a.position[:, 2], b.position[:, 2])
    search = _Search(likeness, a, b, middle, law)
    starts = search.vote(2 * n)
    search.choose_stretch(starts)
    coarse = _keep_best([search.refine_coarsely(start) for start in starts])
    kept = _keep_best([search.refine(at) for at, _ in coarse[: max(n, 2)]])
    chances = np.exp(law.pose_discount * np.array([score for _, score in kept] + [0.0]) - law.pose_discount * max(kept[0][1], 0))
    chances /= chances.sum()
    poses, places = [], min(float(scans.share.sum()) for scans in (a, b))
    for (at, score), p in zip(kept, chances, strict=False):
        covariance = search.measure_covariance(at)
        sigma = float(np.sqrt(max(np.trace(covariance[:2, :2]) + covariance[2, 2] * search.reach**2, 0.0)))
        poses.append(RadioPose(_build_pose(at, middle, height), score, float(p), covariance, sigma, places, float(p)))
    if law.pose_odds:
        right = 1 / (1 + np.exp(-compute_pose_features(poses) @ law.pose_odds))
        share = min(float(right) / max(poses[0].probability, 1e-9), 1.0)
        poses = [replace(pose, probability=pose.probability * share) for pose in poses]
    return poses[:n]


def _keep_best(found: Sequence[tuple[Array, float]]) -> list[tuple[Array, float]]:
    """Keep poses by falling score, each but once."""
    kept: list[tuple[Array, float]] = []
    for at, score in sorted(found, key=lambda r: -r[1]):
        if all(not _is_same(at, other) for other, _ in kept):
            kept.append((at, score))
    return kept


def _is_same(a: Array, b: Array) -> bool:
    turn = abs((a[2] - b[2] + np.pi) % (2 * np.pi) - np.pi)
    return bool(turn < TURNS_APART and np.hypot(*(a[:2] - b[:2])) < CELLS_APART)


def _find_height(likeness: Array, a: Array, b: Array) -> float:
    """Return the height, m, by which b is raised: the median over the best partners of its scans, by how alike they are."""
    best = likeness.argmax(axis=0)
    lift, weight = a[best] - b, likeness[best, np.arange(len(b))]
    order = np.argsort(lift, kind="stable")
    share = np.cumsum(weight[order])
    return float(lift[order[np.searchsorted(share, share[-1] / 2)]])


def _build_pose(at: Array, middle: Array, height: float) -> Sim3:
    """Build the pose that turns b about the middle of its scans and lays that at (x, y)."""
    x, y, yaw = at.tolist()
    placed = Sim3(yaw).apply(middle[None])[0]
    yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
    return Sim3(float(yaw), (float(x - placed[0]), float(y - placed[1]), float(height)))


def _turn(yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, s], [-s, c]])


class _Search:
    """Search of one pair of maps; a pose is (3,) x, y of b's middle in a, m, and yaw, rad."""

    def __init__(self, likeness: Array, a: RadioScans, b: RadioScans, middle: Array, law: RadioLaw) -> None:
        self.likeness, self.law = likeness, law
        self.a, self.b = a.position[:, :2], b.position[:, :2] - middle[:2]
        self.kind = classify_likeness(likeness)
        self.places = a.share, b.share
        self.shares = np.sqrt(np.outer(*self.places))
        self.reach = max(float(np.sqrt((self.b**2).sum(axis=1).mean())), 1.0)
        self.tables = self._build_tables(1.0)
        self.few = tuple(np.unique(np.linspace(0, n - 1, min(n, REFINED)).round().astype(int)) for n in likeness.shape)

    def _build_tables(self, stretch: float) -> dict[float, Array]:
        return {reach: _build_table(self.law, reach, stretch) for reach in (COARSE, EXACT)}

    def choose_stretch(self, starts: Sequence[Array]) -> None:
        """Choose how many metres of the law's building a metre of this one is worth: as the best of some poses has it."""
        rated = []
        for stretch in STRETCHES:
            self.tables = self._build_tables(stretch)
            rated.append((max(self._build_score(at, COARSE, self.few, 0.0)(at) for at in starts), stretch))
        self.tables = self._build_tables(max(rated)[1])

    def vote(self, most: int) -> list[Array]:
        """Find the poses that most partners vote for."""
        partners = [np.argsort(-self.likeness, axis=1, kind="stable")[:, :PARTNERS]]
        partners.append(np.argsort(-self.likeness.T, axis=1, kind="stable")[:, :PARTNERS])
        n, m = self.likeness.shape
        i = np.concatenate([np.repeat(np.arange(n), partners[0].shape[1]), partners[1].ravel()])
        j = np.concatenate([partners[0].ravel(), np.repeat(np.arange(m), partners[1].shape[1])])
        weight = self.likeness[i, j] ** 2 * np.sqrt(self.shares[i, j])
        found = []
        for yaw in np.arange(0, 2 * np.pi - TURN / 2, TURN):
            shift = self.a[i] - self.b[j] @ _turn(yaw)
            low = shift.min(axis=0)
            cell = ((shift - low) / CELL).astype(int)
            size = np.minimum(cell.max(axis=0) + 1, 512)
            cell = np.minimum(cell, size - 1)
            votes = np.bincount(cell[:, 0] * size[1] + cell[:, 1], weight, minlength=size[0] * size[1]).reshape(size)
            votes = ndimage.gaussian_filter(votes, 1.2, mode="constant")
            for _ in range(2):
                top = np.unravel_index(int(votes.argmax()), votes.shape)
                found.append((float(votes[top]), np.array([*(low + (np.array(top) + 0.5) * CELL), yaw])))
                votes[max(top[0] - 3, 0) : top[0] + 4, max(top[1] - 3, 0) : top[1] + 4] = 0
        kept: list[Array] = []
        for _, at in sorted(found, key=lambda f: -f[0]):
            if len(kept) < most and all(not _is_same(at, other) for other in kept):
                kept.append(at)
        return kept

    def refine_coarsely(self, start: Array) -> tuple[Array, float]:
        """Refine a pose by some scans; the pose, and its score by these."""
        at = self._climb(start, COARSE, self.few, 8.0)
        return at, self._build_score(at, COARSE, self.few, 0.0)(at)

    def refine(self, start: Array) -> tuple[Array, float]:
        """Refine a pose by all scans; the pose, and its score over pairs up to `COARSE`."""
        rows = tuple(np.arange(n) for n in self.likeness.shape)
        at = self._climb(start, EXACT, rows, 2.0)
        return at, self._build_score(at, COARSE, rows, 0.0)(at)

    def _climb(self, at: Array, reach: float, rows: tuple[Array, ...], step: float) -> Array:
        from scipy.optimize import minimize  # here: a hundred modules, of which maps without readings need none

        score = self._build_score(at, reach, rows, 2 * step)
        unit = np.array([1.0, 1.0, 1 / self.reach])
        corners = step * np.array([[0.5, 0.5, 0.5], [-0.5, 0.5, -0.5], [0.5, -0.5, -0.5], [-0.5, -0.5, 0.5]])
        options = {"initial_simplex": corners, "xatol": 0.02, "fatol": 1e-3, "maxfev": 150}
        found = minimize(lambda x: -score(at + x * unit), np.zeros(3), method="Nelder-Mead", options=options)
        return np.asarray(at + found.x * unit)

    def _build_score(self, at: Array, reach: float, rows: tuple[Array, ...], slack: float):  # type: ignore[no-untyped-def]
        """Build a function of a pose near one: the log likelihood ratio of the pairs of scans up to a reach, m, against pairs
        beyond it."""
        a, b, table = self.a[rows[0]], self.b[rows[1]], self.tables[reach]
        moved = b @ _turn(at[2]) + at[:2]
        i, j = np.nonzero(((a[:, None] - moved[None]) ** 2).sum(axis=2) < (reach + slack) ** 2)
        kind, left, right = self.kind[rows[0][i], rows[1][j]], a[i], b[j]
        weight = self.shares[rows[0][i], rows[1][j]]
        last = table.shape[1] - 1
        shown = [self.places[k][rows[k][np.unique(at)]].sum() for k, at in enumerate((i, j))]
        scale = float(min(shown)) / max(float(weight.sum()), 1e-9)  # places testify once each, by the mean of their pairs

        def score(pose: Array) -> float:
            gap = np.sqrt(((left - right @ _turn(pose[2]) - pose[:2]) ** 2).sum(axis=1))
            return scale * float(weight @ table[kind, np.minimum((gap / FINE_STEP).astype(int), last)])

        return score

    def measure_covariance(self, at: Array) -> Array:
        """Measure (3, 3) of a pose: by how its score falls off, discounted, and by what positions of scans are off."""
        rows = tuple(np.arange(n) for n in self.likeness.shape)
        score = self._build_score(at, EXACT, rows, 4.0)
        unit = np.array([1.0, 1.0, 1 / self.reach])
        offsets = np.array([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)], float) * 2.0
        values = np.array([score(at + x * unit) for x in offsets])
        pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
        design = np.column_stack([np.ones(len(offsets)), offsets, *(offsets[:, p] * offsets[:, q] for p, q in pairs)])
        fitted = np.linalg.lstsq(design, values, rcond=None)[0][4:]
        bend = np.zeros((3, 3))
        for (p, q), value in zip(pairs, fitted, strict=True):
            bend[p, q] = bend[q, p] = -value * (2 if p == q else 1)
        size, axes = np.linalg.eigh(self.law.pose_discount * bend)
        inverse = axes @ np.diag(1 / np.maximum(size, 1e-4)) @ axes.T + np.eye(3) * self.law.blur**2
        return np.asarray(inverse * np.outer(unit, unit))


FINE_STEP = 0.25  # m, to which distances of a pose are told apart


def _build_table(law: RadioLaw, reach: float, stretch: float) -> Array:
    """Build the (K, F) log likelihood ratio of a class of likeness at each `FINE_STEP` against pairs just beyond a reach, m."""
    beyond = law.mix_between(reach * stretch, (reach + 4.0) * stretch)
    table = law.fine[0] - beyond
    at = np.arange(0.0, reach + FINE_STEP, FINE_STEP) * stretch
    whole = np.arange(law.fine.shape[1]) * FINE
    out = np.array([np.interp(at, whole, table[:, k]) for k in range(table.shape[1])])
    out = ndimage.gaussian_filter1d(out, 1.5 / FINE_STEP, axis=1, mode="nearest")
    out -= out[:, -1:]
    return out


@dataclass(frozen=True, eq=False)
class RadioIndex:
    """Places of many maps and what is heard there.

    Args:
        power: (n, k) sparse, rows of length 1.
        column: address -> column.
        weight: (k,) of addresses.
        map, storey: (n,) of each place.
    """

    power: sparse.csr_matrix
    column: dict[str, int]
    weight: Array
    map: Array
    storey: Array


@dataclass(frozen=True)
class RadioRank:
    """A storey of a map as the origin of readings: how alike the best places are (0 to 1), and the probability among those of the
    index."""

    map: int
    storey: int
    likeness: float
    probability: float


PLACES_A_STOREY = 400  # of an index
BEST_PLACES = 3  # of a storey, by which a scan is told to be there
RANK_SHARPNESS = 12.0  # log odds of a difference of 1 in likeness, of one scan
RANK_MOST = 4.0  # scans that count as independent at most


def build_radio_index(maps: Sequence[TopometricMap]) -> RadioIndex:
    """Build the index of the access points of maps: one row for each place of a storey, the mean of its scans."""
    column: dict[str, int] = {}
    rows, which, storeys = [], [], []
    for number, map in enumerate(maps):
        scans = collect_radio_scans(map.landmarks)
        at = np.array([column.setdefault(name, len(column)) for name in scans.addresses], np.int64)
        storey = _find_storeys(scans, map)
        for level in np.unique(storey).tolist():
            power = _average_places(scans.select(np.flatnonzero(storey == level))).tocoo()
            rows.append((power.row, at[power.col] if len(at) else power.col, power.data, power.shape[0]))
            which += [number] * power.shape[0]
            storeys += [level] * power.shape[0]
    starts = np.cumsum([0, *(r[3] for r in rows)])
    parts = [(r[0] + start, r[1], r[2]) for r, start in zip(rows, starts, strict=False)] or [(np.zeros(0, int),) * 3]
    i, j, data = (np.concatenate([p[k] for p in parts]) for k in range(3))
    power = sparse.csr_matrix((data.astype(float), (i, j)), shape=(len(which), len(column)))
    top = power.max(axis=0).toarray().ravel() if power.shape[0] and power.shape[1] else np.zeros(len(column))
    mean = np.asarray(power.sum(axis=0)).ravel() / max(len(which), 1)
    weight = np.sqrt(np.log1p(top / np.maximum(mean, 1e-9)))
    return RadioIndex(
        _normalise(power.multiply(weight[None]).tocsr()), column, weight, np.array(which, int), np.array(storeys, int)
    )


def rank_maps(index: RadioIndex, landmarks: Landmarks) -> list[RadioRank]:
    """Rank the storeys of an index by how likely readings are from there, likeliest first; none without an address in common."""
    scans = collect_radio_scans(landmarks, placed=False, most=PLACES_A_STOREY)
    known = [(k, index.column[name]) for k, name in enumerate(scans.addresses) if name in index.column]
    if not len(scans) or not known:
        return []
    own, theirs = np.array(known).T
    part = scans.power.tocsc()[:, own].multiply(index.weight[theirs][None]).tocsr()
    mean = float(np.median(index.weight)) if len(index.weight) else 1.0
    square = np.asarray(part.multiply(part).sum(axis=1)).ravel()
    unknown = scans.power.multiply(scans.power).sum(axis=1)
    rest = scans.power.tocsc()[:, own]
    missing = np.asarray(unknown).ravel() - np.asarray(rest.multiply(rest).sum(axis=1)).ravel()
    length = np.sqrt(np.maximum(square + mean**2 * np.maximum(missing, 0), 1e-9))
    likeness = (part @ index.power.tocsc()[:, theirs].T).toarray() / length[:, None]
    keys, group = np.unique(np.column_stack([index.map, index.storey]), axis=0, return_inverse=True)
    group = group.ravel()
    scores = np.zeros((len(scans), len(keys)))
    for k in range(len(keys)):
        some = likeness[:, group == k]
        scores[:, k] = np.sort(some, axis=1)[:, -BEST_PLACES:].mean(axis=1)
    mean_score = scores.mean(axis=0)
    odds = RANK_SHARPNESS * min(len(scans), RANK_MOST) * mean_score
    probability = np.exp(odds - odds.max())
    probability /= probability.sum()
    order = np.argsort(-mean_score, kind="stable")
    return [
        RadioRank(int(keys[k, 0]), int(keys[k, 1]), float(mean_score[k]), float(probability[k]))
        for k in order
        if mean_score[k] > 0
    ]


def _find_storeys(scans: RadioScans, map: TopometricMap) -> Array:
    """Return the (n,) storey of each scan: as it says, or the highest whose floor lies below it."""
    floors = map.storeys["floor"]
    below = np.clip(np.searchsorted(floors, scans.position[:, 2] + 0.5, side="right") - 1, 0, None) if len(floors) else 0
    return np.where(scans.storey >= 0, scans.storey, below)


def _average_places(scans: RadioScans) -> sparse.csr_matrix:
    """Return the (p, k) mean power at each place of scans, `PLACE` wide, wider where there are too many."""
    cell = PLACE
    while True:
        at = np.floor(scans.position[:, :2] / cell).astype(np.int64)
        _, place = np.unique(at, axis=0, return_inverse=True)
        place = place.ravel()
        count = int(place.max()) + 1 if len(place) else 0
        if count <= PLACES_A_STOREY:
            break
        cell *= 1.5
    many = np.bincount(place, minlength=count)
    average = sparse.csr_matrix((1 / many[place], (place, np.arange(len(place)))), shape=(count, len(scans)))
    return (average @ scans.power).tocsr()


def _normalise(power: sparse.csr_matrix) -> sparse.csr_matrix:
    length = np.sqrt(np.asarray(power.multiply(power).sum(axis=1)).ravel())
    return sparse.diags(1 / np.maximum(length, 1e-9)) @ power
