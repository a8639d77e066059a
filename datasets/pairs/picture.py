"""A picture of simulated maps: the true plan of each storey, the rooms of both maps, their points and their walks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.pairs import Pair

from topomerge.types import Array, PointCloud, Sim3, TrueRoom

ONLY_A, ONLY_B, BOTH, NEITHER, OUTLINE_INK = "#aaccee", "#f3c0a5", "#b5dca9", "#f4f4f4", "#555555"
COLOURS = ("#1f5fa8", "#c2410c")  # points and walk of a and of b
DRAWN_POINTS = 60_000  # of a cloud, drawn
SLICE = (0.3, 2.0)  # m above the floor: walls and furniture
WIDEST = 1600  # pixels


def save_picture(building: Building, made: Pair | PointCloud, frame: Sim3, path: Path, dpi: int = 100) -> None:
    """Write `picture` as PNG; the same maps give the same file."""
    picture(building, made, frame).savefig(path, format="png", dpi=dpi, metadata={"Software": None})


def picture(building: Building, made: Pair | PointCloud, frame: Sim3) -> Figure:
    """Draw each storey that a map visits in the frame of the building; maps of two buildings stand side by side."""
    if isinstance(made, PointCloud):
        every = tuple(i for i, r in enumerate(building.rooms) if r.kind != "lift")
        panels = _panels(building.rooms, [(made, frame, every, 0)])
        title = f"{made.source}: {len(building.rooms)} rooms"
    else:
        assert made.frames is not None
        sides = [(made.a, made.frames[0], made.visited[0], 0), (made.b, made.frames[1], made.visited[1], 1)]
        if made.kind == "overlap":
            panels = _panels(building.rooms, sides)
        else:
            panels = [p for side in sides for p in _panels(_rooms_of(side[0], side[1]), [side])]
        title = f"{made.name}: {100 * made.overlap:.0f} % of rooms in common"
    return _draw(panels, title, len({side[3] for p in panels for side in p[2]}))


def _rooms_of(cloud: PointCloud, frame: Sim3) -> tuple[TrueRoom, ...]:
    """The rooms of a cloud in the frame of its building."""
    from topomerge.datasets.simulation.scanner import moved

    return moved(cloud, frame.inverse()).rooms


def _panels(rooms: tuple[TrueRoom, ...], sides: list[Any]) -> list[Any]:
    """(rooms, storey, sides) of each storey that is visited."""
    storeys = sorted({rooms[i].storey for side in sides for i in side[2]})
    return [(rooms, storey, sides) for storey in storeys]


def _draw(panels: list[Any], title: str, maps: int) -> Figure:
    spans = [np.ptp(np.concatenate([r.polygon for r in rooms if r.storey == k]), axis=0) for rooms, k, _ in panels]
    width, height = np.max(spans, axis=0) + 2.0
    columns = 1 if width > 2 * height else min(len(panels), 2 if width > 0.6 * height else 3)
    rows = -(-len(panels) // columns)
    inches = min(14.0 / (columns * width), 10.0 / (rows * height))
    figure = Figure(figsize=(max(columns * width * inches, 5.0), rows * height * inches + 0.9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, (rooms, storey, sides) in zip(axes, panels, strict=False):
        _draw_storey(ax, rooms, storey, sides)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    figure.suptitle(title, fontsize=11)
    fills = [(ONLY_A, "visited by a"), (ONLY_B, "visited by b"), (BOTH, "visited by both"), (NEITHER, "not visited")]
    fills = fills if maps == 2 else [fills[0], fills[3]]
    lines = [(COLOURS[k], f"walls and walk of {'ab'[k]}") for k in range(maps)]
    handles = [Patch(facecolor=c, edgecolor=OUTLINE_INK, label=t) for c, t in [*fills, *lines]]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=8, frameon=False)
    return figure


def _draw_storey(ax: Axes, rooms: tuple[TrueRoom, ...], storey: int, sides: list[Any]) -> None:
    here = [i for i, room in enumerate(rooms) if room.storey == storey]
    for i in here:
        by = {side[3] for side in sides if i in side[2]}
        colour = BOTH if len(by) == 2 else NEITHER if not by else (ONLY_A, ONLY_B)[by.pop()]
        ax.add_patch(Polygon(rooms[i].polygon, facecolor=colour, edgecolor=OUTLINE_INK, linewidth=0.8))
        x, y = rooms[i].polygon.mean(axis=0).tolist()
        ax.annotate(str(i), (x, y), fontsize=7, ha="center", va="center", color=OUTLINE_INK)
    floor = min(rooms[i].floor for i in here)
    above = min((r.floor for r in rooms if r.floor > floor + 1.0), default=floor + 20.0)
    for cloud, frame, _, which in sides:
        back = frame.inverse()
        step = max(len(cloud) // (4 * DRAWN_POINTS), 1)
        points = back.apply(cloud.points[::step])
        height = points[:, 2] - floor
        walls = points[(height > SLICE[0]) & (height < SLICE[1])][:, :2]
        ax.plot(*walls[:: max(len(walls) // DRAWN_POINTS, 1)].T, ",", color=COLOURS[which], alpha=0.35, zorder=3, rasterized=True)
        if cloud.poses is not None:
            _draw_walk(ax, back.apply(cloud.poses[:, :3, 3]), floor, above, COLOURS[which])
    corners = np.concatenate([rooms[i].polygon for i in here])
    (left, bottom), (right, top) = corners.min(axis=0) - 1, corners.max(axis=0) + 1
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", title=f"storey {storey}")
    ax.tick_params(labelsize=7)


def _draw_walk(ax: Axes, at: Array, floor: float, above: float, colour: str) -> None:
    """The positions of the sensor on this storey; a line joins those of one round."""
    here = (at[:, 2] > floor) & (at[:, 2] < above + 0.2)
    far = np.linalg.norm(np.diff(at, axis=0), axis=1) > 1.0  # a surveyor with a tripod leaves no line
    pieces = np.split(np.where(here[:, None], at, np.nan), np.flatnonzero(far) + 1)
    for piece in pieces:
        ax.plot(piece[:, 0], piece[:, 1], "-", color=colour, linewidth=1.0, alpha=0.8, zorder=4)
    ax.plot(at[here, 0], at[here, 1], ".", color=colour, markersize=3.0, zorder=5)
