"""Drawn floor plans: walls and floor of a picture with a page around it, symbols and text; its scale from what is written on it
(beyond the thesis: docs/adr/0032)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.io.drawn_page import DrawnPage, find_lines, move_places
from topomerge.io.pictures import load_text_reader
from topomerge.io.sightings import clean_text
from topomerge.io.written_lengths import (
    NUMBERED,
    Chains,
    PictureText,
    find_chains,
    find_name,
    find_stated_scale,
    parse_lengths,
    parse_lost_area,
)
from topomerge.kernels import run_side_by_side
from topomerge.networks.drawing import DOOR, FLOOR, PAGE, WALL, WINDOW, compute_drawing_probabilities
from topomerge.networks.network import Run
from topomerge.types import Array, Landmarks, build_landmarks, join_landmarks

FINEST, COARSEST = 0.04, 0.12  # m a pixel: what the network was trained on lies between 0.02 and 0.125
LONGEST_SIDE = 640  # px at which a picture of unknown scale is looked at
SMALLEST_ROOM, SMALLEST_WALL, SMALLEST_DOOR = 0.7, 0.35, 0.04  # m2: less is a letter or a mark
SMALLEST_STAIRS = 0.8  # m2
USUAL_SCALE = 25.0  # px/m, where none is known
WALL_NEAR = 0.5  # m from a room: what lies farther off is no wall of the building
GAP = 3  # px of walls that the network missed
SQUARE, LEAST_STRAIGHT = 7, 0.3  # degrees; of the outline of walls, at least: of a ring .17, of plans .38 to .9
INK_IN_WALLS, STRAIGHT_PLAN = 0.35, 0.6  # of a page that may be a grid: of 30 grids the straightest has .55, most .3 to .5
TREAD, FEWEST_TREADS = (0.2, 0.37), 6  # m between two
TREAD_WIDTH, TREAD_STRONG = (0.4, 4.5), 15.0  # m; levels a pixel: tiles are paler
WALLED = 0.4  # of a room's outline is wall or door, at least
FEWEST_PIXELS = 30  # of a room that gives a scale
AGREEING = 0.12  # of the logarithm of the scale: texts that differ more from the median are not of their room
BLANK = 16  # levels of 255 between the darkest and the lightest pixel: less is paper
NAME_SIGMA = 1.0  # m, of where a name stands in its room
NAME_HEIGHT = 1.2  # m above the floor at which the name of a room is placed
VARIED_ALONE, ODD_DOORS = 1.5, 3.0  # dimensions, the longest for the shortest, where no door is seen; spreads of their widths
ALIKE = 0.3  # likewise, of how long rooms are for their width
FEWEST_LOST = 3  # areas without their squares that are believed
DOOR_WIDTH, DOOR_SPREAD = 0.82, 0.12  # m, usual clear width of drawn doors, and its spread as a logarithm


@dataclass(frozen=True, eq=False)
class ParsedDrawing:
    """The content of a drawing, in pixels of `zoom` times the picture's number a side.

    Args:
        occupied: (h, w) bool, walls and windows; free: floor and open doors; door, window: (h, w) bool.
        doorway: (h, w) float32, probability of a door on the floor.
        zoom: pixels of these for each of the picture.
        stairs: (h, w) bool, treads; None: there are none.
    """

    occupied: Array
    free: Array
    door: Array
    window: Array
    doorway: Array
    zoom: float
    stairs: Array | None = None


@dataclass(frozen=True)
class DrawingScale:
    """How large a pixel of a picture is.

    Args:
        resolution: m; spread: its standard deviation as a logarithm.
        reasons: the texts or doors that say so; written: are they texts?
        dimensions: those of the texts that stand in rows, and name no room.
    """

    resolution: float
    spread: float
    reasons: tuple[str, ...]
    written: bool = True
    dimensions: tuple[PictureText, ...] = ()


SMALL_PICTURE = 1000  # px of its longer side, below which letters are enlarged


def parse_drawing(picture: Array, resolution: float | None = None, network: Run | None = None) -> ParsedDrawing:
    """Find walls and floor of a drawing.

    Args:
        picture: (h, w, 3) uint8.
        resolution: m a pixel; None: not known.
        network: the one that ships, if None.
    """
    zoom = choose_zoom(picture.shape[:2], resolution)
    seen = resize_picture(picture, zoom)
    probability = np.asarray(compute_drawing_probabilities(seen, network), np.float32)
    scale = None if resolution is None else zoom / resolution
    return find_structure(probability, zoom, scale)


def choose_zoom(shape: tuple[int, ...], resolution: float | None) -> float:
    """Choose how many pixels the network sees for each of the picture."""
    if resolution is None:
        return min(1.0, LONGEST_SIDE / max(shape))
    return float(np.clip(1.0, resolution / COARSEST, resolution / FINEST))


def resize_picture(picture: Array, zoom: float) -> Array:
    """Resize (h, w, 3) uint8, so that thin lines stay."""
    from PIL import Image

    if zoom == 1.0:
        return picture
    size = max(round(picture.shape[1] * zoom), 1), max(round(picture.shape[0] * zoom), 1)
    how = Image.Resampling.BOX if zoom < 1 else Image.Resampling.BICUBIC
    return np.asarray(Image.fromarray(picture).resize(size, how))


def find_structure(probability: Array, zoom: float, scale: float | None) -> ParsedDrawing:
    """Find walls and floor by probabilities (h, w, 8).

    The page is what can be reached from the border without a wall, a window, a door or floor in between, and what is page by
    itself, such as a courtyard.

    Args:
        scale: px/m of the probabilities, or None.
    """
    known = USUAL_SCALE if scale is None else scale
    kind = probability.argmax(axis=-1)
    window = kind == WINDOW
    occupied = drop_small(np.isin(kind, (WALL, WINDOW)), SMALLEST_WALL * known**2)
    door = drop_small(kind == DOOR, SMALLEST_DOOR * known**2)
    bridged = ndimage.binary_closing(np.pad(occupied | door, GAP), np.ones((2, 2)), GAP)[GAP:-GAP, GAP:-GAP]
    around, _ = ndimage.label(np.pad(~(bridged | (kind == FLOOR)), 1, constant_values=True))
    outside = around[1:-1, 1:-1] == around[0, 0]
    label, count = ndimage.label(~(occupied | outside | door))
    numbers = np.arange(1, count + 1)
    page = ndimage.mean(probability[..., PAGE], label, numbers) if count else np.zeros(0)
    floor = ndimage.mean(probability[..., FLOOR], label, numbers) if count else np.zeros(0)
    size = ndimage.sum(label > 0, label, numbers) if count else np.zeros(0)
    walled = measure_walled_share(label, count, occupied | door)
    rooms = np.append(False, (page < floor) & (size >= SMALLEST_ROOM * known**2) & (walled >= WALLED))[label]
    doors, _ = ndimage.label(door)
    door &= np.isin(doors, np.unique(doors[ndimage.binary_dilation(rooms, np.ones((3, 3)), 2)]))
    near = ndimage.distance_transform_edt(~(rooms | door)) <= WALL_NEAR * known
    free = rooms | door
    return ParsedDrawing(occupied & near, free, door, window & near, np.where(free, probability[..., DOOR], 0), zoom)


def is_plan(page: DrawnPage) -> bool:
    """Return whether the ink of a page is straight walls, as in a plan; turned round, the floor of a robot's grid is not."""
    drawing = parse_drawing(page.picture)
    ink = resize_picture(page.picture, drawing.zoom)[..., 0] < 128
    walls = (drawing.occupied | drawing.door)[ink]
    return bool(walls.size and walls.mean() >= INK_IN_WALLS and measure_straight_share(drawing.occupied) >= STRAIGHT_PLAN)


