"""Floor plans as people draw them: a storey in many hands, with the true class of every pixel (beyond the thesis: docs/adr/0032).

A hand has a style of walls (filled, grey, hatched, double or single lines), of doors and windows, furniture, colours, names and
areas in several languages, dimension chains, a title; then paper, camera and compression spoil the page.
"""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw
from scipy import ndimage
from topomerge.datasets.drawings.shapes import DrawingShapes, OpeningShape
from topomerge.datasets.drawings.sheet import FINER, Drawing, Hand, Sheet

from topomerge.networks.drawing import DOOR, FLOOR, STAIRS, SYMBOL, TEXT, WALL, WINDOW
from topomerge.types import Array


def draw_tiles(sheet: Sheet, polygon: Array, rng: np.random.Generator) -> None:
    mask = Image.new("L", sheet.shape[::-1], 0)
    draw, inside = ImageDraw.Draw(mask), Image.new("L", sheet.shape[::-1], 0)
    ImageDraw.Draw(inside).polygon(sheet.place(polygon), fill=255)
    corners = np.array(sheet.place(polygon))
    (x0, y0), (x1, y1) = np.clip(corners.min(axis=0), 0, sheet.shape[::-1]), np.clip(corners.max(axis=0), 0, sheet.shape[::-1])
    step = max(rng.uniform(0.12, 0.6) * sheet.scale, 6)
    for x in np.arange(x0, x1, step):
        draw.line([x, y0, x, y1], fill=255, width=1)
    if rng.random() < 0.6:
        for y in np.arange(y0, y1, step):
            draw.line([x0, y, x1, y], fill=255, width=1)
    both = np.minimum(np.asarray(mask), np.asarray(inside)) > 0
    grey = int(rng.integers(120, 225))
    sheet.paint(both, (grey, grey, grey))


def draw_treads(sheet: Sheet, rectangle: Array, hand: Hand, rng: np.random.Generator) -> None:
    a, b, c, d = rectangle
    count = max(int(np.hypot(*(b - a)) / 0.28), 3)
    for share in np.linspace(0, 1, count + 1):
        sheet.draw_line(np.stack([a + (b - a) * share, d + (c - d) * share]), hand.ink, hand.line, STAIRS)
    sheet.draw_line(np.stack([a, b, c, d, a]), hand.ink, hand.line, STAIRS)
    middle = (a + d) / 2, (b + c) / 2
    sheet.draw_line(np.stack(middle), hand.ink, hand.line, STAIRS)


def furnish_rooms(sheet: Sheet, shapes: DrawingShapes, hand: Hand, rng: np.random.Generator) -> None:
    label = np.asarray(sheet.rooms)
    if rng.random() < 0.12:
        _draw_routes(sheet, shapes, rng)
    for number, room in enumerate(shapes.rooms):
        if room.kind == "stairs" and rng.random() < 0.7:
            _fill_with_treads(sheet, label == number + 1, hand, rng)
            continue
        x, y = room.polygon.T
        area = 0.5 * abs(float(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))))
        if hand.furniture == 0 or area < 1.0:
            continue
        pieces = min(int(rng.poisson(hand.furniture * area / 4)), 30)
        if not pieces:
            continue
        corners = np.array(sheet.place(room.polygon))
        low, high = corners.min(axis=0), corners.max(axis=0)
        for _ in range(pieces):
            _draw_piece(sheet, label, number + 1, (low, high), hand, rng)


