"""The pictures of `docs/data.md`: ``python -m topomerge.datasets.reports.gallery docs/images``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from topomerge.datasets.buildings.furniture import footprints
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.pairs.pairs import Pair, PairSettings, make_pair
from topomerge.datasets.pairs.picture import picture
from topomerge.datasets.pairs.truth import room_truth, true_matches

from topomerge.extraction.extract import extract
from topomerge.io.palette import PALETTE
from topomerge.types import Array, TopometricMap
from topomerge.viz.plan import frame_of, storey_plans

GALLERY_BUILDINGS = (
    ("office", 7, 2),
    ("hotel", 3, 1),
    ("hospital", 4, 1),
    ("school", 5, 1),
    ("apartment", 2, 1),
    ("house", 6, 2),
)
GALLERY_PAIRS: tuple[tuple[str, int, int, float, tuple[str, str], str | None], ...] = (
    ("office", 7, 1, 0.5, ("tls", "depth"), None),
    ("hospital", 4, 1, 0.25, ("lidar", "tls"), None),
    ("school", 9, 2, 0.5, ("depth", "lidar"), None),
    ("hotel", 3, 2, 0.5, ("tls", "depth"), "other-storey"),
)
FILLS = {"corridor": "#e8e4da", "stairs": "#e3d3ea", "lift": "#e3d3ea", "bath": "#cfe6f2", "toilets": "#cfe6f2"}
PLAN_INK, FURNITURE, DOOR_COLOUR = "#444444", "#b9a98c", "#c2410c"


def building_picture(building: Building) -> Figure:
    """Plans of all storeys with furniture, doors (red) and stairs (violet)."""
    count = len(building.storeys)
    corners = np.concatenate([room.polygon for room in building.rooms])
    low, high = corners.min(axis=0) - 0.5, corners.max(axis=0) + 0.5
    figure, axes = _sheet(count, high - low)
    for storey, ax in enumerate(axes):
        _draw_storey(ax, building, storey)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        ax.set_title(f"{building.name}, storey {storey}: {sum(r.storey == storey for r in building.rooms)} rooms", fontsize=9)
    return figure


def _sheet(count: int, size: Array) -> tuple[Figure, list[Axes]]:
    """Panels one above the other, or side by side where they are high."""
    width, height = size.tolist()
    rows, columns = (count, 1) if width > height else (1, count)
    inches = min(9.0 / (columns * width), 7.0 / (rows * height))
    figure = Figure(figsize=(columns * width * inches + 0.6, rows * (height * inches + 0.5)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for ax in axes:
        ax.tick_params(labelsize=6)
    return figure, axes


def _draw_storey(ax: Axes, building: Building, storey: int) -> None:
    floor = float(building.storeys["floor"][storey])
    for room in (r for r in building.rooms if r.storey == storey):
        ax.add_patch(Polygon(room.polygon, facecolor=FILLS.get(room.kind, "#f6f6f2"), edgecolor=PLAN_INK, linewidth=0.7))
    things = building.things
    bottom = things["centre"][:, 2] - things["size"][:, 2] / 2
    standing = (bottom > floor - 0.1) & (bottom < floor + 1.0) & (things["kind"] != "leaf")
    for thing in things[standing]:
        outline = footprints(thing["centre"][None, :2], thing["yaw"][None], thing["size"])[0]
        ax.add_patch(Polygon(outline, facecolor=FURNITURE, edgecolor="none", alpha=0.8))
    for stair in building.stairs[building.stairs["storeys"][:, 0] == storey]:
        ax.add_patch(Polygon(stair["footprint"], facecolor="none", edgecolor="#7a3e9d", linewidth=1.0, hatch="///"))
    for door in building.doors[np.abs(building.doors["centre"][:, 2] - floor) < 0.5]:
        along = np.array([-np.sin(door["direction"]), np.cos(door["direction"])]) * door["width"] / 2
        ends = door["centre"][:2] + np.array([-along, along])
        ax.plot(*ends.T, color=DOOR_COLOUR, linewidth=2.0, solid_capstyle="butt")


def match_picture(pair: Pair, maps: tuple[TopometricMap, TopometricMap]) -> Figure:
    """The rooms that were extracted from both maps, each in its own frame; rooms of one colour and number are the same true room,
    pale ones have no partner in the other map."""
    truths = [room_truth(m, c) for m, c in zip(maps, (pair.a, pair.b), strict=True)]
    matches = true_matches(truths[0], truths[1], pair.shared)
    frames = [frame_of(m) for m in maps]
    size = np.max([f.high - f.low for f in frames], axis=0)
    storeys = [storey_plans(m, f) for m, f in zip(maps, frames, strict=True)]
    count = max(map(len, storeys))
    figure = Figure(figsize=(11.0, min(count * 5.5 * float(size[1] / size[0]) + 0.6, 11.0)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(count, 2, squeeze=False)
    for k in (0, 1):
        partner = set(matches[:, k].tolist())
        for storey in range(count):
            axes[storey, k].set_axis_off()
            if storey < len(storeys[k]):
                _draw_rooms(axes[storey, k], storeys[k][storey], frames[k], truths[k], partner)
        title = f"{'ab'[k]}: {pair.sensors[k]}, {len(truths[k])} rooms extracted, {len(partner)} with a partner"
        axes[0, k].set_title(title, fontsize=9)
    return figure


def _draw_rooms(ax: Axes, plan: Any, frame: Any, truth: Array, partner: set[int]) -> None:
    image = np.full((*frame.shape, 3), 1.0)
    image[plan.floor] = 0.93
    for room in np.unique(plan.room[plan.room >= 0]).tolist():
        inside = plan.room == room
        colour = PALETTE[truth["room"][room] % len(PALETTE)] / 255 if room in partner else np.full(3, 0.82)
        image[inside] = colour
        i, j = np.argwhere(inside).mean(axis=0)
        if truth["room"][room] >= 0:
            ax.text(
                i,
                j,
                str(truth["room"][room]),
                fontsize=7,
                ha="center",
                va="center",
                weight="bold" if room in partner else "normal",
            )
    image[plan.wall] = 0.2
    ax.imshow(image.transpose(1, 0, 2), origin="lower", interpolation="nearest")


def save(figure: Figure, path: Path, dpi: int = 80) -> None:
    """Write a PNG of few colours: small, and the same for the same picture."""
    from PIL import Image

    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    image.quantize(96, dither=Image.Dither.NONE).save(path, optimize=True)


def main(folder: str) -> None:
    """Write all pictures."""
    for kind, seed, storeys in GALLERY_BUILDINGS:
        save(building_picture(make_building(kind, seed, storeys)), Path(folder) / f"building_{kind}.png")
    for number, (kind, seed, storeys, overlap, sensors, hard) in enumerate(GALLERY_PAIRS):
        building = make_building(kind, seed, storeys)
        pair = make_pair(building, PairSettings(overlap, sensors, 12, hard=hard), seed)
        assert pair.frames is not None
        save(picture(building, pair, pair.frames[0]), Path(folder) / f"pair_{number}_maps.png")
        maps = (extract(pair.a), extract(pair.b))
        save(match_picture(pair, maps), Path(folder) / f"pair_{number}_rooms.png")


if __name__ == "__main__":
    main(sys.argv[1])