def find_treads(picture: Array, resolution: float) -> Array:
    """Find flights of stairs on a drawing: (h, w) bool, where six lines or more lie as far from each other as treads.

    Args:
        picture: (h, w, 3) uint8.
        resolution: m a pixel.
    """
    bright = picture.mean(axis=2, dtype=np.float32)
    out = np.zeros(bright.shape, bool)
    found = run_side_by_side(lambda flip: find_lines(bright, flip, TREAD_WIDTH[0] / resolution, TREAD_STRONG), (False, True))
    for mask, ends in zip((out, out.T), found, strict=True):
        lines = np.array(ends).reshape(4, -1)
        x, y, slope, length = lines[:, np.lexsort((lines[0], lines[1]))]
        x, y, length = x * resolution, y * resolution, length * resolution
        open_lines = (np.abs(slope) <= 0.03) & (length <= TREAD_WIDTH[1])
        for start in range(len(x)):
            if not open_lines[start]:
                continue
            alike = open_lines & (np.abs(x - x[start]) <= 0.12) & (np.abs(length - length[start]) <= 0.15 * length[start])
            flight = [start]
            for number in np.flatnonzero(alike & (y > y[start])):
                gap = y[number] - y[flight[-1]]
                if gap > TREAD[1]:
                    break
                if gap >= TREAD[0]:  # else the other edge of the same line
                    flight.append(int(number))
            gaps = np.diff(y[flight])
            if len(flight) >= FEWEST_TREADS and gaps.std() <= 0.12 * gaps.mean():
                open_lines[flight] = False
                left, right = x[start] - length[start] / 2, x[start] + length[start] / 2
                rows, columns = (
                    slice(int(a / resolution), int(b / resolution) + 1) for a, b in ((y[start], y[flight[-1]]), (left, right))
                )
                mask[rows, columns] = True
    closed = ndimage.binary_closing(np.pad(out, GAP), np.ones((3, 3)), GAP)[GAP:-GAP, GAP:-GAP]  # over the line of walking
    return drop_small(closed, SMALLEST_STAIRS / resolution**2)


