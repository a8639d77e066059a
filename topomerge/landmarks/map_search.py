"""Which maps of many do the landmarks of one speak of: by rare texts and tags that both hold, and by radio."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from topomerge.landmarks.evidence import RARE
from topomerge.landmarks.radio_search import RadioIndex, build_radio_index, rank_maps
from topomerge.landmarks.sightings import build_sightings
from topomerge.types import TopometricMap

SEARCHED = ("text", "tag", "name")
MOST_MAPS = 5  # in which a string stands: one that stands in more names no place
ALIKE = 0.3  # likeness of radio, from which on a map is named
RADIO_WORTH = 2.0  # rare strings that radio counts as, where it names one map alone
LEAST_WORTH = 0.2  # below, a map is not named


@dataclass(frozen=True, eq=False)
class LandmarkIndex:
    """Strings and access points of maps.

    Args:
        strings: kind and string -> numbers of the maps that hold it.
        radio: of the maps `radio_maps`; None where none has any.
    """

    strings: dict[tuple[str, str], tuple[int, ...]]
    radio: RadioIndex | None = None
    radio_maps: tuple[int, ...] = ()

    def rank(self, map: TopometricMap, but: int = -1) -> list[tuple[int, float]]:
        """Rank the maps that the landmarks of one speak of, best first: number and worth, in rare strings that both hold.

        Args:
            but: number of a map that is left out, as it is this one.
        """
        worth: dict[int, float] = {}
        for entry in list_strings(map) if self.strings else ():
            holders = [k for k in self.strings.get(entry, ()) if k != but]
            if len(holders) <= MOST_MAPS:
                for k in holders:
                    worth[k] = worth.get(k, 0.0) + 1 / len(holders)
        best: dict[int, float] = {}
        for ranked in rank_maps(self.radio, map.landmarks) if self.radio is not None else ():
            k = self.radio_maps[ranked.map]
            if k != but and ranked.likeness >= ALIKE:
                best[k] = max(best.get(k, 0.0), ranked.probability)
        for k, probability in best.items():
            worth[k] = worth.get(k, 0.0) + RADIO_WORTH * probability / max(sum(best.values()), 1e-9)
        return sorted(((k, w) for k, w in worth.items() if w >= LEAST_WORTH), key=lambda kw: (-kw[1], kw[0]))


def list_strings(map: TopometricMap) -> list[tuple[str, str]]:
    """List what a map's signs, tags and names say, each once, as far as it is rare in buildings."""
    found: dict[tuple[str, str], None] = {}
    for kind in SEARCHED:
        sightings = build_sightings(map, (kind,))
        for k in np.flatnonzero(sightings.share <= RARE).tolist():
            found["tag" if kind == "tag" else "text", sightings.keys[k]] = None
    return list(found)


def build_landmark_index(maps: Iterable[TopometricMap | None]) -> LandmarkIndex:
    """Build the index of maps, of which those without landmarks may be None."""
    strings: dict[tuple[str, str], tuple[int, ...]] = {}
    readings = []
    for k, map in enumerate(maps):
        if map is None or not len(map.landmarks):
            continue
        for entry in list_strings(map):
            strings[entry] = (*strings.get(entry, ()), k)
        if map.landmarks.is_kind("radio").any():
            readings.append((k, map))
    radio = build_radio_index([map for _, map in readings]) if readings else None
    return LandmarkIndex(strings, radio, tuple(k for k, _ in readings))
