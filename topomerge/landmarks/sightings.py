"""Landmarks of one map as witnesses: where each is, how sure that is, what it says and how rare that is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from topomerge.landmarks.text import estimate_share, is_number
from topomerge.types import LANDMARK_KINDS, Array, TopometricMap, fold_text

MOST_ROWS = 20_000  # of a kind that are looked at: of more, those that were read most surely
MOST_SIGHTINGS = 1500  # of a kind that testify: of more, the rarest
USUAL_SIGMA = 0.3  # m, of a position whose reader gives none
ROOM_SIGMA, STOREY_SIGMA = 0.5, 0.5  # of the side of its room, of the diagonal of its storey, where only these are known
SAME_SIGN = 1.5  # m within which a string that is read twice is one sign
TURNED_BY = np.radians(60.0)  # rad by which two headings of one landmark do not differ
FARTHEST = 1e7  # m: a position beyond is none
OBJECTS = {"chair": 0.2, "table": 0.1, "door": 0.15, "window": 0.1, "desk": 0.08, "plant": 0.05, "lamp": 0.08, "monitor": 0.06}
RARE_OBJECT = 0.02  # share of the objects of buildings that are of a class that is not among these


@dataclass(frozen=True, eq=False)
class Sightings:
    """Landmarks of some kinds of a map; readings of one sign are one.

    Args:
        rows: (n,) of the map's table.
        values: what each says, as it was read.
        keys: the same as it is compared (`fold_text`; tags and objects: in lower case).
        position: (n, 3) m, in the map's frame.
        sigma: (n,) m, in the plane.
        confidence: (n,) that it was read right.
        heading: (n,) rad; nan where not known.
        share: (n,) of the landmarks of buildings at large that say the same.
        numbered: (n,) bool: a number of a room or the like.
        named: (n,) bool: the name of a room, and no sign that was read.
    """

    rows: Array
    values: tuple[str, ...]
    keys: tuple[str, ...]
    position: Array
    sigma: Array
    confidence: Array
    heading: Array
    share: Array
    numbered: Array
    named: Array

    def __len__(self) -> int:
        return len(self.rows)

    def select(self, rows: Array) -> Sightings:
        """Return some of them, by their numbers (k,)."""
        chosen = np.asarray(rows, np.int64)
        texts = [tuple(of[k] for k in chosen.tolist()) for of in (self.values, self.keys)]
        arrays = (self.position, self.sigma, self.confidence, self.heading, self.share, self.numbered, self.named)
        return Sightings(self.rows[chosen], texts[0], texts[1], *(of[chosen] for of in arrays))


def locate_landmarks(map: TopometricMap, table: Array) -> tuple[Array, Array]:
    """Return positions (n, 3) and their uncertainty (n,), m, of rows of a map's landmarks; nan where nothing is known.

    A landmark without a position is where its room is, or its storey, as unsure as these are large.
    """
    position, sigma = table["position"].copy(), table["sigma"].copy()
    with np.errstate(invalid="ignore"):
        lost = ~(np.abs(position[:, :2]) < FARTHEST).all(axis=1)
        sigma[~(sigma > 0) | ~(sigma < FARTHEST)] = USUAL_SIGMA
    position[lost], sigma[lost] = np.nan, np.nan
    room, storey = table["room"], table["storey"].copy()
    in_room = room >= 0
    storey[in_room] = map.rooms["storey"][room[in_room]]
    for_room = lost & in_room
    position[for_room] = map.rooms["centroid"][room[for_room]]
    sigma[for_room] = np.maximum(ROOM_SIGMA * np.sqrt(map.rooms["area"][room[for_room]]), 1.0)
    for_storey = lost & ~in_room & (storey >= 0)
    if for_storey.any() and len(map.grid):
        low, high = map.grid.bounds
        position[for_storey] = (low + high) / 2
        position[for_storey, 2] = np.nan
        sigma[for_storey] = np.maximum(STOREY_SIGMA * np.hypot(*(high - low)[:2]), 1.0)
    flat = ~(np.abs(position[:, 2]) < FARTHEST)
    known = flat & (storey >= 0)
    position[flat, 2] = np.nan
    position[known, 2] = map.storeys["floor"][storey[known]]
    flat &= ~known
    position[flat, 2] = map.storeys["floor"][0] if len(map.storeys) == 1 else np.nan
    return position, sigma


def transform_places(move: Callable[[Array], Array], places: Array) -> Array:
    """Move places (n, 3) of which some have no height, which they keep."""
    flat = np.isnan(places[:, 2])
    moved = move(np.where(flat[:, None] & (np.arange(3) == 2), 0.0, places))
    return np.where(flat[:, None] & (np.arange(3) == 2), np.nan, moved)


def build_sightings(map: TopometricMap, kinds: Sequence[str]) -> Sightings:
    """Build the sightings of some kinds of a map; the work is bounded however many landmarks there are."""
    table = map.landmarks.table
    rows = np.flatnonzero(map.landmarks.is_kind(*kinds))
    confidence = np.clip(np.nan_to_num(table["confidence"][rows], nan=0.5), 0.0, 1.0)
    if len(rows) > MOST_ROWS:
        rows = np.sort(rows[np.argsort(-confidence, kind="stable")[:MOST_ROWS]])
    position, sigma = locate_landmarks(map, table[rows])
    finite = np.isfinite(sigma)
    rows, position, sigma = rows[finite], position[finite], sigma[finite]
    values = map.landmarks.get_values()[rows].tolist()
    texts = np.isin(table["kind"][rows], [LANDMARK_KINDS.index(kind) for kind in ("text", "name")]).tolist()
    keys = [fold_text(v) if text else v.strip().casefold() for v, text in zip(values, texts, strict=True)]
    shares = [estimate_share(v) if text else OBJECTS.get(k, RARE_OBJECT) for v, k, text in zip(values, keys, texts, strict=True)]
    numbered = [text and is_number(v) for v, text in zip(values, texts, strict=True)]
    confidence = np.clip(np.nan_to_num(table["confidence"][rows], nan=0.5), 0.0, 1.0)
    named = table["kind"][rows] == LANDMARK_KINDS.index("name")
    headings, qualities = table["number"][rows], (np.array(shares, float), np.array(numbered, bool), named)
    whole = Sightings(rows, tuple(values), tuple(keys), position, sigma, confidence, headings, *qualities)
    whole = whole.select(_pick_single_readings(whole))
    if len(whole) > MOST_SIGHTINGS:
        whole = whole.select(np.sort(np.argsort(whole.share, kind="stable")[:MOST_SIGHTINGS]))
    return whole


def _pick_single_readings(sightings: Sightings) -> Array:
    """Return the numbers of the sightings without those that repeat a surer one of the same string at the same place."""
    by_key: dict[str, list[int]] = {}
    for k in np.lexsort((sightings.rows, sightings.sigma, -sightings.confidence)).tolist():
        if not sightings.keys[k]:
            continue
        kept = by_key.setdefault(sightings.keys[k], [])
        if len(kept) >= MOST_SIGHTINGS // 10:  # a string that stands everywhere says nothing
            continue
        away = np.linalg.norm(sightings.position[kept, :2] - sightings.position[k, :2], axis=1) if kept else np.zeros(0)
        with np.errstate(invalid="ignore"):
            turned = np.abs(np.angle(np.exp(1j * (sightings.heading[kept] - sightings.heading[k])))) > TURNED_BY
        if not ((away < SAME_SIGN) & ~turned).any():
            kept.append(k)
    return np.array(sorted(k for kept in by_key.values() for k in kept), np.int64)