def _draw_routes(sheet: Sheet, shapes: DrawingShapes, rng: np.random.Generator) -> None:
    """Draw the ways out of an evacuation plan, through doors, and its signs."""
    colour = ((0, 150, 60), (0, 90, 200), (220, 30, 30))[int(rng.integers(3))]
    middles = [room.polygon.mean(axis=0) for room in shapes.rooms]
    doors = [opening.line.mean(axis=0) for opening in shapes.openings if opening.kind != "window"]
    for _ in range(int(rng.integers(1, 8))):
        if doors:
            ends = np.stack([middles[int(rng.integers(len(middles)))], doors[int(rng.integers(len(doors)))]])
            if float(np.hypot(*np.ptp(ends, axis=0))) < 8:
                sheet.draw_line(ends, colour, max(int(0.08 * sheet.scale), 3), SYMBOL)
        (x, y), r = sheet.place(middles[int(rng.integers(len(middles)))])[0], rng.uniform(0.15, 0.4) * sheet.scale
        for image, ink in ((sheet.draw, colour), (sheet.mark, SYMBOL)):
            image.rectangle([x - r, y - r, x + r, y + r], fill=ink)


def _fill_with_treads(sheet: Sheet, mask: Array, hand: Hand, rng: np.random.Generator) -> None:
    i, j = np.arange(mask.shape[0])[:, None], np.arange(mask.shape[1])[None]
    step = max(int(0.28 * sheet.scale), 6)
    lines = mask & ((i if rng.random() < 0.5 else j) % step < max(hand.line, 2))
    sheet.paint(lines, hand.ink, STAIRS)


def _draw_piece(sheet: Sheet, label: Array, room: int, box: tuple[Array, Array], hand: Hand, rng: np.random.Generator) -> None:
    """Draw a piece of furniture or a fixture, if it finds a place in its room."""
    size = np.exp(rng.uniform(np.log(0.35), np.log(2.2), 2)) * sheet.scale
    at = rng.uniform(*box)
    if rng.random() < 0.6:  # most stand at a wall
        axis = int(rng.integers(2))
        at[axis] = (box[0][axis] + size[axis] / 2 + 3) if rng.random() < 0.5 else (box[1][axis] - size[axis] / 2 - 3)
    low, high = at - size / 2, at + size / 2
    corners = np.array([[low[0], low[1]], [low[0], high[1]], [high[0], low[1]], [high[0], high[1]], at]).astype(int)
    if (corners < 0).any() or (corners >= np.array(sheet.shape[::-1])).any():
        return
    if not (label[corners[:, 1], corners[:, 0]] == room).all():
        return
    ink = hand.ink if rng.random() < 0.6 else (150, 150, 150)
    rectangle = [float(low[0]), float(low[1]), float(high[0]), float(high[1])]
    fill = tuple(int(v) for v in rng.integers(150, 255, 3)) if rng.random() < 0.2 else None
    kind, thin = int(rng.integers(9)), hand.line
    inset = 0.12 * float(size.min())
    inner = [rectangle[0] + inset, rectangle[1] + inset, rectangle[2] - inset, rectangle[3] - inset]
    for image, colour in ((sheet.draw, ink), (sheet.mark, SYMBOL)):
        filled = fill if image is sheet.draw else None
        if kind == 0:
            image.ellipse(rectangle, outline=colour, fill=filled, width=thin)
            continue
        if kind == 8:  # a solid thing
            image.rectangle(rectangle, fill=colour)
            continue
        image.rounded_rectangle(rectangle, radius=inset if kind in (1, 2) else 0, outline=colour, fill=filled, width=thin)
        if kind in (1, 3):
            image.ellipse(inner, outline=colour, width=thin)
        elif kind in (2, 4):
            image.rectangle(inner, outline=colour, width=thin)
        elif kind == 5:  # a bed: pillows and a folded sheet
            y = rectangle[1] + 0.25 * float(size[1])
            image.line([rectangle[0], y, rectangle[2], y], fill=colour, width=thin)
            image.ellipse([inner[0], rectangle[1], inner[2], y], outline=colour, width=thin)
        elif kind == 6:  # a cross: a cupboard, a shaft
            image.line([rectangle[0], rectangle[1], rectangle[2], rectangle[3]], fill=colour, width=thin)
            image.line([rectangle[0], rectangle[3], rectangle[2], rectangle[1]], fill=colour, width=thin)
        else:  # a hob or chairs about a table
            r = 0.16 * float(size.min())
            for x in (rectangle[0], rectangle[2]):
                for y in (rectangle[1], rectangle[3]):
                    cx, cy = x + (2 * r if x == rectangle[0] else -2 * r), y + (2 * r if y == rectangle[1] else -2 * r)
                    image.ellipse([cx - r, cy - r, cx + r, cy + r], outline=colour, width=thin)


