"""Which maps and rooms of an atlas does a new map show? The rows of all rooms are compared, and it is laid coarsely on the maps
that show most of them; nothing is registered.

Each room of the new map has one vote. It goes to the rooms of the atlas that look most like it, shared by how alike they are, and
by whether they lie where all of it is most alike; both are means over the turns of a map. A map's share is that of the
votes that its rooms got: it says where to look first, not whether the place is there at all. That is what `merge` is for.
The first `COARSE_CANDIDATES` are ordered by how well their walls fit: rooms of small maps look like those of many others.

Of an atlas of more than `SHORTLIST` maps only so many are compared that closely: those for which the nearest neighbours of the
new map's rooms speak, by exact search or an index (`prepare_rooms_index`), and those that hold rare strings or access points of
the new map (`landmarks.map_search`). A rare string that both hold counts as much as one that agrees may count in a merge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from topomerge.embedding.learned import DEFAULT
from topomerge.embedding.learned import build_embedder as make_embedder
from topomerge.embedding.quarter_turns import Rows, TurnedRows, average_turns, estimate_turns
from topomerge.errors import InputError
from topomerge.fusion.atlas.folder import StoredAtlas, read_atlas
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.partners import (
    VOTE_SHARPNESS,
    compute_coarse_log_odds,
    compute_queries,
    count_votes,
    find_nearest,
    list_owners,
)
from topomerge.fusion.atlas.rooms_index import RoomRows, compute_embedder_signature, prepare_rooms_index
from topomerge.io.maps import load_landmarks, load_map
from topomerge.landmarks.likelihood import KINDS
from topomerge.landmarks.map_search import build_landmark_index
from topomerge.matching.match import embed_rooms
from topomerge.types import Array, TopometricMap

SHORTLIST = 50  # maps that are compared room by room
COARSE_CANDIDATES = 10  # maps with the largest shares, that the new one is laid on
STRING_ODDS = float(np.log(KINDS["text"].most))  # log odds of a map that holds a rare string of the new one
ELSEWHERE = 0.1  # of a room's vote counts for a room that does not lie where those of most rooms do


@dataclass(frozen=True)
class Sighting:
    """A map of an atlas that a new one may show.

    Args:
        name: of the map in the atlas.
        share: of the votes of the new map's rooms; over all maps that were compared they sum to 1.
        rooms: (room of the new map, room of this one, cosine of their rows), most alike first: rooms that are each other's most
            alike one in the other map.
        fit: log odds that the best rigid pose of both maps is right, seen by itself (`partners.compute_coarse_log_odds`); None
            where none was looked for.
        landmarks: rare strings that both hold, and what radio counts as, in such strings.
    """

    name: str
    share: float
    rooms: tuple[tuple[int, int, float], ...]
    fit: float | None = None
    landmarks: float = 0.0


def find(folder: str | Path, map: TopometricMap, number: int = 5) -> tuple[Sighting, ...]:
    """Return the maps of an atlas that a new one most likely shows, best first.

    Args:
        number: of maps, at most.

    Raises:
        InputError: no folder or no map, no atlas, one without maps or whose `rooms.npz` or `rooms_index.npz` is damaged or of
            another embedder, a map without rooms, or a number below 1.
    """
    if not isinstance(folder, str | Path) or not isinstance(map, TopometricMap):
        given = f"{type(folder).__name__} and {type(map).__name__}"
        raise InputError(f"find takes the folder of an atlas and a map, find(folder, map), not {given}")
    if number < 1:
        raise InputError(f"the number of maps to name must be 1 or more, not {number}")
    stored = read_atlas(folder)
    if not stored.entries:
        raise InputError(f"{folder}: holds no maps yet; add some with `topomerge atlas add {folder} MAP ...`")
    if not len(map.rooms):
        raise InputError(f"{map.source or 'the map'}: no rooms in it, nothing can be looked for")
    embedder = str(stored.settings.get("embedder") or DEFAULT)
    describe = make_embedder(embedder)
    new, signature = embed_rooms(describe, map), compute_embedder_signature(embedder)
    rows = RoomRows(stored, describe, signature, new)
    maps = list(range(len(stored.entries)))
    if len(maps) > max(SHORTLIST, number):
        maps = select_shortlist(_score_maps(stored, rows, signature, new), max(SHORTLIST, number))
    worth = rank_by_landmarks(stored, map)
    maps += sorted(worth.keys() - set(maps))
    names = {stored.entries[k].name: worth.get(k, 0.0) for k in maps}
    ranked = [replace(s, landmarks=names[s.name]) for s in rank_sightings(list(names), rows.get_rows(maps), new, len(maps))]
    sightings = sorted(ranked, key=lambda s: -s.landmarks)[: max(number, COARSE_CANDIDATES)]
    return register_sightings(stored, map, sightings)[:number]


def rank_by_landmarks(stored: StoredAtlas, map: TopometricMap) -> dict[int, float]:
    """Rank the maps of an atlas by rare landmarks that both hold: number of a map -> worth (`LandmarkIndex.rank`)."""
    if not len(map.landmarks):
        return {}
    files = [stored.folder / e.file for e in stored.entries]
    index = build_landmark_index(load_map(file) if len(load_landmarks(file)[0]) else None for file in files)
    return dict(index.rank(map))


def register_sightings(stored: StoredAtlas, map: TopometricMap, sightings: Sequence[Sighting]) -> tuple[Sighting, ...]:
    """Return the first of the sightings with how well the map fits there, in that order, then the others as they were."""
    files = {e.name: stored.folder / e.file for e in stored.entries}
    first = sightings[:COARSE_CANDIDATES]
    both = Maps([map, *(files[s.name] for s in first)])
    scale = str(stored.settings.get("scale") or "fixed")
    fitted = [replace(s, fit=compute_coarse_log_odds(both, 0, k, scale)) for k, s in enumerate(first, 1)]
    fitted.sort(key=lambda s: -((s.fit or 0.0) + STRING_ODDS * s.landmarks))
    return *fitted, *sightings[COARSE_CANDIDATES:]


def _score_maps(stored: StoredAtlas, rows: RoomRows, signature: str, new: Rows) -> Array:
    """Count the votes for each map of an atlas, of the neighbours of the new map's rooms."""
    counts = [e.rooms for e in stored.entries]
    asked = compute_queries(new)
    flat = asked.reshape(-1, asked.shape[2])
    index = prepare_rooms_index(stored, rows, signature, asked.shape[2])
    if index is not None:
        return count_votes(*index.find_nearest(flat), len(asked), index.owner, len(counts))
    return count_votes(
        *find_nearest(rows.compute_vectors(range(len(counts))), flat), len(asked), list_owners(counts), len(counts)
    )


