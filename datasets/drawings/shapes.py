"""Shapes that a drawing of a storey shows: outlines of rooms, openings, walls and stairs, of real plans and of procedural
buildings."""

from __future__ import annotations

import gzip
import hashlib
import json
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.core.building import Difficulty, Plan
from topomerge.datasets.plans import splits

from topomerge.archive import replace_on_success
from topomerge.errors import InputError
from topomerge.types import Array, LogFn

SHAPES_FORMAT = 1  # raised when what is drawn of a plan changes
SOURCES = ("r2v", "campus", "rmf")  # real plans that are drawn
WINDOWS_SHARE = 0.5  # of the outer sides of rooms get a window where a plan has none
MIRRORED = np.array([-1.0, 1.0])


@dataclass
class DrawingRecipe:
    """A set of plans that are drawn.

    Args:
        name: of its file in the cache.
        split: train, validation or test: of which plans.
        procedural: storeys of procedural buildings beside them.
        seed: of the first of these, from the beginning of the split's range on.
        folder: of the real data; empty: procedural buildings only.
    """

    name: str = "drawings"
    split: str = "train"
    procedural: int = 600
    seed: int = 0
    folder: str = ""


@dataclass(frozen=True)
class RoomShape:
    """A room of a drawing: outline (k, 2), m, and its kind."""

    polygon: Array
    kind: str


@dataclass(frozen=True)
class OpeningShape:
    """A door, opening or window: its middle line (2, 2), m, and the thickness of its wall, m."""

    kind: str
    line: Array
    thickness: float


@dataclass(frozen=True)
class DrawingShapes:
    """Shapes of a plan, m: rooms, openings, walls (w, 2, 2) with their thickness (w,), and rectangles (4, 2) of stairs."""

    name: str
    rooms: tuple[RoomShape, ...]
    openings: tuple[OpeningShape, ...]
    walls: Array = field(default_factory=lambda: np.zeros((0, 2, 2)))
    thickness: Array = field(default_factory=lambda: np.zeros(0))
    stairs: tuple[Array, ...] = ()


def collect_shapes(plan: Plan, name: str) -> DrawingShapes:
    """Collect what is drawn of a storey."""
    rooms = tuple(RoomShape(np.asarray(r.polygon, np.float64), r.kind) for r in plan.rooms if r.kind not in ("void", "shaft"))
    openings = tuple(OpeningShape(o.kind, np.array([o.start, o.end]), float(o.thickness)) for o in plan.openings)
    walls = np.array([[w.start, w.end] for w in plan.walls]).reshape(-1, 2, 2)
    stairs = []
    for flight in plan.flights:
        ahead = np.array([np.cos(flight.heading), np.sin(flight.heading)])
        right = np.array([ahead[1], -ahead[0]])
        corner = np.asarray(flight.corner)
        across, along = right * flight.width, ahead * flight.length
        stairs.append(np.stack([corner, corner + along, corner + along + across, corner + across]))
    return DrawingShapes(name, rooms, openings, walls, np.array([w.thickness for w in plan.walls]), tuple(stairs))


def add_windows(shapes: DrawingShapes, rng: np.random.Generator, share: float = WINDOWS_SHARE) -> DrawingShapes:
    """Return the shapes with windows in outer walls, where a plan of these sources shows none."""
    import shapely

    if any(o.kind == "window" for o in shapes.openings):
        return shapes
    outlines = [shapely.Polygon(room.polygon) for room in shapes.rooms]
    tree, windows = shapely.STRtree(outlines), []
    for outline in outlines:
        ring = np.asarray(shapely.orient_polygons(outline).exterior.coords)
        for start, end in pairwise(ring):
            length = float(np.hypot(*(end - start)))
            if length < 1.4 or rng.random() > share:
                continue
            along = (end - start) / length
            outward = np.array([along[1], -along[0]])
            middle, width = (start + end) / 2, min(length - 0.6, rng.uniform(0.8, 2.4))
            if len(tree.query(shapely.Point(middle + outward * 0.5), predicate="intersects")):
                continue
            half = along * width / 2
            windows.append(OpeningShape("window", np.stack([middle - half, middle + half]) + outward * 0.08, 0.2))
    return replace(shapes, openings=(*shapes.openings, *windows))


