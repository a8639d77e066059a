"""Plans of a map: every storey from above, rooms coloured, with the graph of how one walks between them."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from topomerge.archive import replace_on_success
from topomerge.io.rooms_ply import assign_room_colours
from topomerge.types import TopometricMap
from topomerge.viz.plan import Frame, Place, StoreyView, compute_frame, find_label_places, rasterize_storeys

PAPER, NO_ROOM, WALL_INK, TEXT_INK = "#ffffff", "#e4e4e4", "#333333", "#222222"
EDGE_LINES: dict[str, dict[str, Any]] = {
    "door": {"color": "#1b1b1b", "linestyle": "-", "marker": "s"},
    "opening": {"color": "#1b1b1b", "linestyle": (0, (4, 2)), "marker": "o"},
    "stairs": {"color": "#a00060", "linestyle": (0, (1, 1.2)), "marker": "^"},
    "ramp": {"color": "#a00060", "linestyle": (0, (4, 2)), "marker": "v"},
}
PAGE = (15.0, 10.0)  # inches: panels are arranged to fill this
LARGEST_FIGURE = 24.0  # inches along an axis, of a figure that needs more for its room numbers to be read
PANEL_MARGIN = (0.6, 0.4, 0.3, 0.4)  # inches around a panel's plan: left, bottom, right, top
TOP, BOTTOM = 0.55, 0.85  # inches for the title, and for the scale bar with the legend
NARROWEST = 3.0  # inches of a panel, which must hold its caption
DPI = 150


def plot_plan(map: TopometricMap) -> Figure:
    """Draw a map from above, one panel a storey at one scale, lowest first.

    Args:
        map: any map, also one without rooms.

    Returns:
        A matplotlib figure that belongs to no window. The same map gives the same figure.
    """
    frame = compute_frame(map)
    plans = rasterize_storeys(map, frame)
    named = [find_label_places(plan, frame) for plan in plans]
    with mpl.rc_context():
        mpl.rcdefaults()  # the user's own style must not change what the file shows
        columns, inches = _arrange(len(plans), frame, named)
        figure, axes = _create_panels(len(plans), columns, inches, frame)
        colours = assign_room_colours(map) / 255.0
        everywhere = {room: place for of_storey in named for room, place in of_storey.items()}
        for storey, (ax, plan) in enumerate(zip(axes, plans, strict=True)):
            _draw_cells(ax, plan, frame, colours)
            _draw_edges(ax, map, storey, everywhere)
            _draw_rooms(ax, named[storey], inches)
            _label_panel(ax, map, storey)
        _draw_scale_bar(figure, frame, inches)
        _draw_title(figure, map)
    return figure


def save_figure(map: TopometricMap, path: str | Path) -> None:
    """Write `plot_plan` in the format that the name ends with (.png, .pdf, .svg, .jpg, …).

    Raises:
        InputError: the path can't be written.
        ValueError: an unknown format.
    """
    figure = plot_plan(map)
    kind = Path(path).suffix.lower().removeprefix(".") or "png"
    # No date and no program's name, so that the same map gives the same file.
    undated = {"png": {"Software": None}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
    with mpl.rc_context({"svg.hashsalt": "topomerge"}), replace_on_success(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # a sign in the scan's name that the font lacks is drawn as a box
        figure.savefig(temporary, format=kind, dpi=DPI, metadata=undated.get(kind))


def _arrange(panels: int, frame: Frame, named: list[dict[int, Place]]) -> tuple[int, float]:
    """Return the columns of panels, and inches a metre, so that the page is filled and most room numbers fit into their rooms."""
    width, height = (frame.high - frame.low).tolist()
    left, bottom, right, top = PANEL_MARGIN

    def inches(columns: int, page: tuple[float, float]) -> float:
        rows = math.ceil(panels / columns)
        wide = (max(page[0] / columns, NARROWEST) - left - right) / width
        high = ((page[1] - TOP - BOTTOM) / rows - bottom - top) / height
        return min(wide, high)

    columns = max(range(1, panels + 1), key=lambda c: inches(c, PAGE))
    clear = sorted(place.clear for of_storey in named for place in of_storey.values())
    requested = 0.09 / clear[len(clear) // 4] if clear else 0.0  # a number of 6 points in three of four rooms
    fitting = inches(columns, PAGE)
    return columns, max(fitting, min(requested, inches(columns, (LARGEST_FIGURE, LARGEST_FIGURE))), 1e-6)


def _create_panels(count: int, columns: int, inches: float, frame: Frame) -> tuple[Figure, list[Axes]]:
    """Create a figure with one panel a storey, sized so that a metre measures `inches` everywhere."""
    width, height = ((frame.high - frame.low) * inches).tolist()
    left, bottom, right, top = PANEL_MARGIN
    rows = math.ceil(count / columns)
    pitch = max(width + left + right, NARROWEST)
    across, down = max(columns * pitch, 6.0), rows * (height + bottom + top) + TOP + BOTTOM
    figure = Figure(figsize=(across, down), facecolor=PAPER)
    FigureCanvasAgg(figure)
    start = (across - columns * pitch) / 2 + (pitch - width + left - right) / 2
    axes = []
    for k in range(count):
        row, column = divmod(k, columns)
        x = start + column * pitch
        y = down - TOP - top - height - row * (height + bottom + top)
        ax = figure.add_axes((x / across, y / down, width / across, height / down))
        ax.set(xlim=(frame.low[0], frame.high[0]), ylim=(frame.low[1], frame.high[1]))
        axes.append(ax)
    return figure, axes


def _draw_cells(ax: Axes, plan: StoreyView, frame: Frame, colours: Any) -> None:
    image = np.ones((*frame.shape, 4))
    image[..., :3] = mpl.colors.to_rgb(PAPER)
    image[plan.floor] = mpl.colors.to_rgba(NO_ROOM)
    inside = plan.room >= 0
    image[inside, :3] = colours[plan.room[inside]]
    image[plan.wall] = mpl.colors.to_rgba(WALL_INK)
    (left, bottom), (right, top) = frame.low, frame.high
    extent = (float(left), float(right), float(bottom), float(top))
    ax.imshow(image.transpose(1, 0, 2), origin="lower", extent=extent, interpolation="nearest", aspect="auto")


def _draw_edges(ax: Axes, map: TopometricMap, storey: int, places: dict[int, Place]) -> None:
    """Draw lines from room to door to room; of stairs the half that lies on this storey, with the room that they lead to."""
    labelled: set[int] = set()  # rooms above or below that a label names already
    for edge in map.edges:
        a, b = edge["rooms"].tolist()
        rooms = [room for room in (a, b) if map.rooms["storey"][room] == storey and room in places]
        if not rooms:
            continue
        x, y = edge["centre"][:2].tolist()
        style = EDGE_LINES.get(str(edge["kind"]), EDGE_LINES["door"])
        ends = [(places[room].x, places[room].y) for room in rooms]
        path = [ends[0], (x, y), *ends[1:]]
        look = {"color": style["color"], "linestyle": style["linestyle"], "linewidth": 1.0}
        ax.plot([p[0] for p in path], [p[1] for p in path], zorder=3, solid_capstyle="round", **look)
        marker = {"marker": style["marker"], "markersize": 4.5, "markerfacecolor": PAPER, "markeredgewidth": 1.0}
        ax.plot([x], [y], linestyle="none", color=style["color"], zorder=4, **marker)
        other = b if rooms[0] == a else a
        if len(rooms) == 1 and other not in labelled:
            labelled.add(other)
            up = map.rooms["storey"][other] > storey
            text = f"{'up' if up else 'down'} to {other}"
            box = {"boxstyle": "round,pad=0.15", "facecolor": PAPER, "edgecolor": "none", "alpha": 0.85}
            ax.annotate(text, (x, y), (0, 5 if up else -5), textcoords="offset points", ha="center", fontsize=6.5,
                        va="bottom" if up else "top", color=style["color"], zorder=6, bbox=box)  # fmt: skip


def _draw_rooms(ax: Axes, named: dict[int, Place], inches: float) -> None:
    """Draw a node with its number at each room; as large as the room lets it be, within what can be read and looks calm."""
    for room, place in sorted(named.items()):
        digits = 0.32 * len(str(room)) + 0.4  # half the width of the node, of a number one point high
        size = float(np.clip(place.clear * inches * 72 / digits, 6.0, 8.5))
        shape = "circle,pad=0.25" if room < 10 else "round,pad=0.3,rounding_size=0.8"
        disc = {"boxstyle": shape, "facecolor": PAPER, "edgecolor": TEXT_INK, "linewidth": 0.8}
        ax.text(place.x, place.y, str(room), fontsize=size, ha="center", va="center", color=TEXT_INK, zorder=5, bbox=disc)


def _label_panel(ax: Axes, map: TopometricMap, storey: int) -> None:
    ax.tick_params(labelsize=7, colors="#777777", length=2.5, width=0.6)
    ax.ticklabel_format(useOffset=False, style="plain")
    for spine in ax.spines.values():
        spine.set(edgecolor="#bbbbbb", linewidth=0.6)
    if storey < len(map.storeys):
        count = int((map.rooms["storey"] == storey).sum())
        rooms = f"{count} room{'' if count == 1 else 's'}"
        text = f"Storey {storey} · {rooms} · floor at {map.storeys['floor'][storey]:.2f} m"
        ax.set_title(text, fontsize=9, color=TEXT_INK, loc="left", pad=5)


def _draw_scale_bar(figure: Figure, frame: Frame, inches: float) -> None:
    """Draw a bar of a round length above the legend; it holds for every panel."""
    width = float((frame.high - frame.low).max())
    length = max((s for s in (0.1, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500) if s <= 0.2 * width), default=0.1)
    across, down = figure.get_size_inches()
    half, y = length * inches / across / 2, 0.62 / down
    bar = Line2D([0.5 - half, 0.5 + half], [y, y], color=TEXT_INK, linewidth=2.5, solid_capstyle="butt")
    figure.add_artist(bar)
    figure.text(0.5 + half + 0.08 / across, y, f"{length:g} m", ha="left", va="center", fontsize=8, color=TEXT_INK)


def _draw_title(figure: Figure, map: TopometricMap) -> None:
    rooms, storeys = len(map.rooms), len(map.storeys)
    counts = f"{rooms} room{'' if rooms == 1 else 's'}, {storeys} storey{'' if storeys == 1 else 's'}"
    high = figure.get_size_inches()[1]
    name = map.title
    text = f"{name}: {counts}".replace("$", r"\$")  # a dollar would start a formula
    figure.text(0.5, 1 - 0.3 / high, text, ha="center", va="center", fontsize=13, color=TEXT_INK, weight="bold")
    kinds = [kind for kind in EDGE_LINES if kind in set(map.edges["kind"].tolist())]
    handles = [
        Line2D([], [], label=kind, linewidth=1.2, markersize=5, markerfacecolor=PAPER, **EDGE_LINES[kind]) for kind in kinds
    ]
    square: dict[str, Any] = {"linestyle": "none", "marker": "s", "markersize": 8}
    handles += [Line2D([], [], color=WALL_INK, label="wall", **square), Line2D([], [], color=NO_ROOM, label="no room", **square)]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=8.5,
                  bbox_to_anchor=(0.5, 0.05 / high))  # fmt: skip
