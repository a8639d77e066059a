"""Sightings of signs, tags and objects, and the landmarks that they are fused to."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from topomerge.types import Array, Landmarks, build_landmarks, join_landmarks

LONGEST_TEXT = 64  # letters that are kept of a text, a name or an address
MOST_SIGHTINGS = 20_000  # of a recording; further ones are not looked at
SAME_TEXT_REACH, OTHER_TEXT_REACH = 1.5, 0.4  # m between sightings of one sign, of equal texts and of similar ones
OBJECT_REACH = 0.8  # m between sightings of one object
FRAGMENT_REACH = 0.6  # m between the middles of a text and of a part of it
MOST_EDITS = 0.34  # of the letters of the longer one, by which texts of one sign differ
FACING_LEVEL = 0.5  # length of the level part of a sign's normal, from which on it has a heading
FACING = 0.0  # cosine between headings of one sign: the two sides of a board are two
LEAST_SIGMA = 0.05  # m: of the poses, which are common to all sightings
FEW_LETTERS, FEW_LETTERS_CONFIDENCE = 2, 0.9  # short texts are often read from patterns


@dataclass(frozen=True, eq=False)
class Sighting:
    """One sign, tag or object as one picture or message shows it.

    Args:
        kind: one of LANDMARK_KINDS.
        value: its text, its tag, its class.
        position: (3,) m.
        sigma: m, of the position.
        confidence: 0 to 1.
        heading: rad, of the direction that it faces; nan: not known.
        time: s.
        picture: number of the picture or message; two sightings of one picture are two things.
    """

    kind: str
    value: str
    position: Array
    sigma: float
    confidence: float = 1.0
    heading: float = math.nan
    time: float = math.nan
    picture: int = -1


def clean_text(text: object) -> str:
    """Return a text without control characters, with single spaces, at most `LONGEST_TEXT` letters."""
    composed = unicodedata.normalize("NFC", str(text)[: 16 * LONGEST_TEXT])
    shown = "".join(" " if unicodedata.category(letter)[0] in "CZ" else letter for letter in composed)
    return " ".join(shown.split())[:LONGEST_TEXT].strip()


def compute_heading(normal: Array) -> float:
    """Compute the heading, rad, of what faces along a vector (3,) of length 1; nan where it lies flat."""
    level = math.hypot(normal[0], normal[1])
    return math.atan2(normal[1], normal[0]) if level >= FACING_LEVEL else math.nan


def is_legible(text: str, confidence: float) -> bool:
    """Return whether a text that was read may stand on a sign: it has letters or digits, and more than a stroke or two."""
    letters = sum(letter.isalnum() for letter in text)
    return letters > FEW_LETTERS or (letters > 0 and confidence >= FEW_LETTERS_CONFIDENCE)


def count_edits(a: str, b: str, within: bool = False) -> int:
    """Count the letters to insert, leave out or replace that turn one text into the other, or into any part of it."""
    row = [0] * (len(b) + 1) if within else list(range(len(b) + 1))
    for i, letter in enumerate(a, 1):
        before, row[0] = row[0], i
        for j, other in enumerate(b, 1):
            before, row[j] = row[j], min(row[j] + 1, row[j - 1] + 1, before + (letter != other))
    return min(row) if within else row[-1]


def fuse_sightings(sightings: Sequence[Sighting], source: str) -> Landmarks:
    """Fuse the sightings of one thing to one landmark.

    The value is elected by confidence. The position is the mean of those near the median, weighted by their precision.

    Args:
        sightings: in the order of their pictures.
        source: of the landmarks.

    Returns:
        Landmarks in the order in which they were seen first, kind by kind as they appear.
    """
    groups: list[list[Sighting]] = []
    near: dict[tuple[int, int, int], list[int]] = {}
    for sighting in sightings[:MOST_SIGHTINGS]:
        if not np.isfinite(sighting.position).all() or np.abs(sighting.position).max() > 1e9:
            continue
        x, y, z = (int(v) for v in np.floor(sighting.position / SAME_TEXT_REACH))
        around = [(x + i, y + j, z + k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]
        able = sorted({number for cell in around for number in near.get(cell, ())})
        best = min(able, key=lambda number: _measure_distance(groups[number], sighting), default=-1)
        if best < 0 or not np.isfinite(_measure_distance(groups[best], sighting)):
            groups.append([])
            best = len(groups) - 1
            near.setdefault((x, y, z), []).append(best)
        groups[best].append(sighting)
    groups = _drop_fragments(groups)
    kinds = list(dict.fromkeys(group[0].kind for group in groups))
    fused = [_build_fused(kind, [g for g in groups if g[0].kind == kind], source) for kind in kinds]
    return join_landmarks(fused)


def _measure_distance(group: Sequence[Sighting], sighting: Sighting) -> float:
    """Return how far a sighting is from those of one thing, m; inf: it is another."""
    first = group[0]
    distance = float(np.linalg.norm(np.median([s.position for s in group[-5:]], axis=0) - sighting.position))
    if first.kind != sighting.kind or (
        first.kind == "text" and np.cos(first.heading - sighting.heading) < FACING
    ):  # false for nan
        return math.inf
    same = any(other.value == sighting.value for other in group)
    if same:
        reach = OBJECT_REACH if first.kind == "object" else SAME_TEXT_REACH
        return distance if distance <= reach else math.inf
    if first.kind != "text" or distance > OTHER_TEXT_REACH or any(s.picture == sighting.picture >= 0 for s in group):
        return math.inf
    longest = max(len(first.value), len(sighting.value))
    similar = min(count_edits(s.value, sighting.value) for s in group[:5]) <= MOST_EDITS * longest
    return OTHER_TEXT_REACH + distance if similar else math.inf


def _drop_fragments(groups: list[list[Sighting]]) -> list[list[Sighting]]:
    """Drop the things without texts that are parts of another one nearby, as pictures show that cut it off."""
    from scipy.spatial import cKDTree

    texts = [number for number, group in enumerate(groups) if group[0].kind == "text"]
    if len(texts) < 2:
        return groups
    places = np.array([np.median([s.position for s in groups[number]], axis=0) for number in texts])
    votes = [_count_votes(groups[number]) for number in texts]
    values = [max(vote, key=lambda v: (vote[v], v)) for vote in votes]
    dropped = set()
    for a, b in cKDTree(places).query_pairs(FRAGMENT_REACH, output_type="ndarray").tolist():
        part, whole = (a, b) if len(values[a]) < len(values[b]) else (b, a)
        one, other = groups[texts[part]], groups[texts[whole]]
        if len(values[part]) == len(values[whole]) or np.cos(one[0].heading - other[0].heading) < FACING or len(one) > len(other):
            continue
        together = {s.picture for s in one} & {s.picture for s in other} - {-1}
        if not together and count_edits(values[part], values[whole], within=True) <= MOST_EDITS * len(values[part]):
            dropped.add(texts[part])
    return [group for number, group in enumerate(groups) if number not in dropped]


def _count_votes(group: Sequence[Sighting]) -> dict[str, float]:
    """Return how surely each value was read, all sightings together."""
    votes: dict[str, float] = {}
    for sighting in group:
        votes[sighting.value] = votes.get(sighting.value, 0.0) + sighting.confidence
    return votes


def _build_fused(kind: str, groups: Sequence[Sequence[Sighting]], source: str) -> Landmarks:
    values, rows = [], []
    for group in groups:
        votes = _count_votes(group)
        value = max(votes, key=lambda v: (votes[v], v))
        against = sum(vote for other, vote in votes.items() if count_edits(other, value, within=True))  # what was cut off agrees
        share = votes[value] / max(votes[value] + against, 1e-9)
        sure = max(s.confidence for s in group if s.value == value)
        position, sigma = _average_positions(group)
        headings = np.array([s.heading for s in group if math.isfinite(s.heading)])
        heading = math.atan2(np.sin(headings).mean(), np.cos(headings).mean()) if len(headings) else math.nan
        values.append(value)
        rows.append((*position, sigma, share * sure, heading, group[0].time))
    table = np.array(rows)
    return build_landmarks(
        kind, values, source, table[:, :3], sigma=table[:, 3], confidence=table[:, 4], number=table[:, 5], time=table[:, 6]
    )


def _average_positions(group: Sequence[Sighting]) -> tuple[Array, float]:
    """Return the robust mean (3,) of the positions, and its uncertainty, m."""
    positions, sigmas = np.array([s.position for s in group]), np.array([s.sigma for s in group])
    off = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    kept = off <= np.maximum(3 * np.median(off), 2 * sigmas)
    positions, weights = positions[kept], 1 / sigmas[kept] ** 2
    mean = weights @ positions / weights.sum()
    spread = float(np.sqrt(weights @ ((positions - mean) ** 2).sum(axis=1) / weights.sum() / 2 / len(positions)))
    return mean, math.hypot(LEAST_SIGMA, spread, 1 / math.sqrt(weights.sum()))


OBJECT_CELL = 0.15  # m: points of one class in cells that touch are one object
SMALLEST_OBJECT, LARGEST_OBJECT = 0.1, 3.0  # m; walls, floors and ceilings are larger
LEAST_OBJECT_POINTS = 20
MOST_CLASSES = 256  # more are numbers of things, not of classes
MOST_OBJECT_CELLS = 4_000_000
MOST_CODES = 2.0**62  # of cells that can be numbered
HALF = np.array([(i, j, k) for i in (0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) > (0, 0, 0)])


class ObjectFinder:
    """Finds objects in points that bear classes: clusters of one class that are no larger than a piece of furniture."""

    def __init__(self) -> None:
        self._cells: list[Array] = []  # (n, 8): class, cell, points and their sum
        self._held = 0
        self.is_full = False

    def add(self, points: Array, classes: Array) -> None:
        """Take in points (n, 3), m, and their classes (n,), -1 of those without."""
        fine = (classes >= 0) & (np.abs(points) < 1e6).all(axis=1)
        if self.is_full or not fine.any():
            return
        points = points[fine]
        keys = np.column_stack([classes[fine], np.floor(points / OBJECT_CELL)]).astype(np.int64)
        self._cells.append(_sum_cells(keys, np.column_stack([np.ones(len(points)), points])))
        self._held += len(self._cells[-1])
        if self._held > MOST_OBJECT_CELLS:
            rows = np.concatenate(self._cells)
            self._cells = [_sum_cells(rows[:, :4].astype(np.int64), rows[:, 4:])]
            self._held = len(self._cells[0])
            self.is_full = self._held > MOST_OBJECT_CELLS

    def find_objects(self, source: str) -> Landmarks:
        """Find the objects among all points; their sigma is a quarter of their size."""
        if not self._cells or self.is_full:
            return Landmarks()
        rows = np.concatenate(self._cells)
        rows = _sum_cells(rows[:, :4].astype(np.int64), rows[:, 4:])
        keys, count, sums = rows[:, :4].astype(np.int64), rows[:, 4], rows[:, 5:]
        if len(np.unique(keys[:, 0])) > MOST_CLASSES:
            return Landmarks()
        of = _label_clusters(keys)
        number = int(of.max()) + 1
        points = np.bincount(of, count, number)
        middles = np.stack([np.bincount(of, column, number) for column in sums.T], axis=1) / points[:, None]
        low, high = np.full((number, 3), np.iinfo(np.int64).max), np.full((number, 3), np.iinfo(np.int64).min)
        np.minimum.at(low, of, keys[:, 1:])
        np.maximum.at(high, of, keys[:, 1:])
        size = (high - low + 1).max(axis=1) * OBJECT_CELL
        kept = (points >= LEAST_OBJECT_POINTS) & (size >= SMALLEST_OBJECT) & (size <= LARGEST_OBJECT)
        first = np.unique(of, return_index=True)[1]
        values = [f"class {k}" for k in keys[first[kept], 0].tolist()]
        return build_landmarks("object", values, source, middles[kept], sigma=np.maximum(size[kept] / 4, LEAST_SIGMA))


def _sum_cells(keys: Array, values: Array) -> Array:
    """Return (m, 4 + k) rows of the cells (n, 4) that differ, with the sums of their values (n, k)."""
    order = np.lexsort(keys.T[::-1])
    keys, values = keys[order], values[order]
    starts = np.flatnonzero(np.concatenate([[True], (keys[1:] != keys[:-1]).any(axis=1)]))
    return np.column_stack([keys[starts], np.add.reduceat(values, starts, axis=0)])


def _label_clusters(keys: Array) -> Array:
    """Return (n,) number of the cluster of each cell (n, 4) of class and place, which are sorted."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    low = keys.min(axis=0)
    span = keys.max(axis=0) - low + 3
    if np.prod(span.astype(np.float64)) > MOST_CODES:  # nothing is near anything there
        return np.arange(len(keys))
    scale = np.array([span[1] * span[2] * span[3], span[2] * span[3], span[3], 1])
    codes = (keys - low + 1) @ scale
    order = np.argsort(codes, kind="stable")
    ends = []
    for step in HALF:
        requested = codes + step @ scale[1:]
        at = np.minimum(np.searchsorted(codes, requested, sorter=order), len(codes) - 1)
        found = order[at]
        met = np.flatnonzero(codes[found] == requested)
        ends.append(np.stack([met, found[met]]))
    pairs = np.concatenate(ends, axis=1)
    graph = coo_matrix((np.ones(pairs.shape[1], bool), pairs), (len(keys), len(keys)))
    return np.asarray(connected_components(graph, directed=False)[1])
