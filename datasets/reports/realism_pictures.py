"""Simulated and real maps as pictures, side by side: ``python -m topomerge.datasets.reports.realism_pictures docs/images``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.script import print_lines
from topomerge.datasets.reports.realism_sources import DRAWN_ROOMS, real_clouds
from topomerge.datasets.simulation.scanner import scan
from topomerge.datasets.simulation.session import session

from topomerge.errors import InputError
from topomerge.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PIXEL = 0.04  # m
Column = str | tuple[str, int, str, str]  # a real cloud, or kind and seed of a building, kind of room, and sensor
PICTURES: dict[str, tuple[tuple[float, float], list[Column]]] = {  # file -> slice (m above the floor) and columns
    "realism_depth": ((0.3, 2.0), ["octomap fr078", ("lab", 101, "lab", "depth"), ("office", 103, "office", "depth")]),
    "realism_tablet": (
        (1.8, 4.0),
        ["iPad pix4d_user 470_user", "iPad user 808-60", ("lab", 100, "lab", "tablet"), ("lab", 109, "lab", "tablet")],
    ),
    "realism_laser": ((0.3, 2.0), ["apartment cloud_0", "apartment cloud_1", ("apartment", 104, "bedroom", "tls")]),
}  # fmt: skip
PICTURE_MARGIN = 1.2  # m about a simulated room

View = tuple[str, Array, float]  # title, points (n, 3) m, height of the floor


def real(folder: Path) -> dict[str, View]:
    """The real clouds of the pictures, turned so that their longer side lies across, about their room where it was drawn."""
    wanted = {column for _, columns in PICTURES.values() for column in columns if isinstance(column, str)}
    out = {}
    for title, cloud, floor, _ in real_clouds(folder):
        if title in wanted:
            points = cloud.points.astype(float)
            drawn = DRAWN_ROOMS.get(title.split()[-1])
            if drawn is not None:
                low, high = np.min(drawn, axis=0) - PICTURE_MARGIN, np.max(drawn, axis=0) + PICTURE_MARGIN
                points = points[((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)]
            out[title] = (f"real: {title}", turned(points), floor)
    return out


def turned(points: Array) -> Array:
    """Points turned about the vertical so that most of their extent lies along x."""
    flat = points[:, :2] - points[:, :2].mean(axis=0)
    angle = min(np.radians(np.arange(0, 180, 2)), key=lambda a: np.ptp(flat @ [-np.sin(a), np.cos(a)]))
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([flat @ [c, s], flat @ [-s, c], points[:, 2]])


def simulated(kind: str, seed: int, room: str, sensor: str) -> View:
    """The largest room of a kind in a procedural building, scanned on its own."""
    building = make_building(kind, seed, 1)
    of_kind = [i for i, r in enumerate(building.rooms) if r.kind == room]
    largest = max(of_kind, key=lambda i: float(np.prod(np.ptp(building.rooms[i].polygon, axis=0))))
    cloud = scan(session(building, rng=seed), sensor, [largest], seed)
    corners = building.rooms[largest].polygon
    low, high = corners.min(axis=0) - PICTURE_MARGIN, corners.max(axis=0) + PICTURE_MARGIN
    points = cloud.points.astype(float)
    points = points[((points[:, :2] > low) & (points[:, :2] < high)).all(axis=1)]
    return f"simulated: {sensor}, {room} in {kind} {seed}", turned(points), 0.0


def draw(folder: Path, out: Path) -> list[Path]:
    """Write every picture: above a slice from above, below a vertical section 0.8 m thick through the middle."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    clouds, paths = real(folder), []
    for name, (heights, columns) in PICTURES.items():
        views = [clouds[c] if isinstance(c, str) else simulated(*c) for c in columns if not isinstance(c, str) or c in clouds]
        figure = Figure(figsize=(4.2 * len(views), 5.6), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(2, len(views), squeeze=False, height_ratios=(3, 1.6))
        for k, (title, points, floor) in enumerate(views):
            z = points[:, 2] - floor
            sliced = points[(z > heights[0]) & (z < heights[1])]
            _density(axes[0, k], sliced[:, :2])
            axes[0, k].set_title(title, fontsize=9)
            middle = np.abs(points[:, 1] - np.median(points[:, 1])) < 0.4
            _density(axes[1, k], np.column_stack([points[middle, 0], z[middle]]))
        paths.append(out / f"{name}.png")
        figure.savefig(paths[-1], dpi=72)
    return paths


def _density(ax: Axes, points: Array) -> None:
    """Points as darkness, on a logarithmic scale."""
    low, high = points.min(axis=0) - PIXEL, points.max(axis=0) + 2 * PIXEL
    count, (x, y) = np.histogramdd(points, bins=[np.arange(a, b, PIXEL) for a, b in zip(low, high, strict=True)])
    most = np.log1p(np.quantile(count[count > 0], 0.95)) if count.any() else 1.0
    span = (float(x[0]), float(x[-1]), float(y[0]), float(y[-1]))
    ax.imshow(np.log1p(count.T), origin="lower", extent=span, cmap="gray_r", vmin=0, vmax=most, interpolation="nearest")
    ax.tick_params(labelsize=7)


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the pictures into a folder."""
    parser = argparse.ArgumentParser(prog="python -m topomerge.datasets.reports.realism_pictures", description=__doc__)
    parser.add_argument("out", type=Path, help="folder of the pictures")
    parser.add_argument("--data", type=Path, default=os.environ.get("TOPOMERGE_DATA"), help="folder of the real data")
    options = parser.parse_args(arguments)
    return print_lines(_pictures(options.data, options.out))


def _pictures(folder: str | Path | None, out: Path) -> Iterator[Path]:
    if not folder or not out.is_dir():
        raise InputError("name the folder of the real data (--data, or TOPOMERGE_DATA) and one for the pictures that exists")
    yield from draw(Path(folder), out)


if __name__ == "__main__":
    sys.exit(main())
