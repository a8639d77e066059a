"""The plans on one sheet: which there are, of which storey each is, and how they lie over each other
(beyond the thesis: docs/adr/0041)."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy import fft, ndimage

from topomerge.errors import InputError
from topomerge.io.drawing import ParsedDrawing, TracedDrawing
from topomerge.io.written_lengths import PictureText
from topomerge.types import Array

GAP = 0.6  # m between two plans on a sheet, at least
LEAST_FLOOR, LEAST_SHARE, LEAST_ROOM = 12.0, 0.3, 1.5  # m2 of a plan; of the largest one's floor; m2 of its two rooms
CELL = 0.2  # m, of the lattice in which plans are laid over each other
COMMON = 0.5  # of the floors of two storeys, what both hold of what either does; of titled ones half of that
TITLE_REACH = 4.0  # m from a plan to its title
BELOW = r"basement|cellar|lower ground|keller\w*|untergeschoss|[uk]g|souterrain|sous-?sol|kallare\w*|sotano|seminterrato|kelder"
GROUND = r"ground|erdgeschoss|eg|rez[- ]de[- ]chaussee|rdc|bottenvaning|planta baja|piano terra|main (?:floor|level)|begane grond"
TOP = r"attic|loft|dachgeschoss|dg|grenier|combles?|vind|atico|mansarda|zolder"
UPPER = r"upper (?:floor|level)|first|obergeschoss|og|etage|overvaning|planta (?:alta|primera)|piano primo|verdieping"
ORDINALS = r"second|third|fourth|fifth"
FLOOR_WORD = r"floor|storey|story|level|og|obergeschoss|etage|stock|plan|planta|piano|verdieping"
NUMBERED = re.compile(rf"\b(\d{{1,2}})(?:st|nd|rd|th|er|e|eme|\.|º|°)?\s*(?:{FLOOR_WORD})\b|\b(?:{FLOOR_WORD})\s*(\d{{1,2}})\b")
HIGHEST = 100


@dataclass(frozen=True, eq=False)
class DrawnStorey:
    """A plan of a sheet: walls, floor and treads, (h, w) bool of the sheet's pixels, how probably each shows a door, and where
    its lower left corner is, m."""

    occupied: Array
    free: Array
    stairs: Array | None
    doorway: Array
    corner: tuple[float, float] = (0.0, 0.0)


def find_storeys(
    path: Path, traced: TracedDrawing, number: int | None, untitled: bool = True
) -> tuple[list[DrawnStorey], tuple[str, ...]]:
    """Find the storeys on a sheet, the lowest first, and what is to be told of them.

    Plans that fit over each other are storeys of a building. Others stay beside each other in one map.

    Args:
        path: for messages.
        number: of the only plan that is wanted, from 1: from left to right, from top to bottom; None: all.
        untitled: plans without titles are storeys, too, in the order in which they stand.

    Raises:
        InputError: there is no plan of this number.
    """
    drawing = traced.drawing
    whole = DrawnStorey(drawing.occupied, drawing.free, drawing.stairs, drawing.doorway)
    if number is None and not untitled and len({parse_storey(text.text) for text in traced.texts} - {None}) < 2:
        return [whole], ()
    label, count = find_plans(drawing, traced.resolution)
    plans = [_select_plan(drawing, label == k + 1) for k in range(count)]
    if number is not None:
        if number > count:
            raise InputError(f"{path}: has {count} plan{'s' * (count != 1)}; --page {number} is none of them")
        return [plans[number - 1]], ()
    if count == 1:
        return plans, ()
    ranks = [rank_storey(texts) for texts in find_titles(label, count, traced)]
    titled = None not in ranks and len(set(ranks)) == count
    if not (titled or untitled):
        return [whole], ()
    order = sorted(range(count), key=lambda k: ranks[k] or 0) if titled else list(range(count))
    placed = place_storeys([plans[k] for k in order], traced.resolution, COMMON / 2 if titled else COMMON)
    one = "--page 1 reads the first alone"
    if placed is None:
        return [whole], (f"{path.name}: holds {count} plans that do not fit over each other, read side by side; {one}",)
    how = "by their titles" if titled else "in the order in which they stand"
    return placed, (f"{path.name}: holds {count} plans, read as storeys over each other, {how}; {one}",)


def find_plans(drawing: ParsedDrawing, resolution: float) -> tuple[Array, int]:
    """Find the plans on a sheet: a label image (h, w) of all that is drawn, in reading order from 1, and their number."""
    drawn = drawing.occupied | drawing.free
    reach = max(round(GAP / 2 / resolution), 1)
    near = ndimage.distance_transform_edt(~drawn) <= reach
    parts, count = ndimage.label(near)
    rooms, total = ndimage.label(drawing.free & ~drawing.door)
    numbers = np.arange(1, total + 1)
    size = np.asarray(ndimage.sum(rooms > 0, rooms, numbers)).reshape(-1) * resolution**2
    home = np.asarray(ndimage.maximum(parts, rooms, numbers)).reshape(-1).astype(int)
    floor = np.bincount(home, size, count + 1)
    several = np.bincount(home, size >= LEAST_ROOM, count + 1) >= 2
    main = np.flatnonzero((floor >= max(LEAST_FLOOR, LEAST_SHARE * floor.max(initial=0.0))) & several)
    if len(main) < 2:
        return drawn.astype(np.int32), 1
    boxes = ndimage.find_objects(parts)
    tall = float(np.median([boxes[k - 1][0].stop - boxes[k - 1][0].start for k in main]))
    middles = {k: ((boxes[k - 1][0].start + boxes[k - 1][0].stop) / 2, boxes[k - 1][1].start) for k in main}
    in_order = sorted(main, key=lambda k: (round(middles[k][0] / tall), middles[k][1]))
    new = np.zeros(count + 1, np.int32)
    new[in_order] = np.arange(1, len(main) + 1)
    kept = new[parts]
    nearest = ndimage.distance_transform_edt(kept == 0, return_distances=False, return_indices=True)
    return np.where(drawn, kept[tuple(nearest)], 0), len(main)


def _select_plan(drawing: ParsedDrawing, mask: Array) -> DrawnStorey:
    stairs = None if drawing.stairs is None else drawing.stairs & mask
    return DrawnStorey(drawing.occupied & mask, drawing.free & mask, stairs, np.where(mask, drawing.doorway, 0))


def find_titles(label: Array, count: int, traced: TracedDrawing) -> list[list[PictureText]]:
    """Find the texts beside each plan of a label image (h, w), not in its rooms, the nearest plan's."""
    out: list[list[PictureText]] = [[] for _ in range(count)]
    gaps = np.stack([ndimage.distance_transform_edt(label != k + 1) for k in range(count)]) * traced.resolution
    for text in traced.texts:
        place = np.floor(text.place)
        column, row = (int(v) for v in np.clip(place, 0, np.array(label.shape[::-1]) - 1))  # titles may lie beyond
        if not traced.drawing.free[row, column]:
            nearest = int(gaps[:, row, column].argmin())
            beyond = float(np.hypot(*(place - (column, row)))) * traced.resolution
            if gaps[nearest, row, column] + beyond <= TITLE_REACH:
                out[nearest].append(text)
    return out