FEET = 0.3048  # m
WORDS = {
    "bedroom": (
        "BEDROOM",
        "Bedroom 2",
        "Master Bedroom",
        "Schlafen",
        "Zimmer",
        "Chambre",
        "Sovrum",
        "Dormitorio",
        "BR",
        "Camera",
        "洋室",
    ),
    "living": ("LIVING", "Living Room", "Wohnen", "Salon", "Vardagsrum", "Sala", "Lounge", "Family Room", "Soggiorno", "LDK"),
    "kitchen": ("KITCHEN", "Kitchen", "Küche", "Cuisine", "Kök", "Cocina", "Kitchen/Diner", "K", "Cucina"),
    "bath": ("BATH", "Bathroom", "Bad", "Salle de bain", "Badrum", "Baño", "En-suite", "Bagno"),
    "toilets": ("WC", "W.C.", "Toilet", "Cloaks", "Toilettes", "Aseo", "Restroom"),
    "corridor": ("HALL", "Hall", "Corridor", "Flur", "Couloir", "Landing", "Pasillo", "Hallway"),
    "entrance": ("ENTRY", "Entrance", "Eingang", "Entrée", "Hall", "Foyer"),
    "storage": ("STORE", "Storage", "Abstell", "Closet", "Cupboard", "CL", "Rangement"),
    "office": ("OFFICE", "Office 2.113", "Büro", "Bureau", "Study", "Kontor", "Despacho"),
    "meeting": ("MEETING", "Conference", "Besprechung", "Réunion"),
    "stairs": ("UP", "DN", "Treppe", "Stairs"),
    "classroom": ("CLASS 12", "Classroom", "Klasse 4b", "Salle 102", "Aula 3"),
}
OTHER_WORDS = ("ROOM", "1.04", "Raum 12", "A-113", "Lager", "Lab", "Dining", "Esszimmer", "Utility", "Garage", "Server", "207")
TITLES = (
    "GROUND FLOOR", "First Floor Plan", "Erdgeschoss 1:100", "Plan d'évacuation", "Sketch plan for illustrative purposes only",
    "Approx. gross internal area 84 sq m / 904 sq ft", "Scale 1:50", "NOT TO SCALE", "Planritning", "You are here", "N",
)  # fmt: skip
WARM = ((253, 246, 227), (235, 245, 235), (230, 240, 250), (250, 235, 235), (240, 240, 240), (222, 205, 175), (255, 250, 205))


def draw_plan(
    shapes: DrawingShapes, hand: Hand, rng: np.random.Generator, side: tuple[int, int], scale: float, corner: Array
) -> Drawing:
    """Draw a window of a plan.

    Args:
        side: (h, w) px.
        scale: px/m.
        corner: (2,) m, of the lower left.
    """
    paper = (255, 255, 255) if rng.random() < 0.7 else tuple(int(v) for v in 255 - rng.integers(0, 28, 3))
    sheet = Sheet(side, scale * FINER, np.asarray(corner, np.float64), (paper[0], paper[1], paper[2]))
    _decorate_outside(sheet, shapes, hand, rng)
    _draw_rooms(sheet, shapes, hand, rng)
    walls = _draw_walls(sheet, shapes, hand)
    for opening in shapes.openings:
        _draw_opening(sheet, opening, hand, walls, rng)
    for rectangle in shapes.stairs:
        draw_treads(sheet, rectangle, hand, rng)
    furnish_rooms(sheet, shapes, hand, rng)
    _write_rooms(sheet, shapes, hand, walls, rng)
    if hand.dimensions:
        _draw_dimensions(sheet, shapes, hand, rng)
    picture = np.asarray(sheet.picture.reduce(FINER))
    classes = np.asarray(sheet.classes)[::FINER, ::FINER]
    rooms = np.asarray(sheet.rooms)[::FINER, ::FINER].astype(np.int16) - 1
    return Drawing(picture, classes, rooms, tuple(sheet.texts), scale)


