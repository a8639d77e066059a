"""Rooms that stand near each other as neighbours, too, with or without a door between them.

Doors are missed, and lead into rooms that one of two maps has not seen. How far away the rooms around are, and how large, is
mostly the same in both.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from topomerge.embedding.schema import EDGE_KINDS, column, width
from topomerge.types import Array

STOREY_CLIMB = 2.0  # m at most, between the middles of rooms of one storey
DISTANCE, CLIMB, TURN_COS = (column("edge_attr", feature) for feature in ("distance", "climb", "turn_cos"))
KIND_COLUMNS = [column("edge_attr", kind) for kind in EDGE_KINDS]


def with_rooms_around(graph: Mapping[str, Array], reach: float) -> dict[str, Array]:
    """`edge_index`, `edge_attr` and `edge_pos` of `embedding.graph` with an edge between any two rooms of a storey whose middles
    are at most `reach` (m, seen from above) apart.

    Its features are the distance and the climb; it is of no kind. Ways back stay half of all edges behind the ways there.
    """
    pos = np.asarray(graph["pos"], float)
    away = np.linalg.norm(pos[:, None, :2] - pos[None, :, :2], axis=2)
    first, second = np.nonzero(np.triu((away <= reach) & (abs(pos[:, None, 2] - pos[None, :, 2]) <= STOREY_CLIMB), 1))
    features = np.zeros((len(first), width("edge_attr")), np.float32)
    features[:, DISTANCE], features[:, CLIMB], features[:, TURN_COS] = away[first, second], pos[second, 2] - pos[first, 2], 1.0
    back = features.copy()
    back[:, CLIMB] *= -1
    middle = (pos[first] + pos[second]) / 2
    index, attr, places = (np.asarray(graph[name]) for name in ("edge_index", "edge_attr", "edge_pos"))
    half = index.shape[1] // 2
    ways = np.concatenate([index[:, :half], [first, second], index[:, half:], [second, first]], axis=1)
    return {
        "edge_index": ways.astype(np.int64),
        "edge_attr": np.concatenate([attr[:half], features, attr[half:], back]).astype(np.float32),
        "edge_pos": np.concatenate([places[:half], middle, places[half:], middle]),
    }


def through_doors(graph: Mapping[str, Array]) -> Array:
    """(2E,) bool: which edges are doors, openings or stairs."""
    return np.asarray(np.asarray(graph["edge_attr"])[:, KIND_COLUMNS].any(axis=1))
