"""Merges of look-alikes with signs and tags: what is believed that must not be, and what is no longer.

``python evaluate.py task=landmarks data=test pairs=12 again=6 write=docs/results/landmarks.md``. So many pairs of each kind of
places made to be alike (`datasets.pairs.lookalikes`), and so many of the first place visited twice, which belong together. Each
pair is registered without landmarks, with half of the door signs read with a fifth of their characters wrong, with signs read
well, with tags, and with what phones hear of access points (`READINGS`).
Landmarks are drawn beside the maps: these are those of the other tables. Right: within 0.5 m and 5 degrees. ``data=signs``: the
likelihood of signs alone, without walls, in a minute; ``data=signs_train``: of training buildings, to choose by; ``data=reader``:
a real reader on pictures of signs; ``data=wifi``: what WiFi alone makes of places that walls believe.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

from topomerge.code_digest import compute_code_digest
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.core.builder import limit_threads
from topomerge.datasets.drawings.sheet import load_font
from topomerge.datasets.pairs.grid_pairs import GridPair, load_grids
from topomerge.datasets.pairs.lookalike_places import sample_places
from topomerge.datasets.pairs.lookalike_radio import WIFI, simulate_lookalike_radio
from topomerge.datasets.pairs.lookalikes import (
    LOOKALIKES,
    LookalikeItem,
    LookalikeRecipe,
    build_lookalikes,
    draw_lookalike_items,
    read_lookalike_signs,
)
from topomerge.datasets.pairs.pairs import draw_frames
from topomerge.datasets.plans.splits import get_seed_range
from topomerge.datasets.simulation.radio import RadioSettings
from topomerge.datasets.simulation.signs import (
    READERS,
    Reader,
    change_signs,
    draw_numbering,
    draw_other_numbering,
    number_rooms,
    place_signs,
    read_signs,
)
from topomerge.errors import InputError
from topomerge.evaluation.documents import write_table
from topomerge.evaluation.tasks import Row, TaskSettings, measure_missing
from topomerge.io.pictures import explain_missing_reader, load_text_reader
from topomerge.landmarks.evidence import LandmarkScorer, score_landmarks
from topomerge.landmarks.text import count_edits
from topomerge.registration.pipeline import register
from topomerge.registration.posterior import PRIORS, update_posterior
from topomerge.registration.verify import load_model
from topomerge.statistics import bootstrap_mean, compute_exact_interval
from topomerge.training.belief_hypotheses import compute_pose_error, is_hypothesis_right
from topomerge.types import (
    EDGE_DTYPE,
    ROOM_DTYPE,
    STOREY_DTYPE,
    Array,
    Landmarks,
    LogFn,
    Sim3,
    TopometricMap,
    VoxelGrid,
    fold_text,
)

MAKERS = ("topomerge.registration.pipeline", "topomerge.landmarks.evidence", "topomerge.datasets.pairs.lookalikes")
READINGS: dict[str, Reader | RadioSettings | None] = {
    "no landmarks": None,
    "half of the signs, 20 % wrong": Reader(("text",), 0.5, 0.2),
    "nine of ten signs, 2 % wrong": Reader(("text",), 0.9, 0.02),
    "tags": Reader(("tag",), 0.9, 0.0),
    "WiFi": WIFI,
}
HEADS = (
    "landmarks",
    "pairs",
    "wrongly merged",
    "95 %",
    "of these, with landmarks",
    "wrong",
    "true pairs",
    "right and believed",
    "%",
)


@dataclass
class Settings(TaskSettings):
    """Settings of the task.

    Args:
        pairs: of each kind of look-alikes.
        again: of each kind, places visited twice.
        readings: numbers of `READINGS` that are measured.
    """

    pairs: int = 12
    again: int = 6
    readings: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])


def make_recipe(settings: Settings) -> LookalikeRecipe:
    """Return the recipe of the pairs."""
    split, name = ("train", "signs_train") if settings.data.set == "train" else ("test", "signs_test")
    pairs, repeated = (dict.fromkeys(LOOKALIKES, count) for count in (settings.pairs, settings.again))
    return LookalikeRecipe(name=name, split=split, pairs=pairs, again=repeated, scaled=0.0)


def list_inputs(settings: Settings) -> list[str]:
    """Return names of the pairs, or of the buildings whose signs are scored alone."""
    if settings.data.set == "wifi":
        return [item.name for item in draw_wifi_items(settings)]
    if settings.data.set == "reader":
        return [f"sign {k}" for k in range(settings.data.limit or PICTURED)]
    if settings.data.set in ALONE:
        return [f"signs {k}" for k in range(settings.data.limit or BUILDINGS)]
    return [item.name for item in draw_lookalike_items(make_recipe(settings))]


def measure(settings: Settings, log_line: LogFn) -> list[Row]:
    """Measure the pairs that are missing."""
    if settings.data.set == "reader":
        signs = {name: (k,) for k, name in enumerate(list_inputs(settings))}
        path = Path(settings.cache) / "evaluation" / "sign_readers.jsonl"
        return measure_missing(path, signs, measure_reader, log_line, settings, compute_code_digest(*READING))
    if settings.data.set in ALONE:
        path = Path(settings.cache) / "evaluation" / f"{settings.data.set}.jsonl"
        buildings = {name: (k, ALONE[settings.data.set]) for k, name in enumerate(list_inputs(settings))}
        return measure_missing(path, buildings, measure_building, log_line, settings, compute_code_digest(__name__))
    if settings.data.set == "wifi":
        path = Path(settings.cache) / "evaluation" / "wifi_lookalikes.jsonl"
        places = {name_item(item): (item,) for item in draw_wifi_items(settings)}
        return measure_missing(path, places, measure_wifi, log_line, settings)
    recipe = make_recipe(settings)
    sharing = _Sharing(settings.cache, settings.jobs)
    files = {path.stem: path for path in build_lookalikes(recipe, sharing, log_line)[0]}
    names = tuple(list(READINGS)[k] for k in settings.readings)
    items = {name_item(item): (files[item.name], item, names) for item in draw_lookalike_items(recipe) if item.name in files}
    path = Path(settings.cache) / "evaluation" / f"{recipe.name}.jsonl"
    items = {k: v for k, v in items.items() if settings.data.only in k}
    rows = measure_missing(path, items, measure_pair, log_line, settings)
    return [{**row, **of} for row in rows for of in row["readings"]]


def name_item(item: LookalikeItem) -> str:
    """Return the name of the row of an item."""
    return f"{item.kind}-{item.number}{'-again' if item.again else ''}"


ALONE = {"signs": "test", "signs_train": "train"}  # sets of signs alone: split of the buildings
BUILDINGS, PICTURED = 40, 40
READING = ("topomerge.evaluation.landmarks", "topomerge.io.pictures")
LAYOUTS = ("office", "hotel", "hospital", "school")
SEEN_ROOMS, VISITED = 8, 6  # rooms near each other, and how many of them each visitor enters
READ_ALONE = {**READERS, "fair": Reader(reads=0.7, wrong=0.08)}
RELATIONS = {
    "storey": "storey",
    "wing": "wing",
    "row": "elsewhere",
    "building": "building",
}  # other place -> its alternative


def measure_building(number: int, split: str) -> Row:
    """Score signs of one place read twice, and of places that have its walls and are another storey, wing, row or building."""
    rng = np.random.default_rng([number, 51, int(split == "test")])
    first, last = get_seed_range(split)
    building = make_building(LAYOUTS[number % len(LAYOUTS)], int(rng.integers(first, last + 1)), 1)
    numbering = draw_numbering(rng)
    signs = place_signs(building, numbering, np.random.default_rng(1))
    middles = np.array([room.polygon.mean(axis=0) for room in building.rooms])
    away = np.linalg.norm(middles - middles[int(rng.integers(len(middles)))], axis=1)
    visits = [rng.permutation(np.argsort(away)[:SEEN_ROOMS])[:VISITED].tolist() for _ in range(2)]
    cells = np.unique(np.floor(signs["at"] / 0.3).astype(int), axis=0)
    grid = VoxelGrid.from_cells(cells - cells.min(axis=0), cells.min(axis=0) * 0.3, 0.3)
    scored = []
    for name, reader in READ_ALONE.items():
        own = read_signs(signs, visits[0], Sim3(), reader, rng)
        for relation in ("", *RELATIONS):
            drawn = draw_other_numbering(numbering, relation, rng) if relation else numbering
            other = place_signs(building, drawn, np.random.default_rng(1)) if relation else signs
            later = read_signs(change_signs(other, rng), visits[1], Sim3(), reader, rng)
            maps = [build_bare_map(grid, None, of) for of in (own, later)]
            odds = score_landmarks(maps[0], maps[1], Sim3()).compute_likelihoods()
            scored += [[name, relation, odds[a]] for r, a in RELATIONS.items() if relation in ("", r)]
    return {"scored": scored}


def tabulate_alone(rows: Sequence[Row]) -> str:
    """Tabulate the mean log loss of another place against this one, alike likely before, and how often ten to one is wrong."""
    lines = []
    for name in READ_ALONE:
        scored = [(relation, odds) for row in rows for reader, relation, odds in row["scored"] if reader == name]
        here = np.array([odds for relation, odds in scored if not relation])
        cells = [f"{np.logaddexp(0, here).mean():.3f}", f"{(here > SURE_ODDS).mean():.3f}"]
        for kind in RELATIONS:
            odds = np.array([o for relation, o in scored if relation == kind])
            cells += [f"{np.logaddexp(0, -odds).mean():.3f}", f"{(odds < -SURE_ODDS).mean():.3f}"]
        lines.append([name, len(here) // len(RELATIONS), *cells])
    heads = [f"{what}{suffix}" for what in ("this place", *RELATIONS) for suffix in ("", ": told wrong")]
    return write_table(["reader", "places", *heads], lines)


WORLDS = 5  # draws of access points, and of where the second place lies, of each pair of places
BELIEVED, DOUBTED = 0.95, 0.4  # probability by walls of places that look alike; of true pairs that walls do not carry


def draw_wifi_items(settings: Settings) -> list[LookalikeItem]:
    """Draw the places that are judged by WiFi alone."""
    items = draw_lookalike_items(make_recipe(settings))
    return [item for item in items if settings.data.only in name_item(item)]


def measure_wifi(item: LookalikeItem) -> Row:
    """Compute what WiFi leaves of the belief in a pose that walls hold right; of several that look alike in the worst one."""
    places = sample_places(item.kind, item.furniture, item.seed)
    frames = draw_frames(2, item.scaled, np.random.default_rng([item.seed, item.number, LOOKALIKES.index(item.kind)]))
    grid, worlds = VoxelGrid.from_cells(np.zeros((1, 3), np.int64), np.zeros(3), 0.3), []
    for draw in range(WORLDS):
        radio = simulate_lookalike_radio(item, places, draw=draw)
        scorer = LandmarkScorer(*(build_bare_map(grid, None, of) for of in radio.readings))
        evidence = [scorer.score(frames[0] @ pose @ frames[1].inverse()) for pose in ([Sim3()] if item.again else places.poses)]
        left = [max(update_posterior(spread_belief(p), THRESHOLD, one)["here"] for one in evidence) for p in (BELIEVED, DOUBTED)]
        readings = [len(np.unique(of.table["group"])) for of in radio.readings]
        worlds.append({"relation": radio.relation, "scans": readings, "left": left})
    return {"kind": item.kind, "again": item.again, "building": item.seed, "worlds": worlds}


def spread_belief(here: float) -> dict[str, float]:
    """Spread what is not believed over the other places, by their priors."""
    rest = 1 - PRIORS["here"]
    return {name: here if name == "here" else (1 - here) * prior / rest for name, prior in PRIORS.items()}


def tabulate_wifi(rows: Sequence[Row]) -> str:
    """Tabulate by relation of the places, and of those of one building by kind, how many poses are still believed."""
    worlds = [{**world, "again": r["again"], "kind": r["kind"], "building": r["building"]} for r in rows for world in r["worlds"]]
    groups = {
        f"{RELATION_WORDS[name]}": [w for w in worlds if not w["again"] and w["relation"] == name] for name in RELATION_WORDS
    }
    groups["all look-alikes"] = [w for w in worlds if not w["again"]]
    groups["one place visited twice"] = [w for w in worlds if w["again"]]
    lines: list[list[object]] = []
    for name, some in groups.items():
        if not some:
            continue
        buildings = np.array([w["building"] for w in some])
        accepted = np.array([[p >= THRESHOLD for p in w["left"]] for w in some], float)
        share, low, high = bootstrap_mean(accepted[:, 0], buildings)
        scans = float(np.median([min(w["scans"]) for w in some]))
        counts = [f"{100 * share:.1f} %", f"{100 * low:.1f} to {100 * high:.1f} %", f"{100 * accepted[:, 1].mean():.1f} %"]
        lines.append([name, len(np.unique(buildings)), len(some), f"{scans:.0f}", *counts])
    heads = ["places", "buildings", "pairs", "scans of the smaller map, median", "walls .95: still believed", "95 %"]
    return write_table([*heads, "walls .40: believed"], lines)


RELATION_WORDS = {
    "storey": "two storeys",
    "wing": "two wings",
    "row": "two rooms of a row",
    "building": "two buildings",
    "": "two parts of one map of walls",
}
THRESHOLD = float(load_model()["threshold"])
SURE_ODDS = float(np.log(10))


@dataclass
class _Sharing:
    """How the building of a set is shared out (`BuildSettings`)."""

    cache: str
    jobs: int
    cluster: str | None = None
    part: list[int] = field(default_factory=lambda: [1, 1])


def build_bare_map(grid: VoxelGrid, free: VoxelGrid | None, landmarks: Landmarks) -> TopometricMap:
    """Return the map of cells without rooms, with landmarks."""
    none = np.zeros(0, np.int32)
    rooms, edges, storeys = (np.zeros(0, dtype) for dtype in (ROOM_DTYPE, EDGE_DTYPE, STOREY_DTYPE))
    labels = np.full(len(grid), -1, np.int32)
    return TopometricMap(
        grid, labels, grid.replace_cells(grid.cells[:0]), none, rooms, edges, storeys, free=free, landmarks=landmarks
    )


def measure_pair(file: Path, item: LookalikeItem, readings: Sequence[str]) -> Row:
    """Register a pair with what readers give of its signs; where one map has none, the verdict is that without landmarks."""
    pair = load_grids(file)
    outcomes: list[Row] = []
    for name in readings:
        signs = read_landmarks(item, READINGS[name])
        some = min(map(len, signs)) > 0
        alone = next((row for row in outcomes if not min(row["landmarks"])), None)
        found = alone if alone is not None and not some else _register_pair(pair, signs)
        outcomes.append({**found, "reading": name, "landmarks": [len(t) for t in signs]})
    return {"kind": item.kind, "again": item.again, "tellable": pair.about.get("tellable"), "readings": outcomes}


def read_landmarks(item: LookalikeItem, reading: Reader | RadioSettings | None) -> tuple[Landmarks, Landmarks]:
    """Read the landmarks of the places of an item by one of `READINGS`."""
    if isinstance(reading, RadioSettings):
        return simulate_lookalike_radio(item, sample_places(item.kind, item.furniture, item.seed), reading).readings
    return (Landmarks(), Landmarks()) if reading is None else read_lookalike_signs(item, reading)


def _register_pair(pair: GridPair, landmarks: tuple[Landmarks, Landmarks]) -> Row:
    a, b = (build_bare_map(g, f, t) for g, f, t in zip((pair.a, pair.b), pair.free, landmarks, strict=True))
    with limit_threads():
        registration = register(a, b)
    pose: Any = registration.transform
    sensors: Any = pair.about["sensors"]
    error = None if pose is None else compute_pose_error(pose, pair)
    return {
        "probability": registration.probability,
        "walls": registration.walls,
        "believed": registration.accepted,
        "right": is_hypothesis_right(error, sensors),
        "said": registration.landmarks.list_sentences(),
        "factors": {k: dict(f) for k, f in registration.landmarks.factors.items()},
    }


def is_false(row: Row) -> bool:
    """Return whether a pair is believed at a wrong pose."""
    return bool(row["believed"] and not row["right"])


def tabulate(rows: Sequence[Row], settings: Settings) -> dict[str, str]:
    """Tabulate what is wrongly merged and what is believed of true pairs, all and by kind, for each reading."""
    if settings.data.set == "wifi":
        return {"landmarks-wifi": tabulate_wifi(rows)}
    if settings.data.set == "reader":
        return {"sign-readers": tabulate_readers(rows)}
    if settings.data.set in ALONE:
        return {"landmark-odds": tabulate_alone(rows)}
    out = [_format_line(name, [r for r in rows if r["reading"] == name]) for name in READINGS]
    lines: list[list[object]] = []
    for kind in LOOKALIKES:
        for name in READINGS:
            mine = [r for r in rows if r["kind"] == kind and r["reading"] == name]
            lines += [[kind, *_format_line(name, mine)]] if mine else []
    heads = ("kind", *HEADS)
    return {"landmarks": write_table(HEADS, [line for line in out if line[1]]) + "\n" + write_table(heads, lines)}


def _format_line(name: str, rows: Sequence[Row]) -> list[object]:
    """Return a line under `HEADS`."""
    apart, repeated = [r for r in rows if not r["again"]], [r for r in rows if r["again"]]
    wrong, with_landmarks = sum(map(is_false, apart)), [r for r in apart if min(r["landmarks"])]
    low, high = compute_exact_interval(wrong, len(apart)) if apart else (0.0, 1.0)
    good = sum(r["believed"] and r["right"] for r in repeated)
    share: Any = f"{100 * good / len(repeated):.0f}" if repeated else "–"
    interval = f"{100 * low:.1f} to {100 * high:.1f} %"
    return [
        name,
        len(apart),
        wrong,
        interval,
        len(with_landmarks),
        sum(map(is_false, with_landmarks)),
        len(repeated),
        good,
        share,
    ]


HEIGHTS = (6, 8, 10, 13, 18, 26, 40)  # px, of a capital letter
ANGLES = (0.0, 30.0, 55.0)  # degrees from the front
PICTURE = (640, 480)
SIGN_LAYOUTS = ("office", "hotel", "hospital", "school")
SIGN_HEADS = (
    "letters, px",
    "from the side",
    "signs",
    "not read",
    "read right",
    "95 %",
    "of those read: characters wrong",
    "which look alike",
    "too many or few",
)


def measure_reader(number: int) -> Row:
    """Draw one number of a building's door signs at each height and angle, and read it.

    Raises:
        InputError: the reader is not installed.
    """
    read = load_text_reader()
    if read is None:
        raise InputError(f"data=reader: no reader of texts: {explain_missing_reader()}")
    rng = np.random.default_rng([number, 52])
    building = make_building(SIGN_LAYOUTS[number % len(SIGN_LAYOUTS)], int(rng.integers(*get_seed_range("test"))), 1)
    text = str(rng.choice(sorted(set(number_rooms(building, draw_numbering(rng)).values()) - {"WC"})))
    scored = []
    for height in HEIGHTS:
        for angle in ANGLES:
            found = read(draw_sign(text, height, np.radians(angle), rng))
            folded = max((fold_text(one) for _, one, _ in found), key=len, default="")
            alike, unlike, gaps = count_edits(fold_text(text), folded)
            scored.append([height, angle, len(fold_text(text)), len(folded), alike, unlike, gaps])
    return {"text": text, "scored": scored}


def draw_sign(text: str, height: int, angle: float, rng: np.random.Generator) -> Array:
    """Return (480, 640, 3) uint8, a picture of a sign on a wall.

    Args:
        text: what the sign bears.
        height: px, of a capital letter in the picture.
        angle: radians by which the sign is turned away from the camera.
    """
    large = 4 * height  # drawn larger, then made smaller, as a lens does
    font = load_font(int(rng.integers(1000)), round(large / 0.72), text)
    left, top, right, bottom = font.getbbox(text)
    w, h = int(right - left + 2 * large), int(bottom - top + 2 * large)
    wall, plate = int(rng.integers(120, 240)), int(rng.integers(170, 256))
    ink = int(rng.integers(0, 90))
    if rng.random() < 0.3:  # white on dark
        plate, ink = int(rng.integers(20, 90)), int(rng.integers(190, 256))
    sign = Image.new("L", (w, h), plate)
    ImageDraw.Draw(sign).text((large - left, large - top), text, fill=ink, font=font)
    width, near = w * np.cos(angle), 1 + 0.15 * np.sin(angle)  # the nearer edge is higher
    sizes = max(round(width / 4), 2), max(round(h / 4), 2)
    sign = sign.resize(sizes, Image.Resampling.BOX)
    w, h = sizes
    corners = np.array([[0, 0], [w, h * (1 - 1 / near) / 2], [w, h * (1 + 1 / near) / 2], [0, h]])
    picture = Image.new("L", PICTURE, wall)
    shift = np.array([rng.uniform(10, max(PICTURE[0] - w - 10, 11)), rng.uniform(10, max(PICTURE[1] - h - 10, 11))])
    turned = sign.transform(
        PICTURE, Image.Transform.PERSPECTIVE, _find_homography(corners + shift, w, h), Image.Resampling.BICUBIC, fillcolor=wall
    )
    inside = Image.new("L", sign.size, 255).transform(
        PICTURE, Image.Transform.PERSPECTIVE, _find_homography(corners + shift, w, h)
    )
    picture.paste(turned, mask=inside)
    picture = picture.filter(ImageFilter.GaussianBlur(float(rng.uniform(0.3, 1.2))))  # px, of the lens and of the hand
    values = np.asarray(picture, float) + rng.normal(0.0, rng.uniform(2.0, 8.0), PICTURE[::-1])
    stream = BytesIO()
    Image.fromarray(np.clip(values, 0, 255).astype(np.uint8)).convert("RGB").save(
        stream, "JPEG", quality=int(rng.integers(60, 95))
    )
    return np.asarray(Image.open(stream))


def _find_homography(corners: Array, w: int, h: int) -> tuple[float, ...]:
    """Return the coefficients of Pillow's perspective: from places of the picture to those of the sign."""
    rows, values = [], []
    for (x, y), (u, v) in zip(corners, ((0, 0), (w, 0), (w, h), (0, h)), strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        values += [u, v]
    return tuple(np.linalg.solve(np.array(rows, float), np.array(values, float)).tolist())


def tabulate_readers(rows: Sequence[Row]) -> str:
    """Tabulate, by height and angle, how many signs are read, read right, and how the other ones are wrong."""
    scored = np.array([line for row in rows for line in row["scored"]], float)
    lines: list[list[object]] = []
    for height in HEIGHTS:
        for angle in ANGLES:
            mine = scored[(scored[:, 0] == height) & (scored[:, 1] == angle)]
            if not len(mine):
                continue
            readings = mine[mine[:, 3] > 0]
            alike, unlike, gaps = readings[:, 4:].sum(axis=0)
            right = int((readings[:, 4:].sum(axis=1) == 0).sum())
            low, high = compute_exact_interval(right, len(mine))
            wrong = alike + unlike + gaps
            shares = [f"{100 * part / wrong:.0f} %" if wrong else "–" for part in (alike, gaps)]
            error = f"{wrong / readings[:, 2].sum():.3f}" if len(readings) else "–"
            lines.append(
                [height, f"{angle:.0f}°", len(mine), len(mine) - len(readings), right, f"{low:.2f}–{high:.2f}", error, *shares]
            )
    return write_table(SIGN_HEADS, lines)
