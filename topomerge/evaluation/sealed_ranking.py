"""Ranking of rooms in the sealed run: is a room's true partner the nearest, by the embedder that ships or by engineered
features?

Two scans of a procedural building, two of a sealed plan, both halves of a sealed robot grid. Rooms of grids have no names: those
that lie over each other under the true transform are one, as for real pairs elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.physical import physical_building
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, laid, twins
from topomerge.datasets.pairs.pairs import Pair, PairSettings, make_pair
from topomerge.datasets.pairs.truth import room_truth, true_matches
from topomerge.embedding.embedders import embedder
from topomerge.embedding.turns import aligned
from topomerge.evaluation.groups import value
from topomerge.evaluation.score import rank_counts
from topomerge.evaluation.tables import cell
from topomerge.extraction.extract import extract
from topomerge.matching.costs import descriptor_costs
from topomerge.types import TopometricMap

Row = dict[str, Any]
RANKED = ("learned", "engineered")
SENSOR_PAIRS = (("tls", "depth"), ("lidar", "tablet"), ("depth", "laser2d"), ("tls", "lidar"))
RANKED_ROOMS, RANKED_OVERLAP = 10, 0.5
RANKED_METRICS = ("recall@1", "recall@1_single", "recall@5")


def building_ranks(kind: str, seed: int, sensors: tuple[str, str]) -> list[Row]:
    """Two scans of a procedural building."""
    settings = PairSettings(overlap=RANKED_OVERLAP, sensors=sensors, rooms=RANKED_ROOMS)
    pair = make_pair(make_building(kind, seed), settings, seed, source="procedural")
    return ranks(pair, physical_building("procedural", pair.building))


def ranks(pair: Pair, place: str) -> list[Row]:
    """Counts of a pair's rooms, a row for each embedder; none where no room has a partner."""
    maps = [extract(cloud, voxel_size=0.1) for cloud in (pair.a, pair.b)]
    judged = judged_pair(pair, maps)
    if not len(judged.matches):
        return []
    out = []
    for name in RANKED:
        describe = embedder(name)
        a, b = aligned(describe(maps[0]), describe(maps[1]))
        counts = rank_counts(judged, descriptor_costs(a, b))
        out.append({"place": place, "building": place, "pair": pair.name, "embedder": name, **counts})
    return out


def judged_pair(pair: Pair, maps: Sequence[TopometricMap]) -> EvaluationPair:
    """What is true of two extracted maps; nothing is kept of them."""
    truths = [room_truth(map, cloud) for map, cloud in zip(maps, (pair.a, pair.b), strict=True)]
    labelled = bool(pair.a.rooms)
    matches = true_matches(truths[0], truths[1], pair.shared) if labelled else laid(pair, maps)
    true, rooms = [truth["room"] for truth in truths], (pair.a.rooms, pair.b.rooms)
    alike = [twins(true[k], true[1 - k], rooms[k], rooms[1 - k]) for k in (0, 1)]
    glimpsed = [np.array(map.rooms["glimpsed"], bool) for map in maps]
    one = [truth["one"] for truth in truths]
    about = {"rooms": "labelled" if labelled else "laid"}
    return EvaluationPair(
        pair.name, Path(), matches, (true[0], true[1]), (one[0], one[1]), (alike[0], alike[1]), (glimpsed[0], glimpsed[1]),
        pair.truth, np.zeros(3), about,
    )  # fmt: skip


def table(rows: Sequence[Row]) -> list[str]:
    """Lines in Markdown."""
    out = ["| ranking of rooms | embedder | pairs | buildings | rooms with a partner | recall@1 | without twin | recall@5 |"]
    out.append("|" + "---|" * 8)
    for group in dict.fromkeys(row["group"] for row in rows):
        for name in RANKED:
            some = [row for row in rows if row["group"] == group and row["embedder"] == name]
            sizes = [len(some), len({row["place"] for row in some}), sum(row["queries"] for row in some)]
            scores = [cell(value(some, column)) for column in RANKED_METRICS]
            out.append(f"| {' | '.join([group, name, *map(str, sizes), *scores])} |")
    return out