def mirror_shapes(shapes: DrawingShapes) -> DrawingShapes:
    """Return the shapes of the mirrored storey."""
    return replace(
        shapes,
        rooms=tuple(replace(room, polygon=room.polygon * MIRRORED) for room in shapes.rooms),
        openings=tuple(replace(opening, line=opening.line * MIRRORED) for opening in shapes.openings),
        walls=shapes.walls * MIRRORED,
        stairs=tuple(rectangle * MIRRORED for rectangle in shapes.stairs),
    )


def build_drawing_shapes(recipe: DrawingRecipe, cache: str | Path, log_line: LogFn = lambda text: None) -> list[DrawingShapes]:
    """Build the shapes of a set, or read them from the cache.

    Raises:
        InputError: no plan of the split, or no such folder.
    """
    inputs = {"format": SHAPES_FORMAT, **asdict(recipe), "folder": bool(recipe.folder)}
    digest = hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:12]
    path = Path(cache) / "drawings" / f"{recipe.name}-{digest}.json.gz"
    if not path.exists():
        log_line(f"{recipe.name}: collecting plans")
        shapes = [*_collect_real(recipe), *_collect_procedural(recipe)]
        if not shapes:
            raise InputError(f"data.split={recipe.split}: no plan to draw; give data.folder or more data.procedural")
        path.parent.mkdir(parents=True, exist_ok=True)
        listing = json.dumps([_convert_to_listing(one) for one in shapes]).encode()
        with replace_on_success(path) as temporary:
            temporary.write_bytes(gzip.compress(listing, mtime=0))
    with gzip.open(path, "rt", encoding="utf-8") as stream:
        return [_parse_shapes(entry) for entry in json.load(stream)]


def _collect_real(recipe: DrawingRecipe) -> list[DrawingShapes]:
    from topomerge.datasets.plans.floorplans import Refusal, iter_plans

    out = []
    for source in SOURCES if recipe.folder else ():
        rng = np.random.default_rng([recipe.seed, SOURCES.index(source)])
        names = set(splits.list_members(recipe.split, source))
        for name, plan in iter_plans(Path(recipe.folder) / splits.FOLDERS[source], names):
            if not isinstance(plan, Refusal):
                out.append(add_windows(collect_shapes(plan, f"{source}/{name}"), rng))
    return out


def _collect_procedural(recipe: DrawingRecipe) -> list[DrawingShapes]:
    from topomerge.datasets.buildings.layouts import BUILDING_KINDS, PROFILES
    from topomerge.datasets.buildings.procedural import make_plans

    first = splits.get_seed_range(recipe.split)[0] + recipe.seed
    out = []
    for seed in range(first, first + recipe.procedural):
        kind = BUILDING_KINDS[seed % len(BUILDING_KINDS)]
        plans = make_plans(PROFILES[kind], 1, Difficulty(), np.random.default_rng([seed, SHAPES_FORMAT]))
        out.append(collect_shapes(plans[0], f"procedural/{seed}"))
    return out


def _convert_to_listing(shapes: DrawingShapes) -> dict[str, Any]:
    def plain(points: Array) -> Any:
        return np.round(points, 3).tolist()

    return {
        "name": shapes.name,
        "rooms": [[room.kind, plain(room.polygon)] for room in shapes.rooms],
        "openings": [[o.kind, plain(o.line), round(o.thickness, 3)] for o in shapes.openings],
        "walls": plain(shapes.walls),
        "thickness": plain(shapes.thickness),
        "stairs": [plain(rectangle) for rectangle in shapes.stairs],
    }


def _parse_shapes(entry: dict[str, Any]) -> DrawingShapes:
    return DrawingShapes(
        entry["name"],
        tuple(RoomShape(np.array(polygon), kind) for kind, polygon in entry["rooms"]),
        tuple(OpeningShape(kind, np.array(line), thickness) for kind, line, thickness in entry["openings"]),
        np.array(entry["walls"]).reshape(-1, 2, 2),
        np.array(entry["thickness"]),
        tuple(np.array(rectangle) for rectangle in entry["stairs"]),
    )