def measure_walled_share(label: Array, count: int, wall: Array) -> Array:
    """Measure the share of the outline of each part of a label image (h, w) that is wall or door: (count,)."""
    out = np.zeros(count)
    for number, box in enumerate(ndimage.find_objects(label, count), 1):
        wide = tuple(slice(max(side.start - 2, 0), side.stop + 2) for side in box)
        part = label[wide] == number
        outline = ndimage.binary_dilation(part, np.ones((3, 3)), 2) & ~part
        out[number - 1] = wall[wide][outline].mean() if outline.any() else 0.0
    return out


def measure_straight_share(wall: Array) -> float:
    """Measure the share of the outline of a mask (h, w) that runs along its two commonest directions, square to each other."""
    smooth = ndimage.gaussian_filter(wall.astype(np.float32), 1.5)
    across, along = ndimage.sobel(smooth, axis=0), ndimage.sobel(smooth, axis=1)
    weight = np.hypot(across, along)
    angle = (np.degrees(np.arctan2(across, along)) % 90.0).astype(int) % 90
    counts = np.bincount(angle.ravel(), weight.ravel(), 90)
    if not counts.any():
        return 0.0
    window = np.convolve(np.concatenate([counts, counts[: 2 * SQUARE]]), np.ones(2 * SQUARE + 1), "valid")
    return float(window.max() / counts.sum())


def drop_small(mask: Array, least: float) -> Array:
    """Return a mask (h, w) without its parts of fewer than so many pixels."""
    label, _ = ndimage.label(mask, np.ones((3, 3)))
    size = np.bincount(label.ravel())
    size[0] = 0
    return np.asarray(size[label] >= max(least, 1))


