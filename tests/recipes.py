"""What the smallest sets of pairs in the tests are made of: small houses by a depth camera, in coarse cells."""

from __future__ import annotations

from typing import Any

SMALL_HOUSES: dict[str, Any] = {
    "seed": 4,
    "sources": {"procedural": 1.0},
    "kinds": {"house": 1.0},
    "overlaps": [0.5],
    "sensors": {"depth": 1.0},
    "rooms": [3, 4],
    "points_per_room": 16,
    "voxel_size": 0.15,
}
