"""Landmarks of maps that were joined -> those of the joined map: what two saw is one, what contradicts stays both and is told.

Two landmarks of one kind and one string are one if they lie within `SAME_PLACE`; names in one room are; and so are two in a room
of which one is known by its room alone. Only those of different maps are: what one map has twice is two. Readings of radio and
pressure are not fused. One search of the nearest neighbours a map, whatever stands in the files (docs/landmarks.md).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from topomerge.types import LANDMARK_KINDS, Array, Landmarks, TopometricMap, fold_text, join_landmarks

SAME_PLACE = 1.5  # m between two sightings of one landmark, after the maps were joined
SAME_DOOR = 1.0  # m between two signs of one door
USUAL_SIGMA = 0.5  # m, of a position that says none
LEAST_SIGMA = 0.01  # m
LEAST_BELIEVED = 0.5  # confidence of a number that can contradict another one
ROUNDS = 3  # of nearest neighbours: of chairs around a table several have the same nearest one
ROUNDING = 0.01  # m: sightings that are this near to each other are searched as one
FUSED_KINDS = ("text", "tag", "object", "name")
NUMBER = re.compile(r"(?=\D*\d)[\w.\-/ ]{1,12}")  # what may be the number of a room
CONTRADICTING = "landmarks contradict each other"  # how the warning of a joined map begins
MOST_LISTED = 100  # contradictions that are kept in words


@dataclass(frozen=True)
class LandmarkSummary:
    """The outcome of fusing the landmarks of joined maps.

    Args:
        maps: how many each map had, in their order.
        joined: how many there are.
        fused: how many of the maps' became one with that of another map.
        contradictions: the first ones: `what` is "number" (two of one door or room) or "tag" (one in two places), with the two
            `values` and `maps`, the `room` of the joined map or None, and `apart_m` or None.
        contradicting: how many there are.
    """

    maps: tuple[int, ...]
    joined: int
    fused: int
    contradictions: tuple[dict[str, Any], ...] = ()
    contradicting: int = 0

    def describe_contradictions(self, names: Sequence[str]) -> str:
        """Describe the first contradictions in a sentence; "" where there are none."""
        parts = []
        for c in self.contradictions[:3]:
            (one, other), (a, b) = c["values"], (names[k] for k in c["maps"])
            if c["what"] == "tag":
                parts.append(f"tag {one} is {c['apart_m']:.1f} m apart in {a} and {b}")
            else:
                parts.append(f"room {c['room']} is {one} in {a} and {other} in {b}")
        if self.contradicting > len(parts):
            parts.append(f"and {self.contradicting - len(parts)} more")
        return f"{CONTRADICTING}: {'; '.join(parts)}" if parts else ""


def describe_listed(listed: Any, names: Sequence[str]) -> str:
    """Describe the contradictions of a summary that stands in a file, which may be a stranger's; "" where it is none."""
    try:
        return LandmarkSummary(**listed).describe_contradictions(names)
    except (TypeError, ValueError, KeyError, IndexError, AttributeError):
        return ""


def fuse_landmarks(parts: Sequence[Landmarks], joined: TopometricMap) -> tuple[Landmarks, LandmarkSummary]:
    """Fuse the landmarks of joined maps.

    Args:
        parts: of each map, in the frame of the joined map, with its rooms and storeys.
        joined: the joined map.
    """
    fusion = _Fusion(parts, joined)
    for k in range(1, len(parts)):
        fusion.add_part(k)
    fusion.compare_tags()
    kept = fusion.landmarks.select(fusion.into == np.arange(len(fusion.into)))
    counts = tuple(len(part) for part in parts)
    listed = tuple(fusion.contradictions[:MOST_LISTED])
    return kept, LandmarkSummary(counts, len(kept), sum(counts) - len(kept), listed, fusion.contradicting)