def _decorate_outside(sheet: Sheet, shapes: DrawingShapes, hand: Hand, rng: np.random.Generator) -> None:
    """Draw gardens, trees and titles on the page."""
    height, width = sheet.shape
    grey = tuple(int(v) for v in rng.integers(100, 220, 3))
    colour = (grey[0], grey[1], grey[2])
    for _ in range(int(rng.poisson(1.2))):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        kind = int(rng.integers(5))
        if kind == 0:  # a tree
            r = rng.uniform(0.4, 2.0) * sheet.scale
            for k in range(int(rng.integers(1, 4))):
                ring = [x - r / (k + 1), y - r / (k + 1), x + r / (k + 1), y + r / (k + 1)]
                sheet.draw.ellipse(ring, outline=colour, width=hand.line)
                sheet.mark.ellipse(ring, outline=SYMBOL, width=hand.line)
        elif kind == 1:  # the border of the sheet or of the land
            inset = int(rng.uniform(2, 30))
            for image, ink in ((sheet.draw, colour), (sheet.mark, SYMBOL)):
                image.rectangle([inset, inset, width - inset, height - inset], outline=ink, width=hand.line)
        elif kind == 2:  # a terrace, paving
            step = int(rng.uniform(0.3, 1.0) * sheet.scale)
            w, h = (rng.uniform(1, 6, 2) * sheet.scale).astype(int)
            for k in range(0, int(w), max(step, 6)):
                sheet.draw.line([x + k, y, x + k, y + h], fill=colour, width=1)
            for k in range(0, int(h), max(step, 6)):
                sheet.draw.line([x, y + k, x + w, y + k], fill=colour, width=1)
        elif kind == 3:
            w, h = rng.uniform(2, 8, 2) * sheet.scale
            sheet.draw.rectangle([x, y, x + w, y + h], fill=tuple(int(v) for v in rng.integers(190, 255, 3)))
        else:
            sheet.write(str(rng.choice(TITLES)), (x, y), rng.uniform(0.2, 0.8) * sheet.scale, hand.font, (30, 30, 30))


def _draw_rooms(sheet: Sheet, shapes: DrawingShapes, hand: Hand, rng: np.random.Generator) -> None:
    white = (255, 255, 255) if rng.random() < 0.8 else None
    for number, room in enumerate(shapes.rooms):
        tint = WARM[int(rng.integers(len(WARM)))] if hand.colours else white
        sheet.fill(room.polygon, tint, FLOOR)
        sheet.label.polygon(sheet.place(room.polygon), fill=number + 1)
        if rng.random() < (hand.tiles * (2 if room.kind in ("bath", "toilets", "kitchen") else 0.6)):
            draw_tiles(sheet, room.polygon, rng)