def select_shortlist(scores: Array, number: int) -> list[int]:
    """Return maps with the most votes, as many as asked for, by their numbers."""
    return sorted(np.argsort(-scores, kind="stable")[:number].tolist())


def rank_sightings(names: Sequence[str], rows: Sequence[Rows], new: Rows, number: int) -> tuple[Sighting, ...]:
    """Run `find` with rows of length 1 of each map and of the new one."""
    both = [_compute_similarity(new, of) for of in rows]
    alike, weight = [cosine for cosine, _ in both], [np.exp(VOTE_SHARPNESS * (cosine - 1)) * counted for cosine, counted in both]
    total = np.maximum(np.sum([w.sum(axis=1) for w in weight], axis=0), 1e-300)
    sightings = []
    for name, w, cosine in zip(names, weight, alike, strict=True):
        sightings.append(Sighting(name, float((w / total[:, None]).sum() / len(new)), _find_mutual_pairs(cosine)))
    return tuple(sorted(sightings, key=lambda s: -s.share)[:number])


def _find_mutual_pairs(cosine: Array) -> tuple[tuple[int, int, float], ...]:
    """Find the rooms (R_new, R) that are each other's most alike one, and how alike; most alike first."""
    if not cosine.size:
        return ()
    best, back = cosine.argmax(axis=1), cosine.argmax(axis=0)
    pairs = [(i, j, float(cosine[i, j])) for i, j in enumerate(best.tolist()) if back[j] == i]
    return tuple(sorted(pairs, key=lambda pair: -pair[2]))


def _compute_similarity(new: Rows, rows: Rows) -> tuple[Array, Array]:
    """Return (R_new, R) how alike rooms are, and by how much their vote counts: less where they are not moved as most are."""
    if not isinstance(new, TurnedRows) or not isinstance(rows, TurnedRows):
        cosine = _normalise_rows(np.asarray(new)) @ _normalise_rows(np.asarray(rows)).T
        return cosine, np.ones_like(cosine)
    turns = estimate_turns(new, rows)
    counted = ELSEWHERE + (1 - ELSEWHERE) * average_turns(turns, lambda turn: turn.coincidence)
    return average_turns(turns, lambda turn: turn.cosine), counted


def _normalise_rows(rows: Array) -> Array:
    out: Array = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)
    return out