class _Fusion:
    """The landmarks of all parts in one table; those that are fused change in place.

    Attributes:
        landmarks: all.
        owner: (n,) the part of each.
        into: (n,) the row that each is fused into; its own where it stands for itself.
        key: (n,) number of kind and string, without case and blanks, of numbers of rooms also without what readers confuse; -1 of
            what is not fused.
        word: (n,) number of the string alone; of what may be the number of a room, else -1.
    """

    def __init__(self, parts: Sequence[Landmarks], joined: TopometricMap) -> None:
        table = join_landmarks(parts)
        self.landmarks = replace(table, table=table.table.copy())
        self.table = self.landmarks.table
        self.owner = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        self.into = np.arange(len(self.table))
        folded = ["".join(value.casefold().split()) for value in table.values]
        numbers = [NUMBER.fullmatch(value) is not None for value in folded]
        read = [fold_text(v) if number else v for v, number in zip(folded, numbers, strict=True)]
        texts = table.is_kind("text", "name")
        word = np.where(texts, *(_number_strings(of)[self.table["value"]] for of in (read, folded)))
        self.key = np.where(table.is_kind(*FUSED_KINDS), word * len(LANDMARK_KINDS) + self.table["kind"], -1)
        self.word = np.where(np.array(numbers, bool)[self.table["value"]] & texts, word, -1)
        self.doors = np.bincount(joined.edges["rooms"].ravel(), minlength=len(joined.rooms))
        self.contradictions: list[dict[str, Any]] = []
        self.contradicting = 0

    @property
    def known(self) -> Array:
        """(n,) bool: is its position known?"""
        return np.isfinite(self.table["position"]).all(axis=1)

    def add_part(self, k: int) -> None:
        """Fuse the landmarks of part k with those of the parts before, and compare the rest."""
        before = np.flatnonzero((self.owner < k) & (self.into == np.arange(len(self.into))) & (self.key >= 0))
        own = np.flatnonzero((self.owner == k) & (self.key >= 0))
        taken = np.zeros(len(self.into), bool)  # that have a partner in the other
        for match in (*[self._match_by_place] * ROUNDS, self._match_by_room):
            old, new = match(before[~taken[before]], own[~taken[own]])
            self._fuse(old, new)
            taken[old] = taken[new] = True
        self._compare_numbers(before, own, taken)

    def _match_by_place(self, before: Array, own: Array) -> tuple[Array, Array]:
        """Return the rows of both that are the nearest of their key within reach, one to one."""
        known = self.known
        before, own = before[known[before]], own[known[own]]
        before = before[np.isin(self.key[before], self.key[own])]
        own = own[np.isin(self.key[own], self.key[before])]
        far, nearest = _find_nearest(self.table["position"], self.key, before, own, SAME_PLACE)
        return _pair_nearest(before, own, far, nearest)

    def _match_by_room(self, before: Array, own: Array) -> tuple[Array, Array]:
        """Return the rows of both with one key and one room, of which one has no position or that are names; one pair of each."""
        bare = ~self.known | self.landmarks.is_kind("name")
        first = self._pair_rooms(before, own[bare[own]])
        second = self._pair_rooms(np.setdiff1d(before[bare[before]], first[0]), own[~bare[own]])
        return np.concatenate([first[0], second[0]]), np.concatenate([first[1], second[1]])

    def _pair_rooms(self, before: Array, own: Array) -> tuple[Array, Array]:
        before, own = (rows[self.table["room"][rows] >= 0] for rows in (before, own))
        code = self.key * (len(self.doors) + 1) + self.table["room"]
        _, i, j = np.intersect1d(code[before], code[own], return_indices=True)
        return before[i], own[j]

    def _fuse(self, old: Array, new: Array) -> None:
        """Make one of each pair of rows: the position by its uncertainty, the confidence of both, the surer one's string."""
        t, known = self.table, self.known
        sigma = np.where(np.isfinite(t["sigma"]), np.maximum(t["sigma"], LEAST_SIGMA), USUAL_SIGMA)
        weight = np.where(known, sigma**-2.0, 0.0)
        a, b = weight[old], weight[new]
        apart = np.linalg.norm(t["position"][old] - t["position"][new], axis=1)
        both = (a > 0) & (b > 0) & (apart <= SAME_PLACE)  # names in one room may be far apart: then the surer place counts
        surer = np.where(b > a, new, old)
        total = np.where(a + b > 0, a + b, 1.0)
        share = (b / total)[:, None]
        mean = np.where(both[:, None], t["position"][old] * (1 - share) + t["position"][new] * share, t["position"][surer])
        unsaid = np.isnan(t["sigma"][old]) & np.isnan(t["sigma"][new])
        t["sigma"][old] = np.where(both & ~unsaid, total**-0.5, t["sigma"][surer])
        t["position"][old] = mean
        t["value"][old] = np.where(t["confidence"][new] > t["confidence"][old], t["value"][new], t["value"][old])
        t["confidence"][old] = 1 - (1 - t["confidence"][old]) * (1 - t["confidence"][new])
        for name in ("number", "time"):
            chosen = t[name][surer]
            t[name][old] = np.where(np.isnan(chosen), np.where(surer == old, t[name][new], t[name][old]), chosen)
        for name in ("room", "storey"):
            t[name][old] = np.where(t[name][old] >= 0, t[name][old], t[name][new])
        self.into[new] = old

    def _compare_numbers(self, before: Array, own: Array, taken: Array) -> None:
        """Find doors and rooms that have one number in this part and another one in those before."""
        room = self.table["room"]
        says = (self.word >= 0) & (room >= 0) & (self.table["confidence"] >= LEAST_BELIEVED)
        before, own = (rows[says[rows]] for rows in (before, own))
        code = room * (int(self.word.max(initial=0)) + 1) + self.word
        agreeing = room[own[np.isin(code[own], code[before])]]
        before, own = (rows[~taken[rows] & ~np.isin(room[rows], agreeing)] for rows in (before, own))
        known = self.known
        old, new = (rows[known[rows] & self.landmarks.is_kind("text")[rows]] for rows in (before, own))
        pairs = _pair_nearest(old, new, *_find_nearest(self.table["position"], room, old, new, SAME_DOOR))
        self._note("number", *pairs)
        before, own = (np.setdiff1d(rows, pair) for rows, pair in zip((before, own), pairs, strict=True))
        alone = self.landmarks.is_kind("name") | ~known | np.append(self.doors < 2, False)[room]  # one number a room
        _, i, j = np.intersect1d(room[before[alone[before]]], room[own[alone[own]]], return_indices=True)
        self._note("number", before[alone[before]][i], own[alone[own]][j])

    def compare_tags(self) -> None:
        """Find tags that are in two places."""
        rows = np.flatnonzero(self.landmarks.is_kind("tag") & self.known & (self.into == np.arange(len(self.into))))
        rows = rows[np.argsort(self.key[rows], kind="stable")]
        first = rows[np.searchsorted(self.key[rows], self.key[rows])]
        far = np.linalg.norm(self.table["position"][rows] - self.table["position"][first], axis=1) > SAME_PLACE
        far &= self.owner[rows] != self.owner[first]
        self._note("tag", first[far], rows[far])

    def _note(self, what: str, one: Array, other: Array) -> None:
        strings = self.landmarks.values
        rows = zip(self.table["value"][one].tolist(), self.table["value"][other].tolist(), strict=True)
        differ = np.array([what == "tag" or not is_cut_off(strings[a], strings[b]) for a, b in rows], bool)
        one, other = one[differ], other[differ]
        self.contradicting += len(one)
        for a, b in list(zip(one.tolist(), other.tolist(), strict=True))[: MOST_LISTED - len(self.contradictions)]:
            apart = float(np.linalg.norm(self.table["position"][a] - self.table["position"][b]))
            values = [self.landmarks.values[self.table["value"][row]] for row in (a, b)]
            room, maps = int(self.table["room"][b]), [int(self.owner[a]), int(self.owner[b])]
            place = {"room": room if room >= 0 else None, "apart_m": round(apart, 2) if np.isfinite(apart) else None}
            self.contradictions.append({"what": what, "values": values, "maps": maps, **place})


