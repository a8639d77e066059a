"""How the doors around a room lie: each door with every other one nearby, by numbers that depend on no frame.

Middles of rooms that were seen in part are off by a metre; doors are not. Their constellation tells rooms of one plan apart that
are alike by themselves.
"""

from __future__ import annotations

import numpy as np

from topomerge.embedding.schema import LAYOUT_FEATURES
from topomerge.types import Array

LAYOUT_REACH = 12.0  # m at most between two doors, seen from above
LAYOUT_CLIMB = 2.0  # m at most between doors of one storey


def door_layout(edge_index: Array, middle: Array, door: Array) -> tuple[Array, Array]:
    """Pairs of edges (columns of `edge_index`) whose doors are two, and near, in both orders; and (M, 5) float32 of each.

    Args:
        edge_index: (2, 2E) as of `embedding.graph`: the second half are the ways back of the first.
        middle: (R, 3) of rooms, m.
        door: (2E, 3) of the edges' doors, m.

    Returns:
        (2, M) int64, by the first edge ascending; (M, 5) `LAYOUT_FEATURES`, of the second door seen from the first one's room.
    """
    count = edge_index.shape[1]
    if not count:
        return np.zeros((2, 0), np.int64), np.zeros((0, len(LAYOUT_FEATURES)), np.float32)
    door, number = np.asarray(door, float), np.arange(count) % (count // 2)
    away = door[None] - door[:, None]
    distance = np.linalg.norm(away[..., :2], axis=2)
    near = (distance <= LAYOUT_REACH) & (abs(away[..., 2]) <= LAYOUT_CLIMB) & (number[:, None] != number[None])
    first, second = np.nonzero(near)
    out = (door - np.asarray(middle, float)[edge_index[0]])[first, :2]
    to, apart = away[first, second], distance[first, second]
    size = np.maximum(np.linalg.norm(out, axis=1) * apart, 1e-9)
    sine = (out[:, 0] * to[:, 1] - out[:, 1] * to[:, 0]) / size
    cosine = (out * to[:, :2]).sum(axis=1) / size
    same = edge_index[0][first] == edge_index[0][second]
    columns = np.stack([apart, to[:, 2], sine, cosine, same], axis=1)
    return np.stack([first, second]).astype(np.int64), columns.astype(np.float32)
