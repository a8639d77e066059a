"""Is a map a longer version of one that an atlas holds? Then it takes that one's place, and keeps its pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from topomerge.fusion.atlas.solve import Proposed
from topomerge.fusion.atlas.stored import Entry, Stored
from topomerge.fusion.fuse import rooms_in_common
from topomerge.fusion.inputs import link_threshold
from topomerge.fusion.registration import register
from topomerge.types import Sim3, TopometricMap

LONGER = 0.8  # of a map's rooms, that a longer version of it has at least


@dataclass(frozen=True)
class Longer:
    """A longer version of a map.

    Args:
        name: of the map in the atlas.
        pose: of the new map in the frame of the one before.
        rooms: of the one before that the new one has, too.
        of: rooms of the one before.
    """

    name: str
    pose: Sim3
    rooms: int
    of: int


def longer_version(name: str, old: TopometricMap, new: TopometricMap, stored: Stored) -> Longer | None:
    """Where a new map lies in the one before, if it is a longer version of it: if their registration is believed as a link of the
    atlas would be, and the new map has most rooms of the one before.

    Args:
        name: of the old map in the atlas.
    """
    registration = register(old, new, scale=stored.settings["scale"], same=stored.settings["same"])
    if registration.transform is None or registration.probability < link_threshold(stored.settings["threshold"]):
        return None
    pairs, _ = rooms_in_common(old, new, registration.transform)
    rooms = len(np.unique(pairs[:, 0]))
    if rooms < LONGER * len(old.rooms):
        return None
    return Longer(name, registration.transform, rooms, len(old.rooms))


def replaced(stored: Stored, longer: Longer, new: Entry) -> tuple[Stored, Proposed]:
    """An atlas in which the new map stands where the one before stood, and where it may lie in those that were linked with it.

    Args:
        new: entry of the new map, under any name.
    """
    old = next(e for e in stored.entries if e.name == longer.name)
    entry = replace(new, name=old.name, frame=old.frame @ longer.pose)
    proposed = {}
    for (a, b), pose in stored.lying().items():
        if a == old.key:
            proposed[new.key, b] = longer.pose.inverse() @ pose
        elif b == old.key:
            proposed[a, new.key] = pose @ longer.pose
    return replace(stored, entries=tuple(entry if e is old else e for e in stored.entries)), proposed
