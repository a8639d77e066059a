"""Where the windows of a building are: told from its triangles of glass."""

from __future__ import annotations

import numpy as np
from topomerge.datasets.core.building import SURFACES, Building

LOW_SILL = 0.3  # m: panes that begin lower are walls of glass


def panes(building: Building) -> list[tuple[float, ...]]:
    """Windows: their middle at the height of the floor, direction of the normal (rad), width and depth of the reveal (m)."""
    return [(*place, 0.3) for *place, _, _ in glazed(building)]


def glazed(building: Building) -> list[tuple[float, ...]]:
    """Windows: middle at the height of the floor, direction of the normal (rad), width, sill and head above the floor (m)."""
    glass = building.triangles[building.labels == SURFACES.index("glass")]
    windows = []
    for triangle in glass[::2]:  # two make a pane
        corners = building.vertices[triangle].astype(float)
        low, high = corners[:, 2].min(), corners[:, 2].max()
        floors = building.storeys["floor"]
        floor = float(floors[floors <= low + LOW_SILL].max(initial=floors[0]))
        ends = corners[np.argsort(corners[:, 2])][:2, :2] if corners[1, 2] == low else corners[[0, 2], :2]
        wide = ends[1] - ends[0]
        if low > floor + LOW_SILL and high > low and np.hypot(*wide) > 0.2:
            direction = float(np.arctan2(wide[1], wide[0]) + np.pi / 2)
            windows.append((*ends.mean(axis=0).tolist(), floor, direction, float(np.hypot(*wide)), low - floor, high - floor))
    return windows
