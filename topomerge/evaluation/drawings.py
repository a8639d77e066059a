"""Drawn plans: how well walls, doors, rooms, names and scale are read from pictures of plans that trained nothing.

``python evaluate.py task=drawings`` draws plans of the test list (``data=dev``: of the validation list) in hands at random, each
once as drawn and once as a scanner or a camera saw it, reads them as `topomerge extract` does and compares with the truth.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage

from topomerge.code_digest import compute_code_digest
from topomerge.datasets.core.building import find_physical_building
from topomerge.datasets.drawings.hands import draw_plan
from topomerge.datasets.drawings.pages import spoil_page
from topomerge.datasets.drawings.shapes import DrawingRecipe, DrawingShapes, build_drawing_shapes
from topomerge.datasets.drawings.sheet import Drawing, choose_hand
from topomerge.evaluation.documents import group_rows, write_mean, write_share, write_table
from topomerge.evaluation.tasks import Row, TaskSettings, find_optional_data, limit_cases, measure_missing
from topomerge.extraction.extract import extract
from topomerge.io.drawing import estimate_scale, parse_drawing, read_texts
from topomerge.io.drawn_page import find_page, move_places
from topomerge.io.points import read_points
from topomerge.io.written_lengths import find_name, parse_lengths
from topomerge.metrics import match_places, score_rooms
from topomerge.networks.drawing import DOOR, PAGE, WALL, WINDOW
from topomerge.types import Array, LogFn, TopometricMap

MAKERS = (
    "topomerge.io.drawing",
    "topomerge.io.drawn_page",
    "topomerge.io.grid",
    "topomerge.networks.drawing",
    "topomerge.extraction.extract",
)
LARGEST_SIDE, FEWEST_ROOMS = 1100, 3  # px of a page; rooms of a plan
LEGIBLE = 10  # px, height of letters that people read without effort
WALL_NEAR, DOOR_NEAR, SCALE_NEAR = 0.1, 0.5, 0.03  # m, m, share
EVERY = {"r2v": 3, "campus": 1, "procedural": 1}  # of a source's plans, every n-th
COLUMNS = (
    *("pages", "of", "rooms' IoU", "of clear floor", "precision", "recall", "walls' F1", "doors found", "doors right"),
    *("names", "of legible ones", "scale", "of legible ones", "outside"),
)


@dataclass
class Settings(TaskSettings):
    """Settings of the task.

    Args:
        texts: read texts, where the extra `text` is installed.
    """

    texts: bool = True


@dataclass(frozen=True)
class Page:
    """A page that is measured: a plan, the seed of the hand, and whether it is spoilt."""

    shapes: DrawingShapes
    seed: int
    spoilt: bool

    @property
    def name(self) -> str:
        """Name of the plan and how it was seen."""
        return f"{self.shapes.name}:{'seen' if self.spoilt else 'drawn'}"


def list_pages(settings: TaskSettings) -> list[Page]:
    """List the pages of the set."""
    split = "validation" if settings.data.set == "dev" else "test"
    data = find_optional_data()
    recipe = DrawingRecipe(f"drawings_{split}", split, 16, 0, str(data or ""))
    counts: dict[str, int] = {}
    pages = []
    for number, shapes in enumerate(build_drawing_shapes(recipe, settings.cache)):
        source = shapes.name.split("/")[0]
        counts[source] = counts.get(source, 0) + 1
        if counts[source] % EVERY.get(source, 1) == 0 and len(shapes.rooms) >= FEWEST_ROOMS:
            pages += [Page(shapes, number, corrupted) for corrupted in (False, True)]
    return limit_cases(pages, settings)


def list_inputs(settings: TaskSettings) -> list[str]:
    """Return names of the pages."""
    return [page.name for page in list_pages(settings)]


def measure(settings: Settings, log_line: LogFn) -> list[Row]:
    """Measure each page."""
    items = {page.name: (page, settings.texts) for page in list_pages(settings)}
    path = Path(settings.cache) / "evaluation" / f"drawings-{settings.data.set or 'test'}.jsonl"
    return measure_missing(path, items, measure_page, log_line, settings, compute_code_digest(*MAKERS, __name__))


def draw_page(page: Page) -> Drawing:
    """Draw a whole plan."""
    rng = np.random.default_rng([page.seed, 91])
    points = np.concatenate([room.polygon for room in page.shapes.rooms])
    low, high = points.min(axis=0) - 2.5, points.max(axis=0) + 2.5
    scale = min(float(rng.uniform(22, 60)), LARGEST_SIDE / float((high - low).max()))
    w, h = (int(v) for v in np.ceil((high - low) * scale))
    drawing = draw_plan(page.shapes, choose_hand(rng), rng, (h, w), scale, low)
    return spoil_page(drawing, rng) if page.spoilt else drawing


def measure_page(page: Page, texts: bool) -> Row:
    """Read a page, and compare it with its truth."""
    drawing = draw_page(page)
    resolution = 1 / drawing.scale
    row: Row = {"spoilt": page.spoilt, "source": page.shapes.name.split("/")[0]}
    row["place"] = find_physical_building(row["source"], page.shapes.name.partition("/")[2])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.png"
        Image.fromarray(drawing.picture).save(path)
        try:
            map = extract(read_points(path, resolution=resolution))
            drawing = straighten_truth(drawing)
        except ValueError as error:
            nothing = dict.fromkeys(("iou", "clear", "precision", "recall", "walls"), 0.0)
            return row | {"failed": str(error).partition(": ")[2], **nothing}
    row |= score_map(map, drawing, resolution)
    parsed = parse_drawing(drawing.picture, resolution)
    row["walls"] = score_walls(parsed.occupied, drawing, parsed.zoom)
    if texts and not page.spoilt and (found := read_texts(drawing.picture)) is not None:
        scale = estimate_scale(parse_drawing(drawing.picture), found)
        right = bool(scale and abs(np.log(scale.resolution / resolution)) < SCALE_NEAR)
        for more, least in (("", 0), ("_legible", LEGIBLE)):
            texts_in = [t for t in drawing.texts if t.room >= 0 and t.height >= least]
            if any(parse_lengths(t.text) != (None, None) for t in texts_in):
                row["scale" + more] = right
            names = [t for t in texts_in if find_name(t.text)]
            row["names" + more] = [sum(_is_read(t, found, drawing) for t in names), len(names)]
    return row


def straighten_truth(drawing: Drawing) -> Drawing:
    """Return a drawing and its truth as they lie on the page that is read."""
    page = find_page(drawing.picture)
    if page is None or not page.mended:
        return drawing
    height, width = page.picture.shape[:2]
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    places = np.rint(move_places(page.matrix, np.column_stack([columns.ravel(), rows.ravel()]))).astype(int)
    column, row = np.clip(places, 0, np.array(drawing.classes.shape[::-1]) - 1).T
    inside = ((places >= 0) & (places < drawing.classes.shape[::-1])).all(axis=1)
    rooms = np.where(inside, drawing.rooms[row, column], -1).reshape(height, width).astype(np.int16)
    classes = np.where(inside, drawing.classes[row, column], PAGE).reshape(height, width).astype(np.uint8)
    return replace(drawing, picture=page.picture, classes=classes, rooms=rooms)


def _is_read(text: Any, found: Sequence[Any], drawing: Drawing) -> bool:
    """Return whether the name was read, in its room."""
    for one in found:
        column, row = (int(v) for v in one.place)
        at = drawing.rooms[min(row, len(drawing.rooms) - 1), min(column, drawing.rooms.shape[1] - 1)]
        if at == text.room and find_name(text.text).casefold() in one.text.casefold():
            return True
    return False


def label_pixels(map: TopometricMap, shape: tuple[int, int], resolution: float) -> Array:
    """Label (h, w) int32 the pixels of a page by the room of the map that lies there, -1 none."""
    cells = map.navigable.compute_centroids()[:, :2]
    out = np.full(shape, -1, np.int32)
    reach = max(int(np.ceil(map.navigable.edge / resolution)), 1)
    column, row = np.floor(cells[:, 0] / resolution).astype(int), shape[0] - 1 - np.floor(cells[:, 1] / resolution).astype(int)
    for i in range(-(reach // 2), reach // 2 + 1):
        for j in range(-(reach // 2), reach // 2 + 1):
            r, c = np.clip(row + i, 0, shape[0] - 1), np.clip(column + j, 0, shape[1] - 1)
            out[r, c] = map.navigable_room
    return out


def score_map(map: TopometricMap, drawing: Drawing, resolution: float) -> Row:
    """Score rooms and doors of a map, and count the rooms of it that lie outside."""
    step = max(int(0.06 / resolution), 1)
    true, predicted = drawing.rooms[::step, ::step], label_pixels(map, drawing.rooms.shape, resolution)[::step, ::step]
    trues = int(drawing.rooms.max()) + 1
    seen = np.bincount(drawing.rooms[drawing.rooms >= 0].ravel(), minlength=trues) * resolution**2 > 1.0
    counted = map.rooms["outside"] < 0.5
    scores = score_rooms(true.ravel(), predicted.ravel(), trues, counted, seen)
    # True rooms reach into the walls by half of them; nobody can draw that from what is on the page.
    clear = ~np.isin(drawing.classes[::step, ::step], (WALL, WINDOW))
    scores_clear = score_rooms(true[clear], predicted[clear], trues, counted, seen)
    on_page = [float((true[predicted == k] < 0).mean()) for k in np.flatnonzero(counted) if (predicted == k).any()]
    doors, _ = ndimage.label(drawing.classes == DOOR)
    middles = np.array(ndimage.center_of_mass(doors > 0, doors, np.arange(1, doors.max() + 1))).reshape(-1, 2)
    big = np.bincount(doors.ravel())[1:] > 8
    inner = np.array([_joins_two_rooms(drawing.rooms, m, resolution) for m in middles], bool).reshape(-1) & big
    height = drawing.rooms.shape[0]
    places = np.column_stack([middles[:, 1], height - 1 - middles[:, 0], np.zeros(len(middles))]) * [resolution, resolution, 1]
    edges = map.edges["centre"] * [1, 1, 0]
    matched = match_places(places[inner], edges, DOOR_NEAR)
    any_door = match_places(places[big], edges, DOOR_NEAR)
    return {
        "iou": scores.iou,
        "clear": scores_clear.iou,
        "precision": scores.precision,
        "recall": scores.recall,
        "found": [len(matched), int(inner.sum())],
        "right": [len(any_door), len(edges)],
        "outside": int(sum(share > 0.7 for share in on_page)),
    }


def _joins_two_rooms(rooms: Array, middle: Array, resolution: float) -> bool:
    reach = int(0.7 / resolution)
    row, column = (int(v) for v in middle)
    part = rooms[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
    return len(np.unique(part[part >= 0])) > 1


def score_walls(occupied: Array, drawing: Drawing, zoom: float) -> float:
    """Compute the F1 of the pixels of walls and windows that lie within 0.1 m of true ones, and the other way round."""
    h, w = drawing.classes.shape
    rows, columns = np.clip((np.arange(h) * zoom).astype(int), 0, occupied.shape[0] - 1), np.arange(w) * zoom
    found = occupied[rows][:, np.clip(columns.astype(int), 0, occupied.shape[1] - 1)]
    true = np.isin(drawing.classes, (WALL, WINDOW))
    if not found.any() or not true.any():
        return 0.0
    near = WALL_NEAR * drawing.scale
    right = float((ndimage.distance_transform_edt(~true)[found] <= near).mean())
    present = float((ndimage.distance_transform_edt(~found)[true] <= near).mean())
    return 2 * right * present / (right + present) if right + present else 0.0


def tabulate(rows: Sequence[Row], settings: TaskSettings) -> dict[str, str]:
    """Tabulate a line for each source as drawn and as seen, and for all."""
    lines = []
    for corrupted, what in ((False, "as drawn"), (True, "as seen")):
        some = [row for row in rows if row["spoilt"] == corrupted]
        for source, group in {**group_rows(some, lambda row: str(row["source"])), "all": some}.items():
            if group:
                lines.append([what, source, *summarise(group)])
    failed = [f"{row['name']}: {row['failed']}" for row in rows if "failed" in row]
    more = f"\n\nNot read: {len(failed)} of {len(rows)}" + "".join(f"\n- {line}" for line in failed[:20])
    return {"drawings": f"{len(rows)} pages.\n\n{write_table(COLUMNS, lines)}{more}"}


def summarise(rows: Sequence[Row]) -> list[str]:
    """Return the means of the measures, and shares of counts."""
    out = [write_mean(rows, key) for key in ("iou", "clear", "precision", "recall", "walls")]
    for key in ("found", "right", "names", "names_legible", "scale", "scale_legible"):
        counts = [row[key] if isinstance(row[key], list) else [int(row[key]), 1] for row in rows if key in row]
        out.append(write_share(np.sum(counts, axis=0).tolist()) if counts else "-")
    return [*out, str(sum(row.get("outside", 0) for row in rows))]