def is_cut_off(one: str, other: str) -> bool:
    """Return whether one of two numbers may be the other one, of which a reader lost an end: 0.12 and 0.129."""
    short, long = sorted((fold_text(one), fold_text(other)), key=len)
    return len(long) > 2 and len(long) - len(short) == 1 and (long.startswith(short) or long.endswith(short))


def _number_strings(values: Sequence[str]) -> Array:
    """Return the (n,) number of each string, the same of equal ones."""
    numbers = {value: k for k, value in enumerate(dict.fromkeys(values))}
    return np.array([numbers[value] for value in values], np.int64)


def _find_nearest(position: Array, group: Array, before: Array, own: Array, reach: float) -> tuple[Array, Array]:
    """Return the (k,) distance of each own row to the nearest row before of its group, inf beyond reach; and that row's place
    there."""
    if not len(before) or not len(own):
        return np.full(len(own), np.inf), np.zeros(len(own), np.int64)
    rank = np.searchsorted(np.unique(group[before]), group[np.concatenate([before, own])])
    unlike = ~np.isin(group[own], group[before])
    places = np.column_stack([position[np.concatenate([before, own])], 4 * reach * rank])
    # What lies in one place is one point of the tree: a million at one would be searched a million times.
    _, single = np.unique(np.round(places[: len(before)] / ROUNDING), axis=0, return_index=True)
    far, nearest = cKDTree(places[: len(before)][single]).query(places[len(before) :], distance_upper_bound=reach)
    far[unlike] = np.inf
    return far, np.append(single, 0)[nearest]


def _pair_nearest(before: Array, own: Array, far: Array, nearest: Array) -> tuple[Array, Array]:
    """Return the pairs of `_find_nearest`, each row once: of several with one nearest row the one that is nearest to it."""
    rows = np.flatnonzero(np.isfinite(far))
    rows = rows[np.lexsort((far[rows], nearest[rows]))]
    _, first = np.unique(nearest[rows], return_index=True)
    return before[nearest[rows[first]]], own[rows[first]]