def estimate_scale(drawing: ParsedDrawing, texts: Sequence[PictureText]) -> DrawingScale | None:
    """Estimate the size of a pixel by the areas and sides that are written in rooms; else by the width of doors.

    Each text that lies in a room says how long a pixel is: by the room's area, or by its box; so do dimensions that stand in a
    row. Lengths in rooms count as areas where they fit as such alone. The largest group of texts that agree decides, of alike
    ones that which doors are nearer to. Where dimensions are of this group, they alone say how large it is: walls take nothing
    off them.

    Returns:
        None where neither texts nor doors say anything.
    """
    rooms, _ = ndimage.label(drawing.free & ~drawing.door)
    boxes = ndimage.find_objects(rooms)
    found: list[tuple[float, str]] = []
    lost: list[tuple[float, str, float]] = []  # areas that may be lengths
    for text in texts:
        area, sides = parse_lengths(text.text)
        maybe = parse_lost_area(text.text)
        number = _find_room(rooms, text, drawing.zoom)
        if number == 0 or (area is None and sides is None and maybe is None):
            continue
        inside = rooms[boxes[number - 1]] == number
        pixels = float(ndimage.binary_fill_holes(inside).sum())
        if pixels < FEWEST_PIXELS:
            continue
        if area is not None:
            found.append((np.sqrt(area / pixels), text.text))
        elif maybe is not None:
            lost.append((np.sqrt(maybe / pixels), text.text, maybe))
        if sides is not None:
            box = sorted(float(v) for v in inside.shape)
            small, large = sorted(sides)
            if abs(np.log(small / box[0] * box[1] / large)) <= ALIKE:  # else the text is not of this box
                found.append((np.sqrt(small * large / (box[0] * box[1])), text.text))
    by_doors = _estimate_scale_by_doors(drawing)
    chains = _select_chains(find_chains(texts), by_doors)
    if by_doors is not None and not chains.texts:
        found += select_lost_areas(lost, by_doors, drawing.zoom)
    areas = len(found)
    found += [(value / drawing.zoom, "") for value in chains.resolutions]
    if not found:
        return by_doors
    logs = np.log([value for value, _ in found])
    agree = np.abs(logs[:, None] - logs) <= AGREEING
    votes = agree.sum(axis=1).astype(float)
    if by_doors is not None:  # where as many speak for one as for another
        votes -= 0.5 * np.minimum(np.abs(logs - np.log(by_doors.resolution / drawing.zoom)), 1.0)
    kept = agree[int(votes.argmax())]
    if kept[areas:].any():
        spread = 0.03 / np.sqrt(kept[areas:].sum())
        reasons = tuple(dict.fromkeys(t.text for t in chains.texts))
        return DrawingScale(float(np.median(chains.resolutions)), float(spread), reasons, dimensions=chains.texts)
    spread = 0.05 / np.sqrt(kept.sum()) if kept.sum() > 1 else 0.1
    reasons = tuple(dict.fromkeys(text for (_, text), good in zip(found, kept, strict=True) if good))
    return DrawingScale(float(np.exp(np.median(logs[kept]))) * drawing.zoom, float(spread), reasons)


def select_lost_areas(lost: Sequence[tuple[float, str, float]], by_doors: DrawingScale, zoom: float) -> list[tuple[float, str]]:
    """Select what was read as lengths in rooms and is areas: enough of different sizes agree, and doors would be of usual widths.

    Args:
        lost: m a pixel of the drawing if it is an area, the text, and that area.
    """
    if len(lost) < FEWEST_LOST:
        return []
    logs = np.log([value for value, _, _ in lost])
    agree = np.abs(logs[:, None] - logs) <= AGREEING
    kept = [row for row, good in zip(lost, agree[int(agree.sum(axis=1).argmax())], strict=True) if good]
    sizes = [area for _, _, area in kept]
    off = abs(float(np.median(np.log([value for value, _, _ in kept]))) - np.log(by_doors.resolution / zoom))
    right = len(kept) >= max(FEWEST_LOST, len(lost) / 2) and max(sizes) >= VARIED_ALONE * min(sizes)
    return [(value, text) for value, text, _ in kept] if right and off <= ODD_DOORS * by_doors.spread else []


def _select_chains(found: Sequence[Chains], by_doors: DrawingScale | None) -> Chains:
    """Select the dimensions in rows with the most links, or none where they may be something else: doors would be of odd widths,
    or all are alike."""
    if by_doors is None:
        possible = [c for c in found if c.varied >= VARIED_ALONE]
    else:
        near = {c: abs(np.log(np.median(c.resolutions) / by_doors.resolution)) for c in found}
        possible = sorted((c for c in found if near[c] <= ODD_DOORS * by_doors.spread), key=lambda c: float(near[c]))
    return max(possible, key=lambda c: len(c.resolutions), default=Chains())


