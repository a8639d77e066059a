"""Merging of more than two maps: those that an atlas finds to belong to the first one, as `merge` gives two."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

from topomerge.embedding.embedders import DEFAULT, descriptor_name
from topomerge.embedding.room_cells import Descriptor
from topomerge.fusion.atlas.solve import AtlasResult, Known, atlas
from topomerge.fusion.fuse import rooms_in_common
from topomerge.fusion.result import STEPS, MergeResult, RoomMatch
from topomerge.matching.odds import match_probability
from topomerge.types import TopometricMap


def merge_many(
    maps: Sequence[TopometricMap],
    *,
    scale: str = "fixed",
    force: bool = False,
    threshold: float | None = None,
    embedder: str | Descriptor = DEFAULT,
) -> MergeResult:
    """As `merge`. What belongs to the first map is joined; the reason names the maps that stand apart.

    Raises:
        InputError: as `atlas`.
    """
    began = time.perf_counter()
    known: Known = {}
    rooms = None if embedder == DEFAULT else embedder  # the default only says which pairs to try first
    found = atlas(maps, scale=scale, threshold=threshold, embedder=rooms, known=known)
    reason, status = found.words(), "merged" if _of_first(found)[1:] else "abstained"
    if status == "abstained" and found.status != "abstained":
        reason = f"not merged: {found.names[0]} stands apart; {reason}"
    if force and found.status != "merged":
        reason += "; joined all the same, as was asked for (--force)"
        found = atlas(maps, scale=scale, threshold=0.0, embedder=rooms, known=known)
    members = _of_first(found)
    own = found.component_of(0)
    joined = found.joined(own) if len(members) > 1 else None
    seconds = {**dict.fromkeys(STEPS, 0.0), "fuse": time.perf_counter() - began}
    return MergeResult(
        status,
        found.probability(own),
        reason,
        transforms={k: found.transforms[k] for k in members[1:]},
        matches=tuple(_matches(maps, found, members)),
        seconds=seconds,
        map=joined,
        maps=tuple(maps),
        atlas=found,
        warnings=found.warnings,
        descriptor=descriptor_name(embedder),
    )


def _of_first(found: AtlasResult) -> tuple[int, ...]:
    return found.components[found.component_of(0)]


def _matches(maps: Sequence[TopometricMap], found: AtlasResult, members: Sequence[int]) -> Iterator[RoomMatch]:
    """Rooms of every two maps that lie in each other."""
    sure = found.probability(found.component_of(0))
    for n, k in enumerate(members):
        for m in members[n + 1 :]:
            pose = found.transforms[k].inverse() @ found.transforms[m]
            rooms, fit = rooms_in_common(maps[k], maps[m], pose)
            chance = sure * match_probability(maps[k], maps[m], rooms, fit)
            for (i, j), p in zip(rooms.tolist(), chance.tolist(), strict=True):
                yield RoomMatch((k, m), (i, j), p)
