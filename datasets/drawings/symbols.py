"""What stands in rooms on a drawing: furniture, fixtures, tiles, stairs, ways out."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw
from topomerge.datasets.drawings.shapes import DrawingShapes
from topomerge.datasets.drawings.sheet import Hand, Sheet

from topomerge.networks.drawing import STAIRS, SYMBOL
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
