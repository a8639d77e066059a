"""Finding a place among many maps: are the right building and the right room among the first? (`fusion.atlas.find`)

``python evaluate.py task=retrieval write=docs/results/learning.md``: of a cached set of evaluation pairs (``manifest``, which
``python -m topomerge.datasets.pairs.build data=heldout cache=cache/evaluation`` makes) the first map of each pair stands in the
atlas, and the second map of each pair that has a room in common is looked for: compared with all maps, and with those on
a shortlist. ``data=real``: real maps are looked for among those of the set and all other real ones.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topomerge.datasets.core.building import find_physical_building
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, load_evaluation_pair, load_set
from topomerge.datasets.pairs.own_pairs import build_own_sets, check_own_path
from topomerge.datasets.real.maps import build_real_pairs
from topomerge.datasets.real.sources import REAL_SOURCES
from topomerge.embedding.learned import build_embedder
from topomerge.embedding.quarter_turns import Descriptor, Rows
from topomerge.evaluation.tasks import Row, TaskSettings, find_real_data
from topomerge.fusion.atlas.find import SHORTLIST, rank_sightings, select_shortlist
from topomerge.fusion.atlas.partners import (
    compute_queries,
    compute_vectors,
    count_votes,
    find_nearest,
    iter_most_similar,
    list_owners,
)
from topomerge.statistics import format_interval
from topomerge.types import LogFn

FIRST = (1, 5, 10)
PARTNER_PAIRS, PARTNER_DRAWS = 15, 40  # pairs in an atlas of which partners are asked for, and how often they are drawn
MAKERS = ("topomerge.embedding.learned", "topomerge.fusion.atlas.find", "topomerge.extraction.extract")


@dataclass
class Settings(TaskSettings):
    """Settings of the task.

    Args:
        descriptor: as of topomerge match.
        manifest: of the cached pairs, below `cache`.
        path: of ``data=folder``: a folder of captures with a `pairs.yaml`, whose test pairs are taken instead.
    """

    descriptor: str = "learned"
    manifest: str = "evaluation/heldout.jsonl"
    path: str = ""


@dataclass(frozen=True)
class Search:
    """A map that was looked for.

    Args:
        building: the physical one.
        rank: of the first map of its building, from 1.
        first: name of the map that came first.
        rooms: share of its rooms with a partner that stand beside it in the pair's map, if that map is named.
        seconds: of the search, without the rows of the new map.
    """

    building: str
    rank: int
    first: str
    rooms: float
    seconds: float


def get_building(pair: EvaluationPair) -> str:
    """Return the physical building of a pair."""
    return find_physical_building(str(pair.about["source"]), str(pair.about["building"]))


def search_pairs(
    pairs: Sequence[EvaluationPair], rows: Sequence[tuple[Rows, Rows]], compared: int, first: int | None = None
) -> list[Search]:
    """Look for the second map of each pair that has a room in common among the first maps of all pairs.

    Args:
        compared: maps that are compared room by room; with fewer than all by a shortlist.
        first: pairs of which one is looked for; all if left out.
    """
    of, atlas = [get_building(pair) for pair in pairs], [a for a, _ in rows]
    places, owner = np.concatenate([compute_vectors(a) for a in atlas]), list_owners([len(a) for a in atlas])
    out = []
    for k, pair in enumerate(pairs[:first]):
        if not len(pair.matches):
            continue
        began = time.process_time()
        maps, new = list(range(len(pairs))), rows[k][1]
        if compared < len(pairs):
            asked = compute_queries(new)
            maps = select_shortlist(
                count_votes(*find_nearest(places, np.concatenate(asked)), len(asked), owner, len(pairs)), compared
            )
        sightings = rank_sightings([str(m) for m in maps], [atlas[m] for m in maps], new, compared)
        seconds = time.process_time() - began
        rank = next((n for n, s in enumerate(sightings, 1) if of[int(s.name)] == of[k]), len(pairs))
        best = {new: room for s in sightings if s.name == str(k) for new, room, _ in s.rooms}
        true = {(int(i), int(j)) for i, j in pair.matches}
        with_partner = sorted({j for _, j in true})
        right = [(best.get(j), j) in true for j in with_partner]
        out.append(Search(of[k], rank, sightings[0].name, float(np.mean(right)), seconds))
    return out


def search_real_pairs(
    pairs: Sequence[EvaluationPair], rows: Sequence[tuple[Rows, Rows]], real: Sequence[EvaluationPair], describe: Descriptor
) -> tuple[list[Search], str]:
    """Look for the second map of each real pair among the first maps of all pairs; and which ones are not first, in words."""
    ours = [(describe(a), describe(b)) for a, b in (pair.load_maps() for pair in real)]
    those = search_pairs([*real, *pairs], [*ours, *rows], len(real) + len(pairs), len(real))
    named = [pair for pair in real if len(pair.matches)]
    late = [f"{pair.about['title']} {s.rank}" for pair, s in zip(named, those, strict=True) if s.rank > 1]
    return those, f"Not first: {', '.join(late) or 'none'}."


def measure_named_partners(pairs: Sequence[tuple[Rows, Rows]]) -> float:
    """Return share of pairs of which one map names the other, in an atlas of all of them."""
    named = list(iter_most_similar([a for a, _ in pairs] + [b for _, b in pairs], FIRST[-1]))
    return float(np.mean([k + len(pairs) in named[k] or k in named[k + len(pairs)] for k in range(len(pairs))]))


def format_partners(pairs: Sequence[EvaluationPair], rows: Sequence[tuple[Rows, Rows]]) -> str:
    """Report how many of the pairs with a room in common atlases would register."""
    common = [of for pair, of in zip(pairs, rows, strict=True) if len(pair.matches)]
    rng = np.random.default_rng(0)
    draws = [rng.permutation(len(common))[:PARTNER_PAIRS] for _ in range(PARTNER_DRAWS)]
    few = np.mean([measure_named_partners([common[k] for k in draw]) for draw in draws])
    text = f"Pairs in which one map is among the {FIRST[-1]} most similar of the other: {few:.2f} of {PARTNER_PAIRS} pairs in an"
    all_of_them = f"{measure_named_partners(common):.2f} of {len(common)} in one of {2 * len(common)}"
    return f"{text} atlas of {2 * PARTNER_PAIRS} maps ({PARTNER_DRAWS} draws), {all_of_them}."


def table(results: Sequence[tuple[str, Sequence[Search]]], maps: int, buildings: int, rooms: int) -> str:
    """Return named results as Markdown."""
    groups = np.array([r.building for r in results[0][1]])
    by_chance = [1 - (1 - 1 / buildings) ** n for n in FIRST]
    lines = [
        f"Queries: {len(groups)} maps of {len(set(groups))} physical buildings; atlas: {maps} maps of {buildings} buildings with "
        f"{rooms} rooms. In brackets 95 % intervals over buildings.",
        "",
        "| embedder | building first | among 5 | among 10 | same first map | rooms matched right | s per query |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, of in results:
        first = [format_interval(np.array([r.rank <= n for r in of], float), groups) for n in FIRST]
        right = format_interval(np.array([r.rooms for r in of]), groups)
        same = np.mean([r.first == one.first for r, one in zip(of, results[0][1], strict=True)])
        seconds = np.median([r.seconds for r in of])
        lines.append(f"| {name} | {' | '.join(first)} | {same:.2f} | {right} | {seconds:.2f} |")
    return "\n".join([*lines, f"| by chance | {' | '.join(f'{c:.2f}' for c in by_chance)} | | | |"])


def load_real_pairs(cache: Path) -> list[EvaluationPair]:
    """Load all real pairs, extracted where they are missing."""
    return [load_evaluation_pair(file) for file in build_real_pairs(str(find_real_data()), cache, REAL_SOURCES)]


def count_rooms(pairs: Sequence[EvaluationPair]) -> int:
    """Count the rooms of the first maps."""
    return sum(len(pair.load_maps()[0].rooms) for pair in pairs)


def find_manifest(settings: Settings, log_line: LogFn) -> Path:
    """Find the manifest of the pairs; that of one's own is made where it is missing.

    Raises:
        InputError: whatever is wrong with the folder.
    """
    check_own_path(settings.data.set, settings.path)
    if settings.path:
        return build_own_sets(settings.path, settings.cache, settings.jobs, log_line, settings.data.set).manifests["test"]
    return Path(settings.cache) / settings.manifest


def list_inputs(settings: Settings) -> list[str]:
    """Return names of set and descriptor."""
    return [settings.data.set, settings.path or settings.manifest, settings.descriptor]


def measure(settings: Settings, log_line: LogFn) -> list[Row]:
    """Look for every map: one row with the tables' words, as searches are seconds beside the descriptors."""
    pairs = load_set(find_manifest(settings, log_line))[: settings.data.limit or None]
    name, describe = settings.descriptor, build_embedder(settings.descriptor)
    rows = [(describe(a), describe(b)) for a, b in (pair.load_maps() for pair in pairs)]
    log_line(f"{len(rows)} pairs described")
    if settings.data.set == "real":
        real = load_real_pairs(Path(settings.cache) / "evaluation")
        results, summary = search_real_pairs(pairs, rows, real, describe)
        atlas = [*real, *pairs]
        text = table([(name, results)], len(atlas), len({get_building(pair) for pair in atlas}), count_rooms(atlas))
        return [{"name": "retrieval-real", "text": f"{text}\n\n{summary}"}]
    compared = [(name, search_pairs(pairs, rows, len(pairs)))]
    if len(pairs) > SHORTLIST:
        compared.append((f"{name}, shortlist of {SHORTLIST}", search_pairs(pairs, rows, SHORTLIST)))
    text = table(compared, len(pairs), len({get_building(pair) for pair in pairs}), count_rooms(pairs))
    return [{"name": "retrieval", "text": f"{text}\n\n{format_partners(pairs, rows)}"}]


def tabulate(rows: Sequence[Row], settings: Settings) -> dict[str, str]:
    """Give the tables of the one row."""
    return {row["name"]: row["text"] for row in rows}