def _draw_walls(sheet: Sheet, shapes: DrawingShapes, hand: Hand) -> Array:
    """Draw the walls; their mask."""
    label = np.asarray(sheet.rooms)
    rooms = label > 0
    outer = ndimage.distance_transform_edt(~rooms) <= hand.outer * sheet.scale if rooms.any() else np.zeros_like(rooms)
    lines = Image.new("L", sheet.shape[::-1], 0)
    pen = ImageDraw.Draw(lines)
    inner = max(round(hand.inner * sheet.scale), 2)
    for room in shapes.rooms:
        corners = sheet.place(room.polygon)
        pen.line([*corners, corners[0]], fill=255, width=inner, joint="curve")
    for wall, thick in zip(shapes.walls, shapes.thickness, strict=True):
        pen.line(sheet.place(wall), fill=255, width=max(round(float(thick) * sheet.scale), 2))
    drawn = np.asarray(lines) > 0
    walls = (outer & ~rooms) | drawn
    thin = max(hand.line, 2)
    if hand.walls == "single":
        walls = drawn
        sheet.paint(walls, hand.ink, WALL)
        return walls
    sheet.paint(walls, (255, 255, 255), WALL)
    edge = walls & ~ndimage.binary_erosion(walls, np.ones((3, 3)), thin)
    if hand.walls == "filled":
        sheet.paint(walls, hand.ink)
    elif hand.walls == "grey":
        sheet.paint(walls, (150, 150, 150))
        sheet.paint(edge, hand.ink)
    else:
        if hand.walls == "hatched":
            i, j = np.indices(walls.shape, sparse=True)
            sheet.paint(walls & ((i + j) % 14 < 3), hand.ink)
        sheet.paint(edge, hand.ink)
    return walls


def _draw_opening(sheet: Sheet, opening: OpeningShape, hand: Hand, walls: Array, rng: np.random.Generator) -> None:
    start, end = opening.line
    width = float(np.hypot(*(end - start)))
    if width < 0.3:
        return
    along = (end - start) / width
    normal = np.array([-along[1], along[0]])
    reach = _measure_wall(sheet, (start + end) / 2, normal, walls, opening.thickness)
    quad = np.stack([start + normal * reach[1], end + normal * reach[1], end - normal * reach[0], start - normal * reach[0]])
    ink, thin = hand.ink, hand.line
    if opening.kind in ("window", "gallery"):
        sheet.fill(quad, (255, 255, 255), WINDOW)
        _draw_window(sheet, quad, hand)
        return
    sheet.fill(quad, (255, 255, 255), DOOR)
    if opening.kind != "door" or hand.doors == "gap":
        return
    if hand.doors in ("threshold", "box"):
        sheet.draw_line(quad[[0, 1]], ink, thin)
        sheet.draw_line(quad[[3, 2]], ink, thin)
        if hand.doors == "box":
            sheet.draw_line(quad[[0, 3]], ink, thin)
            sheet.draw_line(quad[[1, 2]], ink, thin)
        return
    side = 1.0 if rng.random() < 0.5 else -1.0
    out = normal * side
    face = (reach[1] if side > 0 else reach[0]) * out
    leaves = [(start, along, width)] if width < 1.25 else [(start, along, width / 2), (end, -along, width / 2)]
    if len(leaves) == 1 and rng.random() < 0.5:
        leaves = [(end, -along, width)]
    swing = rng.uniform(0.35, 0.5) * np.pi if rng.random() < 0.2 else np.pi / 2
    for hinge, way, length in leaves:
        angle = np.linspace(0, swing, 14)[:, None]
        arc = hinge + face + length * (np.cos(angle) * way + np.sin(angle) * out)
        sheet.draw_line(np.stack([hinge + face, arc[-1]]), ink, max(thin, 2), SYMBOL)
        if hand.doors == "arc":
            sheet.draw_line(arc, ink, max(thin - 1, 1), SYMBOL)
    sheet.fill(quad, None, DOOR)


def _measure_wall(sheet: Sheet, middle: Array, normal: Array, walls: Array, thickness: float) -> tuple[float, float]:
    """Return how far the wall reaches to both sides of the middle of an opening, m: against the normal and along it."""
    out = []
    most = max(thickness, 0.15) / 2 + 0.45
    for way in (-normal, normal):
        steps = np.arange(0, most, 0.02)
        at = np.array(sheet.place(middle + steps[:, None] * way)).astype(int)
        inside = ((at >= 0) & (at < np.array(sheet.shape[::-1]))).all(axis=1)
        on = np.zeros(len(steps), bool)
        on[inside] = walls[at[inside, 1], at[inside, 0]]
        out.append(float(steps[on].max(initial=0.0)) + 0.03)
    return out[0], out[1]


