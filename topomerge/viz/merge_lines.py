"""Both maps side by side with a line from each room to the room that it is in the other map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from topomerge.fusion.result import RoomMatch
from topomerge.io.palette import room_colours
from topomerge.types import Array, TopometricMap
from topomerge.viz.markup import Markup, element
from topomerge.viz.outline import room_outlines, wall_outline
from topomerge.viz.plan import StoreyPlan, places
from topomerge.viz.scene import hex_colour
from topomerge.viz.sheet import Sheet

MAP_GAP = 0.12  # of the width, between the two maps and between storeys
LINES_WIDTH = 1100  # pixels that the drawing is expected to have
Drawn = tuple[Sheet, list[StoreyPlan]]


def lines_view(
    maps: Sequence[TopometricMap], drawn: Sequence[Drawn], matches: Sequence[RoomMatch], colours: Sequence[Array | None]
) -> Markup:
    """The storeys of a at the left, those of b at the right, the lowest at the bottom, and a line for each match, the
    stronger the surer.

    Args:
        drawn: of `merge_plan.laid_alike`.
        colours: (R, 3) uint8 of the rooms of either map; neighbours differ if None.
    """
    sizes = [np.array(sheet.size) for sheet, _ in drawn]
    gap = round(MAP_GAP * (sizes[0][0] + sizes[1][0]))
    tall = [len(plans) * size[1] + (len(plans) - 1) * gap // 2 for (_, plans), size in zip(drawn, sizes, strict=True)]
    width, height = int(sizes[0][0] + gap + sizes[1][0]), int(max(tall))
    parts, at = [], []
    for k, (m, (sheet, plans), colour) in enumerate(zip(maps, drawn, colours, strict=True)):
        corner = np.array([0 if k == 0 else sizes[0][0] + gap, height - tall[k]])
        spots: dict[int, tuple[int, int]] = {}
        for storey, plan in enumerate(plans):
            x, y = (corner + (0, (len(plans) - 1 - storey) * (sizes[k][1] + gap // 2))).tolist()
            parts.append(element("g", *_storey(m, sheet, plan, colour), transform=f"translate({x} {y})"))
            for room, place in places(plan, sheet.frame).items():
                u, v = sheet.at((place.x, place.y))
                spots[room] = (u + x, v + y)
        at.append(spots)
    parts.append(element("g", *_lines(matches, at[0], at[1]), class_="matches"))
    unit = max(width / LINES_WIDTH, height / 600)
    margin = round(20 * unit)
    view = f"{-margin} {-margin} {width + 2 * margin} {height + 2 * margin}"
    words = f"{len(matches)} matched room pairs, each joined by a line"
    style = f"--unit:{unit:.3f}"
    return element("svg", *parts, class_="plan lines", viewBox=view, style=style, role="img", aria_label=words)


def _storey(map: TopometricMap, sheet: Sheet, plan: StoreyPlan, colours: Array | None) -> list[Markup]:
    shades = room_colours(map) if colours is None else colours
    rooms = [
        element("path", class_="room", d=d, fill=hex_colour(shades[i]), fill_rule="evenodd", data_room=sheet.id(i))
        for i, d in room_outlines(plan, sheet).items()
    ]
    return [*rooms, element("path", class_="wall", d=wall_outline(plan, sheet), fill_rule="evenodd")]


def _lines(matches: Sequence[RoomMatch], a: dict[int, tuple[int, int]], b: dict[int, tuple[int, int]]) -> list[Markup]:
    parts = []
    for match in matches:
        i, j = match.rooms
        if i not in a or j not in b:
            continue
        (x1, y1), (x2, y2) = a[i], b[j]
        title = element("title", f"room {i} of a matches room {j} of b: probability {match.probability:.2f}")
        strength = f"{0.25 + 0.75 * match.probability:.2f}"
        parts.append(element("line", title, x1=x1, y1=y1, x2=x2, y2=y2, class_="match", stroke_opacity=strength))
        parts += [element("circle", class_="end", cx=x, cy=y) for x, y in ((x1, y1), (x2, y2))]
    return parts
