"""A picture of a case: extracted rooms in colour, true rooms outlined, true doors as rings, those found as dots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import shapely
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from topomerge.datasets.simulation.floor_truth import TRUTH_CELL
from topomerge.evaluation.scans import Scan
from topomerge.io.atomic import replacing
from topomerge.io.palette import room_colours
from topomerge.types import Array, TopometricMap

WIDE = 13.0  # inches


def save_picture(scan: Scan, map: TopometricMap, columns: Array, verdict: Any, title: str, path: Path) -> None:
    """Draw one panel a storey, in the frame of the building."""
    truth = scan.truth
    assert truth is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context():
        mpl.rcdefaults()
        levels, rows, width = columns.shape
        figure = Figure(figsize=(WIDE, levels * (WIDE * rows / width + 0.3) + 0.5))
        FigureCanvasAgg(figure)
        points = truth.place(scan.cloud.points.astype(np.float64) + scan.cloud.shift)
        for k, axes in enumerate(figure.subplots(levels, 1, squeeze=False).ravel()):
            draw_storey(axes, scan, map, columns[k], k, verdict, points)
        figure.suptitle(title, fontsize=9)
        figure.tight_layout()
        with replacing(path) as beside:
            figure.savefig(beside, format="png", dpi=80)


def draw_storey(axes: Any, scan: Scan, map: TopometricMap, labels: Array, k: int, verdict: Any, points: Array) -> None:
    """Draw a storey: its points, rooms and doors, found and true."""
    truth = scan.truth
    assert truth is not None
    high, (x, y) = truth.origin + np.array(labels.shape[::-1]) * TRUTH_CELL, truth.origin
    extent = (x, high[0], y, high[1])
    image = np.full((*labels.shape, 3), 255, np.uint8)
    if len(map.rooms):
        image[labels >= 0] = room_colours(map)[labels[labels >= 0]]
    z = points[:, 2] - truth.floors[k]
    ij, inside = truth.columns(points[(z > 0.4) & (z < 1.9)])
    dark = np.bincount(ij[inside, 0] * labels.shape[1] + ij[inside, 1], minlength=labels.size).reshape(labels.shape)
    image[dark > (min(np.percentile(dark[dark > 0], 60), dark.max() - 1) if dark.any() else 0)] //= 2
    axes.imshow(image, origin="lower", extent=extent, interpolation="nearest")
    for i, room in enumerate(scan.rooms):
        if room.storey == k:
            wanted = bool(truth.visited[i])
            ring = np.concatenate([room.polygon, room.polygon[:1]])
            axes.plot(*ring.T, color="#c00000" if wanted else "#999999", linewidth=1.0, linestyle="-" if wanted else ":")
            if wanted:
                value = verdict.rooms.each[i]
                at = shapely.get_coordinates(shapely.Polygon(room.polygon).buffer(0).point_on_surface())[0]
                axes.text(*at, f"{value:.2f}", fontsize=6, ha="center", color="red" if value < 0.5 else "black", clip_on=True)
    edges = map.edges
    at = truth.place(edges["centre"])
    near = np.abs(at[:, 2] - truth.floors[k]) < 1.5
    doors = truth.doors[np.abs(truth.doors[:, 4] - truth.floors[k]) < 1.0]
    axes.scatter(doors[:, 2], doors[:, 3], s=70, facecolors="none", edgecolors="green", linewidths=1.5)
    axes.scatter(*at[near, :2].T, s=12, color="black")
    axes.set_xlim(extent[:2])
    axes.set_ylim(extent[2:])
    axes.tick_params(labelsize=6)
