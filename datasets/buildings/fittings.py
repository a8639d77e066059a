"""Fittings of the shell: door leaves, panes, sloped ceilings, columns, beams, lamps, furniture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from topomerge.datasets.buildings.furniture import FurnishedFloor, Item, compute_footprints, furnish
from topomerge.datasets.buildings.openings import RoomCells, WallOpening
from topomerge.datasets.core.building import SURFACES, THING_DTYPE, Difficulty, Plan
from topomerge.datasets.core.solids import (
    TriangleSoup,
    build_rotation,
    triangulate_boxes,
    triangulate_column,
    triangulate_polygons,
)

from topomerge.types import Array

LEAF_THICKNESS = 0.04  # m, thickness
SWING = {"shut": (0.0, 0.0), "half": (0.5, 1.1), "open": (1.4, 1.9)}  # rad
ROOMS_WITHOUT_DUCTS = ("stairs", "lift", "atrium", "bath", "hotel", "bedroom", "living", "void")  # rooms without ducts
HANDLE, HANDLE_HEIGHT = (0.12, 0.05, 0.03), 1.05  # m
CASED = 0.8  # share of the faces of doors with a frame that have a casing
TWO_LEAVES = 1.25  # m; wider doors have two leaves


def add_fittings(
    soup: TriangleSoup,
    plans: Sequence[Plan],
    spaces: list[RoomCells],
    holes: list[WallOpening],
    doors: Array,
    stairs: Array,
    difficulty: Difficulty,
    rng: np.random.Generator,
) -> Array:
    """Add all fittings and furniture; return (M,) THING_DTYPE."""
    things: list[tuple] = []
    _add_leaves(soup, things, spaces, doors, difficulty.frames, rng)
    for hole in holes:
        _add_pane(soup, hole)
    for space in spaces:
        if space.room < 0:
            continue
        _add_sloped_ceiling(soup, space)
        taken = keep_clear(space.room, doors, stairs)
        taken += _add_columns(soup, things, space, plans[space.storey], taken, difficulty, rng)
        _add_lamps_and_beams(soup, things, space, difficulty, rng)
        if difficulty.furniture > 0 or difficulty.clutter > 0:
            _add_furniture(soup, things, space, doors, taken, difficulty, rng)
    return np.array(things, THING_DTYPE)


def compute_leaf_yaw(door: Array, pivot: Array, angle: float) -> float:
    """Return the direction, rad, in which a leaf that turns about `pivot` points when it is opened by `angle`, away from its
    wall."""
    along = np.array([np.sin(door["direction"]), -np.cos(door["direction"])])
    normal = np.array([np.cos(door["direction"]), np.sin(door["direction"])])
    offset = np.asarray(pivot) - door["centre"][:2]
    end, side = np.sign(offset @ along), np.sign(offset @ normal)
    reach = -end * along * np.cos(angle) + side * normal * np.sin(angle)
    return float(np.arctan2(reach[1], reach[0]))


def _add_leaves(
    soup: TriangleSoup, things: list[tuple], spaces: list[RoomCells], doors: Array, frames: float, rng: np.random.Generator
) -> None:
    """Add one leaf a door, two for wide ones, hung so that it swings into the room and not into the corridor.

    Args:
        frames: share of the doors with a frame and handles.
    """
    kinds = {s.room: s.plan.kind for s in spaces}
    shapes = {s.room: s.shape for s in spaces if s.room >= 0}
    for d, door in enumerate(doors):
        if door["state"] == "none":
            continue
        normal = np.array([np.cos(door["direction"]), np.sin(door["direction"])])
        along = np.array([normal[1], -normal[0]])
        busy = [r < 0 or kinds[r] in ("corridor", "stairs", "lobby", "atrium") for r in door["rooms"]]
        into = door["rooms"][1] if busy[0] else door["rooms"][0]
        into = max(door["rooms"]) if into < 0 else into
        probe = door["centre"][:2] + normal * (door["thickness"] / 2 + 0.1)
        side = 1.0 if shapes[into].covers(shapely.Point(probe)) else -1.0
        ends = (-1.0, 1.0) if door["width"] > TWO_LEAVES else (float(rng.choice([-1.0, 1.0])),)
        angle = float(rng.uniform(*SWING[str(door["state"])]))
        framed = bool(frames) and rng.random() < frames
        depth = _add_door_frame(soup, door, rng) if framed else 0.0
        for end in ends:
            pivot = door["centre"][:2] + end * along * (door["width"] / 2 - 0.01)
            pivot = pivot + side * normal * (door["thickness"] / 2 - LEAF_THICKNESS / 2 - depth)
            yaw, length = compute_leaf_yaw(door, pivot, angle), door["width"] / len(ends) - 0.02
            centre = [*(pivot + length / 2 * np.array([np.cos(yaw), np.sin(yaw)])), door["centre"][2]]
            size = (length, LEAF_THICKNESS, door["height"] - 0.03)
            parts = [[0, 0, size[2] / 2 + 0.01, *size]]
            if framed:
                across = LEAF_THICKNESS / 2 + HANDLE[1] / 2
                parts += [[length / 2 - HANDLE[0], s * across, HANDLE_HEIGHT, *HANDLE] for s in (1, -1)]
            soup.add(*triangulate_boxes(np.array(parts), np.array(centre), yaw), "leaf", len(things))
            centre[2] += size[2] / 2
            things.append(("leaf", int(into), d, tuple(centre), size, yaw, tuple(pivot), True))


def _add_door_frame(soup: TriangleSoup, door: Array, rng: np.random.Generator) -> float:
    """Add a casing around a door on one face of its wall or both; return how deep the leaf stands in the wall, m."""
    wide, thick = float(rng.uniform(0.05, 0.1)), float(rng.uniform(0.008, 0.025))
    half, height, out = door["width"] / 2 + wide / 2, float(door["height"]), door["thickness"] / 2 + thick / 2
    for face in (1, -1):
        if rng.random() < CASED:
            posts = [[face * out, s * half, height / 2, thick, wide, height] for s in (1, -1)]
            head = [face * out, 0, height + wide / 2, thick, 2 * half + wide, wide]
            soup.add(*triangulate_boxes(np.array([*posts, head]), door["centre"], float(door["direction"])), "wall")
    deep = max(float(door["thickness"]) - LEAF_THICKNESS, 0.0)
    return float(rng.uniform(0, deep if rng.random() < 0.5 else min(deep, 0.05)))


def _add_pane(soup: TriangleSoup, hole: WallOpening) -> None:
    """Add glass in the middle of a window, with posts every 1.3 m."""
    if hole.opening.kind != "window":
        return
    a, b = np.array(hole.opening.start), np.array(hole.opening.end)
    low, high = hole.bottom, hole.top
    corners = np.array([[*a, low], [*b, low], [*b, high], [*a, high]])
    soup.add(corners, np.array([[0, 1, 2], [0, 2, 3]]), "glass")
    length, middle = float(np.hypot(*(b - a))), (low + high) / 2
    xs = np.linspace(0, length, max(int(length / 1.3), 1) + 1)
    posts = np.stack([xs - length / 2, 0 * xs, 0 * xs, 0 * xs + 0.06, 0 * xs + 0.06, 0 * xs + high - low], axis=1)
    rails = [[0, 0, z, length, 0.06, 0.06] for z in (low - middle + 0.03, high - middle - 0.03)]
    yaw = float(np.arctan2(b[1] - a[1], b[0] - a[0]))
    soup.add(*triangulate_boxes(np.concatenate([posts, rails]), np.array([*((a + b) / 2), middle]), yaw), "wall")


def _add_sloped_ceiling(soup: TriangleSoup, space: RoomCells) -> None:
    """Add a ceiling that falls along the room; the flat one above it is out of sight."""
    if space.plan.slope <= 0:
        return
    corners = np.asarray(shapely.minimum_rotated_rectangle(space.shape).exterior.coords)
    sides = np.diff(corners[:3], axis=0)
    lengths = np.hypot(sides[:, 0], sides[:, 1])
    k = int(np.argmax(lengths))
    triangles = triangulate_polygons(space.shape)[0].reshape(-1, 2)
    share = np.clip((triangles - corners[k]) @ sides[k] / lengths[k] ** 2, 0, 1)
    vertices = np.column_stack([triangles, space.ceiling - space.plan.slope * share])
    soup.add(vertices, np.arange(len(vertices)).reshape(-1, 3)[:, ::-1], "ceiling")


def keep_clear(room: int, doors: Array, stairs: Array) -> list[shapely.Polygon]:
    """Return where nothing may stand: before doors, and on stairs and their landings."""
    out = []
    for door in doors[(doors["rooms"] == room).any(axis=1)]:
        half = np.array([door["thickness"] / 2 + max(door["width"], 0.95) + 0.1, door["width"] / 2 + 0.1])
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
        out.append(shapely.Polygon(corners @ build_rotation(door["direction"]) + door["centre"][:2]))
    for stair in stairs[(stairs["rooms"] == room).any(axis=1)]:
        out.append(shapely.Polygon(stair["footprint"]).buffer(1.0, join_style="mitre"))
    return out


def _add_columns(
    soup: TriangleSoup,
    things: list[tuple],
    space: RoomCells,
    plan: Plan,
    taken: list[shapely.Polygon],
    difficulty: Difficulty,
    rng: np.random.Generator,
) -> list[shapely.Polygon]:
    """Add the columns of the plan, and a row of columns in large rooms."""
    given = np.zeros((0, 4)) if plan.columns is None else np.asarray(plan.columns, float).reshape(-1, 4)
    spots = [c for c in given if space.shape.contains(shapely.Point(c[:2]).buffer(c[2] / 2))]
    if not len(given) and space.shape.area > 60 and rng.random() < difficulty.columns:
        side, style = float(rng.choice([0.3, 0.4, 0.5])), float(rng.integers(2))
        low, high = np.array(space.shape.bounds).reshape(2, 2)
        grid = np.stack(np.meshgrid(*(np.arange(a + 2.5, b - 2.0, 5.0) for a, b in zip(low, high, strict=True))), -1)
        spots = [np.array([*p, side, style]) for p in grid.reshape(-1, 2)]
    out = []
    for x, y, side, style in spots:
        outline = shapely.Point(x, y).buffer(side / 2 + 0.05)
        if not space.shape.contains(outline) or any(outline.intersects(t) for t in taken):
            continue
        turn = 0.707 if style < 0.5 else 0.5
        mesh = triangulate_column(np.array([x, y]), side * turn, space.floor, space.ceiling, 4 if style < 0.5 else 12)
        soup.add(*mesh, "column", len(things))
        tall = space.ceiling - space.floor
        centre = (x, y, space.floor + tall / 2)
        things.append(("column", space.room, -1, centre, (side, side, tall), 0.0, (x, y), False))
        out.append(outline)
    return out


def _add_lamps_and_beams(
    soup: TriangleSoup, things: list[tuple], space: RoomCells, difficulty: Difficulty, rng: np.random.Generator
) -> None:
    """Add lamps below the ceiling and beams along it."""
    del things
    if space.shape.area < 4 or space.plan.slope > 0:
        return
    corners = np.asarray(shapely.minimum_rotated_rectangle(space.shape).exterior.coords)
    sides = np.diff(corners[:3], axis=0)
    sides = sides[np.argsort(-np.hypot(sides[:, 0], sides[:, 1]))]
    long, wide = np.hypot(sides[:, 0], sides[:, 1])
    yaw, middle = float(np.arctan2(sides[0, 1], sides[0, 0])), corners[:4].mean(axis=0)
    parts = []
    if rng.random() < difficulty.lamps:
        drop, kind = float(rng.choice([0.06, 0.3, 0.5])), float(rng.choice([0.3, 1.2]))
        drop = min(drop, max(space.ceiling - space.floor - 2.2, 0.06))
        ys = (np.arange(max(round(wide / 3), 1)) + 0.5) * wide / max(round(wide / 3), 1) - wide / 2
        xs = (np.arange(max(round(long / 2.4), 1)) + 0.5) * long / max(round(long / 2.4), 1) - long / 2
        parts += [[x, y, -drop, kind, 0.3, 0.07] for x in xs for y in ys]
    if rng.random() < difficulty.beams and space.ceiling - space.floor > 2.5:
        deep = min(0.3, space.ceiling - space.floor - 2.3)
        parts += [[x, 0, -deep / 2, 0.25, wide, deep] for x in np.arange(2.0, long - 1.0, 3.6) - long / 2]
    turned = [[*(np.array(p[:2]) @ build_rotation(yaw) + middle), *p[2:]] for p in parts]
    _add_ducts(soup, space, (middle, yaw, float(long), float(wide)), difficulty, rng)
    for part, at in zip(parts, turned, strict=True):
        if space.shape.buffer(0.01).contains(shapely.Point(at[:2]).buffer(min(part[3], part[4]) / 2)):
            where = np.array([at[0], at[1], space.ceiling])
            soup.add(*triangulate_boxes(np.array([[0, 0, *part[2:]]]), where, yaw), "beam")


def _add_ducts(
    soup: TriangleSoup,
    space: RoomCells,
    frame: tuple[Array, float, float, float],
    difficulty: Difficulty,
    rng: np.random.Generator,
) -> None:
    """Add air ducts, pipes and cable trays under the ceiling, along the room or across it.

    Args:
        frame: middle (2,), yaw (rad), length and width (m) of the rectangle around the room.
    """
    spare = space.ceiling - space.floor - 2.15
    if rng.random() >= difficulty.ducts or space.plan.kind in ROOMS_WITHOUT_DUCTS or spare < 0.25:
        return
    middle, yaw, long, wide = frame
    rows = rng.random() < 0.3  # panels of one make, side by side; else ducts and pipes, each by itself
    number = int(rng.integers(3, 7)) if rows else int(rng.integers(1, 4))
    sizes = rng.uniform([0.1, 0.08, 0.0], [0.7, 0.4, 1.0], (number, 3))
    sizes = np.tile([sizes[0, 0], 0.1, sizes[0, 2]], (number, 1)) if rows else sizes
    for k, (broad, high, deep) in enumerate(sizes.tolist()):
        high = min(high, spare)
        across = bool(not rows and rng.random() < 0.25)
        offset = ((k + 0.5) / number - 0.5 if rows else rng.uniform(-0.4, 0.4)) * (long if across else wide)
        reach, drop = (wide if across else long), deep * min(0.6 if rows else 0.4, spare - high)
        place = middle + (np.array([offset, 0.0]) if across else np.array([0.0, offset])) @ build_rotation(yaw)
        turn, reach = yaw + np.pi / 2 * across, max(reach - 0.02, 0.5)
        box = shapely.Polygon(compute_footprints(place[None], np.array([turn]), (reach, broad))[0]).intersection(space.shape)
        if box.area > 0.98 * reach * broad:
            at = np.array([*place, space.ceiling])
            soup.add(*triangulate_boxes(np.array([[0, 0, -drop - high / 2, reach, broad, high]]), at, turn), "beam")


def _add_furniture(
    soup: TriangleSoup,
    things: list[tuple],
    space: RoomCells,
    doors: Array,
    taken: list[shapely.Polygon],
    difficulty: Difficulty,
    rng: np.random.Generator,
) -> None:
    own = doors[(doors["rooms"] == space.room).any(axis=1)]
    floor = FurnishedFloor(shapely.orient_polygons(space.shape), list(taken), rng, space.ceiling - space.plan.slope - space.floor)
    items = furnish(floor, space.plan.kind, difficulty.furniture, difficulty.clutter, own["centre"][:, :2])
    for item in items:
        add_item(soup, things, item, space.room, space.floor)


def add_item(soup: TriangleSoup, things: list[tuple], item: Item, room: int, floor: float) -> None:
    """Put an item into a building that is being made."""
    soup.add(*triangulate_boxes(item.parts, np.array([*item.at, floor]), item.yaw), SURFACES.index(item.label), len(things))
    centre = (*item.at, floor + item.size[2] / 2)
    things.append((item.kind, room, -1, centre, item.size, item.yaw, tuple(item.at), item.movable))
