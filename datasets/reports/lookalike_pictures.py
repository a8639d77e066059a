"""The picture of look-alikes in `docs/data.md`: ``python -m topomerge.datasets.reports.lookalike_pictures docs/images``.

A row a kind: map a, map b, and b (orange) laid on a (blue) where they are alike and must not be put together.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from topomerge.datasets.pairs.grid_pairs import GridPair, unpacked
from topomerge.datasets.pairs.lookalike_places import LOOKALIKES
from topomerge.datasets.pairs.lookalikes import LookalikeRecipe, lookalike_arrays, lookalike_items
from topomerge.datasets.reports.gallery import save

from topomerge.types import Array, Sim3, VoxelGrid

MAP_COLOURS = ("#1f5fa8", "#c2410c")  # of a and of b
STANDING = (0.3, 1.8)  # m above the floor: what is drawn
PICTURE_SEED = 4  # of the set that the picture shows
PICTURED = ("tls", "depth")  # sensors of the pairs that are drawn


def lookalike_picture(pairs: list[GridPair]) -> Figure:
    """A row a pair."""
    figure = Figure(figsize=(12.0, 2.6 * len(pairs)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(pairs), 3, squeeze=False)
    for row, pair in zip(axes, pairs, strict=True):
        alike = pair.about["alike"]
        pose = _pose(np.array(alike)) if alike is not None else Sim3()
        a, b = standing(pair.a, Sim3()), standing(pair.b, pose)
        for ax, shown in zip(row, ((a,), (None, b), (a, b)), strict=True):
            _draw(ax, shown, np.concatenate([a, b]))
        about: dict[str, Any] = pair.about
        amount = ", ".join(f"{k} {about['amount'].get(k, 0):g}" for k in ("walls", "fitted", "furniture"))
        verdict = "tellable" if about["tellable"] else "nobody can tell"
        row[0].set_title(f"{about['lookalike']}, furniture {about['furniture']}: a", fontsize=9)
        row[1].set_title(f"b ({' and '.join(about['sensors'])})", fontsize=9)
        row[2].set_title(f"laid on each other: {verdict} ({amount})", fontsize=9)
    return figure


def standing(grid: VoxelGrid, pose: Sim3) -> Array:
    """(n, 2) columns, m, of what stands between two heights over the floor; the floor is the lowest that holds many cells."""
    cells = pose.apply(grid.centroids())
    floor = float(np.quantile(cells[:, 2], 0.02))
    height = cells[:, 2] - floor
    inside = (height > STANDING[0]) & (height < STANDING[1])
    return np.unique(np.round((cells[inside] if inside.any() else cells)[:, :2], 1), axis=0)


def _pose(matrix: Array) -> Sim3:
    scale = float(np.linalg.norm(matrix[:3, 0]))
    x, y, z = matrix[:3, 3].tolist()
    return Sim3(float(np.arctan2(matrix[1, 0], matrix[0, 0])), (x, y, z), scale)


def _draw(ax: Axes, shown: tuple[Array | None, ...], extent: Array) -> None:
    for points, colour in zip(shown, MAP_COLOURS, strict=False):
        if points is not None:
            ax.plot(*points.T, "s", color=colour, markersize=0.9, markeredgewidth=0, alpha=0.7)
    low, high = extent.min(axis=0) - 0.5, extent.max(axis=0) + 0.5
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    ax.set_axis_off()


def main(folder: str) -> None:
    """Write the picture."""
    one, sensors = dict.fromkeys(LOOKALIKES, 1), dict.fromkeys(PICTURED, 1.0)
    recipe = LookalikeRecipe(pairs=one, sensors=sensors, scaled=0.0, seed=PICTURE_SEED)
    pairs = [unpacked(item.name, lookalike_arrays(item)) for item in lookalike_items(recipe)]
    save(lookalike_picture(pairs), Path(folder) / "lookalikes.png")


if __name__ == "__main__":
    main(sys.argv[1])