def _draw_window(sheet: Sheet, quad: Array, hand: Hand) -> None:
    a, b, c, d = quad
    if hand.windows == "blue":
        sheet.fill(quad, (170, 205, 235))
    sheet.draw_line(quad[[0, 1, 2, 3, 0]], hand.ink, hand.line)
    shares = {"lines": (0.35, 0.65), "one": (0.5,), "box": (), "blue": (0.5,), "plain": (0.33, 0.5, 0.67)}[hand.windows]
    for share in shares:
        sheet.draw_line(np.stack([a + (d - a) * share, b + (c - b) * share]), hand.ink, max(hand.line - 1, 1))


def format_area(area: float, width: float, depth: float, style: str) -> list[str]:
    """Format what a hand writes of the size of a room: lines of text."""
    metric, size = f"{area:.1f} m²", f"{width:.2f} x {depth:.2f} m"
    feet = " x ".join(f"{int(v / FEET)}'{int(v / FEET % 1 * 12)}\"" for v in (width, depth))
    return {"": [], "m2": [metric], "size": [size], "feet": [feet], "both": [size, feet]}[style]


def _write_rooms(sheet: Sheet, shapes: DrawingShapes, hand: Hand, walls: Array, rng: np.random.Generator) -> None:
    label = np.asarray(sheet.rooms)
    colour = hand.ink if rng.random() < 0.8 else (90, 90, 160)
    height = hand.letter * sheet.scale
    for number, room in enumerate(shapes.rooms):
        lines = []
        if rng.random() < hand.names:
            lines.append(str(rng.choice(WORDS.get(room.kind, OTHER_WORDS))))
        clear = np.nonzero((label == number + 1) & ~walls)  # people measure from wall to wall
        area = len(clear[0]) / sheet.scale**2
        if area > 3:
            depth, width = ((np.ptp(side) + 1) / sheet.scale for side in clear)
            lines += format_area(area, float(width), float(depth), hand.areas)
        if not lines:
            continue
        rows, columns = np.nonzero(label[::4, ::4] == number + 1)
        if not len(rows):
            continue
        at = np.array([columns.mean(), rows.mean()]) * 4 + rng.normal(0, 0.15, 2) * sheet.scale
        if rng.random() < 0.1:  # some texts stand over walls
            at += rng.normal(0, 1.0, 2) * sheet.scale
        for k, line in enumerate(lines):
            place = float(at[0]), float(at[1] + (k - (len(lines) - 1) / 2) * 1.3 * height)
            sheet.write(line, place, height, hand.font, colour, number)


def _draw_dimensions(sheet: Sheet, shapes: DrawingShapes, hand: Hand, rng: np.random.Generator) -> None:
    """Draw chains of dimensions outside the plan, and a few inside."""
    points = np.concatenate([r.polygon for r in shapes.rooms])
    low, high = points.min(axis=0), points.max(axis=0)
    tick = 0.15
    for axis in (0, 1):
        off = rng.uniform(0.8, 2.0) * (1 if rng.random() < 0.5 else -1)
        level = (low if off < 0 else high)[1 - axis] + off
        stops = np.unique(
            np.round(np.concatenate([[low[axis], high[axis]], rng.uniform(low[axis], high[axis], int(rng.integers(0, 6)))]), 2)
        )
        chain = np.zeros((len(stops), 2))
        chain[:, axis], chain[:, 1 - axis] = stops, level
        sheet.draw_line(chain[[0, -1]], hand.ink, hand.line, TEXT)
        for k, stop in enumerate(chain):
            sheet.draw_line(np.stack([stop - tick, stop + tick]), hand.ink, hand.line, TEXT)
            if k + 1 < len(chain):
                column, row = sheet.place((stop + chain[k + 1]) / 2)[0]
                at = column, row - 0.25 * sheet.scale
                sheet.write(f"{stops[k + 1] - stops[k]:.2f}", at, 0.22 * sheet.scale, hand.font, hand.ink)