def _find_room(rooms: Array, text: PictureText, zoom: float) -> int:
    """Return the room that a text lies in: its own pixels may be holes."""
    column, row = (int(v * zoom) for v in text.place)
    reach = max(int(text.height * zoom), 2)
    part = rooms[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
    counts = np.bincount(part.ravel())
    return int(counts[1:].argmax()) + 1 if len(counts) > 1 else 0


def _estimate_scale_by_doors(drawing: ParsedDrawing) -> DrawingScale | None:
    label, count = ndimage.label(drawing.door)
    widths = []
    for number, box in enumerate(ndimage.find_objects(label), 1):
        points = np.argwhere(label[box] == number).astype(float)
        if len(points) < 6:
            continue
        values = np.linalg.eigvalsh(np.cov(points.T) + np.eye(2) / 12)
        widths.append(float(np.sqrt(12 * values[1])))
    if not widths:
        return None
    width = float(np.median(widths))
    spread = float(np.hypot(DOOR_SPREAD, 0.3 / np.sqrt(len(widths))))
    return DrawingScale(DOOR_WIDTH / width * drawing.zoom, spread, (f"{count} doors of usual width",), written=False)


@dataclass(frozen=True, eq=False)
class TracedDrawing:
    """A drawing with its scale: `resolution` (m) is that of its own pixels; `texts` are in them, too; `warnings` say why."""

    drawing: ParsedDrawing
    resolution: float
    texts: tuple[PictureText, ...]
    warnings: tuple[str, ...]


def trace_drawing(
    path: Path,
    page: DrawnPage,
    resolution: float | None,
    texts: Sequence[PictureText] | None = None,
    paper: float | None = None,
    text: bool | None = None,
    more_texts: bool = False,
) -> TracedDrawing:
    """Find walls and floor of a drawing, and how large it is.

    Args:
        path: for messages.
        page: of the drawing.
        resolution: m a pixel; None: by what is written on it, or by its doors.
        texts: of the picture that holds the page, if they are known; None: they are read where a reader is installed, unless
            `text` is False.
        paper: m of paper a pixel, where the file says so: "1:100" is a scale then, unless doors would be of odd widths.
        more_texts: the picture shows others than `texts`, as a scan with a stamp does; they are read, too.

    Raises:
        InputError: it shows no room, or nothing says how large it is.
    """
    picture = page.picture
    if texts is None:
        texts = read_texts(picture) if text is not False else ()
    else:
        if page.mended:
            places = move_places(np.linalg.inv(page.matrix), np.array([t.place for t in texts]).reshape(-1, 2))
            texts = [replace(t, place=(float(x), float(y))) for t, (x, y) in zip(texts, places, strict=True)]
        if more_texts and text is not False:
            texts = [*texts, *(read_texts(picture) or ())]
    stated = None if paper is None else find_stated_scale(texts or ())
    known = resolution if resolution is not None or stated is None or paper is None else paper * stated
    drawing = parse_drawing(picture, known)
    if not drawing.free.any() and known is not None and resolution is None:  # printed on paper of another size
        known, drawing = None, parse_drawing(picture)
    if not drawing.free.any() or measure_straight_share(drawing.occupied) < LEAST_STRAIGHT:
        raise InputError(f"{path}: {explain_missing_walls(path, picture)}")
    warnings = [f"{path.name}: was read as a drawn plan, without its page, texts and furniture"]
    if page.mended:
        warnings.append(f"{path.name}: its page was {', '.join(page.mended)} first; places are those on that page")
    dimensions: tuple[PictureText, ...] = ()
    if resolution is None:
        stated_scale = None if known is None else (known, f"1:{stated:g}")
        scale, doubts = settle_scale(path, drawing, texts, stated_scale)
        warnings += doubts
        known, dimensions = scale.resolution, scale.dimensions
        why = ", ".join(repr(reason) if scale.written else reason for reason in scale.reasons[:3])
        warnings.append(f"{path.name}: {known:.4g} m a pixel, give or take {scale.spread:.0%}, by {why}; --resolution sets it")
        if not np.isclose(choose_zoom(picture.shape[:2], known), drawing.zoom, rtol=0.1):
            drawing = parse_drawing(picture, known)
    assert known is not None
    zoom = drawing.zoom
    treads = resize_picture(np.repeat(find_treads(picture, known)[..., None] * np.uint8(255), 3, axis=2), zoom)[..., 0] > 127
    drawing = replace(drawing, stairs=treads & ndimage.binary_fill_holes(drawing.free | drawing.occupied))
    rest = [t for t in texts or () if t not in dimensions]
    placed = [PictureText(t.text, (t.place[0] * zoom, t.place[1] * zoom), t.height * zoom, t.confidence) for t in rest]
    return TracedDrawing(drawing, known / zoom, tuple(placed), tuple(warnings))


def settle_scale(
    path: Path, drawing: ParsedDrawing, texts: Sequence[PictureText] | None, stated: tuple[float, str] | None
) -> tuple[DrawingScale, list[str]]:
    """Return the size of a pixel, and doubts: as stated, unless what is written in rooms or the widths of doors contradict.

    Args:
        stated: m a pixel by the scale that the page states, and how that reads.

    Raises:
        InputError: nothing says how large it is.
    """
    scale = estimate_scale(drawing, texts or ())
    if stated is not None:
        far = 0.0 if scale is None else abs(np.log(scale.resolution / stated[0]))
        if scale is None or far <= (AGREEING if scale.written else ODD_DOORS * scale.spread):
            return DrawingScale(stated[0], 0.0, (stated[1],)), []
        if not scale.written:
            return scale, [f"{path.name}: {stated[1]} is written on it, of which its doors would be of odd widths; not taken"]
    if scale is None:
        more = "" if texts is not None else " (pip install topomerge[text] reads what is written on it)"
        raise InputError(f"{path}: an image does not say how large a pixel is; give --resolution in metres a pixel{more}")
    return scale, []


def explain_missing_walls(path: Path, picture: Array) -> str:
    """Explain why a picture (h, w, 3) has no rooms, and what to do."""
    advice = "" if path.suffix.lower() in (".pdf", ".svg") else "; if it is a robot's grid, give --no-drawing"
    blank = np.ptp(picture.mean(axis=2, dtype=np.float32)) < BLANK
    return "nothing is drawn on it" if blank else f"no walls around a room were found in it{advice}"


def build_name_landmarks(
    texts: Sequence[PictureText], free: Array, resolution: float, corner: tuple[float, float], height: float, source: str
) -> Landmarks:
    """Build landmarks of the names of rooms among texts; numbers of rooms are texts, as signs at doors show them.

    Args:
        texts: in pixels of the floor.
        free: (h, w) bool, floor; only what lies on it, or in a hole of it that a text made, is the name of a room.
        resolution: of a pixel; corner: x and y of the lower left one; height: of the names, all in the unit of the file.
        source: the name of the file.
    """
    rooms = free.astype(np.uint8)
    near = [t for t in texts if 0 <= t.place[0] < free.shape[1] and 0 <= t.place[1] < free.shape[0]]
    kept = [(name, t) for t in near if (name := find_name(t.text)) and _find_room(rooms, t, 1.0)]
    parts = []
    for kind in ("name", "text"):
        some = [(name, t) for name, t in kept if bool(NUMBERED.fullmatch(name)) == (kind == "text")]
        columns, rows = np.array([t.place for _, t in some]).reshape(-1, 2).T
        x, y = corner[0] + columns * resolution, corner[1] + (len(free) - rows) * resolution
        places = np.stack([x, y, np.full(len(x), height)], axis=1)
        confidence = np.array([t.confidence for _, t in some])
        parts.append(build_landmarks(kind, [name for name, _ in some], source, places, sigma=NAME_SIGMA, confidence=confidence))
    return join_landmarks(parts)


def build_stairs_landmarks(
    stairs: Array | None, resolution: float, corner: tuple[float, float], height: float, source: str
) -> Landmarks:
    """Build an object "stairs" in the middle of each flight of a mask (h, w); the rest as `build_name_landmarks`."""
    label, count = ndimage.label(np.zeros((1, 1), bool) if stairs is None else stairs)
    middles = np.array(ndimage.center_of_mass(label > 0, label, np.arange(1, count + 1))).reshape(-1, 2)
    x, y = corner[0] + (middles[:, 1] + 0.5) * resolution, corner[1] + (len(label) - middles[:, 0] - 0.5) * resolution
    places = np.stack([x, y, np.full(count, height)], axis=1)
    return build_landmarks("object", ["stairs"] * count, source, places, sigma=NAME_SIGMA)


def read_texts(picture: Array) -> tuple[PictureText, ...] | None:
    """Read the texts of a picture (h, w, 3); None where the extra `text` is not installed. Small pictures are enlarged first."""
    reader = load_text_reader(both_ways=True)
    if reader is None:
        return None
    finer = 2.0 if max(picture.shape[:2]) < SMALL_PICTURE else 1.0
    out = []
    for corners, text, confidence in reader(resize_picture(picture, finer)):
        middle = corners.mean(axis=0) / finer
        height = float(min(np.hypot(*(corners[3] - corners[0])), np.hypot(*(corners[1] - corners[0])))) / finer
        out.append(PictureText(clean_text(text), (float(middle[0]), float(middle[1])), height, confidence))
    return tuple(out)