def rank_storey(texts: Sequence[PictureText]) -> int | None:
    """Rank the storey that titles name: 0 the ground floor, 1 the first, -1 a basement; None: they name none, or several."""
    found = {rank for text in texts if (rank := parse_storey(text.text)) is not None}
    return found.pop() if len(found) == 1 else None


def parse_storey(text: str) -> int | None:
    """Parse the storey of a title: "Erdgeschoss" is 0, "2nd floor" 2, "Basement" -1."""
    plain = "".join(c for c in unicodedata.normalize("NFD", text.lower()) if not unicodedata.combining(c))
    if found := NUMBERED.search(plain):
        return int(found[1] or found[2])
    for pattern, rank in ((BELOW, -1), (GROUND, 0), (TOP, HIGHEST)):
        if re.search(rf"\b(?:{pattern})\b", plain):
            return rank
    if found := re.search(rf"\b({ORDINALS})\b", plain):
        return ORDINALS.split("|").index(found[1]) + 2
    return 1 if re.search(rf"\b(?:{UPPER})\b", plain) else None


def place_storeys(plans: Sequence[DrawnStorey], resolution: float, common: float) -> list[DrawnStorey] | None:
    """Place each plan over the one below, where walls and outline fit best; None: one of them does not fit."""
    step = max(round(CELL / resolution), 1)
    out = [plans[0]]
    shift = np.zeros(2, int)  # rows and columns, of pixels
    for below, above in pairwise(plans):
        floors = [reduce_mask(ndimage.binary_fill_holes(p.free | p.occupied), step) for p in (below, above)]
        walls = [ndimage.binary_dilation(reduce_mask(p.occupied, step)) for p in (below, above)]
        score = correlate_masks(*floors) + correlate_masks(*walls)
        move = np.array(np.unravel_index(int(np.argmax(score)), score.shape)) - np.array(floors[1].shape) + 1
        both = count_common(floors[0], floors[1], move)
        if both < common * (floors[0].sum() + floors[1].sum() - both):
            return None
        shift = shift + move * step
        out.append(replace(above, corner=(float(shift[1]) * resolution, -float(shift[0]) * resolution)))
    return out


def correlate_masks(below: Array, above: Array) -> Array:
    """Count the cells that two masks (h, w), (k, m) share, for every move of the second: (h + k - 1, w + m - 1) float32.

    Entry (i, j) is of the second moved by i - k + 1 rows and j - m + 1 columns.
    """
    shape = [a + b - 1 for a, b in zip(below.shape, above.shape, strict=True)]
    fast = [fft.next_fast_len(side, real=True) for side in shape]
    spectrum = fft.rfft2(below.astype(np.float32), fast) * fft.rfft2(above[::-1, ::-1].astype(np.float32), fast)
    return np.asarray(fft.irfft2(spectrum, fast)[: shape[0], : shape[1]])


def reduce_mask(mask: Array, step: int) -> Array:
    """Reduce a mask (h, w) to blocks of so many pixels a side: which hold any."""
    padded = np.pad(mask, [(0, -side % step) for side in mask.shape])
    rows, columns = padded.shape
    return np.asarray(padded.reshape(rows // step, step, columns // step, step).any(axis=(1, 3)))


def count_common(below: Array, above: Array, move: Array) -> int:
    """Count the cells of a mask (h, w) that another of the same shape covers, when it is moved by rows and columns."""
    rows, columns = np.nonzero(above)
    rows, columns = rows + move[0], columns + move[1]
    inside = (rows >= 0) & (rows < below.shape[0]) & (columns >= 0) & (columns < below.shape[1])
    return int(below[rows[inside], columns[inside]].sum())
