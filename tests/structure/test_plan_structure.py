"""Walls, openings and outlines: known buildings to 3 cm, moved and turned maps, and maps without walls."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import shapely

import topomerge
from tests.cases import list_longer
from tests.edits.recipes import corridor_map
from tests.io.export_maps import flat, nothing, stair_scene, two_floors
from tests.scenes import HEIGHT, THICK, Scene, corridor, rectangle, two_rooms
from topomerge.structure.plan_structure import PlanStructure, build_plan_structure
from topomerge.structure.walls import build_wall_polygon
from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, STOREY_DTYPE, WINDOW_DTYPE, TopometricMap, VoxelGrid

OFF = np.array([0.013, 0.017])  # by which scenes are moved off the lattice
NEAR = 0.03  # m


def structure(scene: Scene, turn: float = 0.0, noise: float = 0.0) -> PlanStructure:
    c, s = np.cos(turn), np.sin(turn)
    points = scene.points(noise) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return build_plan_structure(topomerge.extract(points.astype(np.float32)))


def expected(*corners: tuple[float, float], turn: float = 0.0) -> shapely.Polygon:
    return shapely.affinity.rotate(shapely.Polygon(np.array(corners) + OFF), np.degrees(turn), origin=(0, 0))


def box(x0: float, y0: float, x1: float, y1: float, turn: float = 0.0) -> shapely.Polygon:
    return expected((x0, y0), (x1, y0), (x1, y1), (x0, y1), turn=turn)


def is_room(outline: shapely.MultiPolygon, polygon: shapely.Polygon) -> bool:
    """The same corners, each within 3 cm."""
    (part,) = outline.geoms
    same = len(part.exterior.coords) == len(polygon.exterior.coords) and not part.interiors
    return same and part.hausdorff_distance(polygon) < NEAR


@pytest.mark.longer
@pytest.mark.parametrize("turn", [0.0, np.radians(30), np.radians(45), 1.2])
@pytest.mark.parametrize("noise", [0.0, 0.015])
def test_a_room_whose_walls_are_seen_from_inside(turn, noise):
    plan = structure(Scene().shell(0, 0, 5, 4), turn, noise)
    (outline,) = plan.rooms
    assert is_room(outline, box(0, 0, 5, 4, turn))
    assert len(plan.walls) == 4 and (plan.walls["faces"] == 1).all() and (plan.walls["rooms"] == (0, -1)).all()
    for wall in plan.walls:
        assert (
            build_wall_polygon(wall).intersection(outline).area < NEAR * 5 and build_wall_polygon(wall).distance(outline) < NEAR
        )
        assert [wall["low"], wall["high"]] == pytest.approx([0.02, HEIGHT], abs=0.1)
    ring = shapely.union_all([build_wall_polygon(wall) for wall in plan.walls])
    assert len(ring.interiors) == 1, "walls meet at the corners"


@pytest.mark.parametrize("turn", [np.radians(30), *list_longer(0.0)])
def test_two_rooms_share_a_wall_with_a_door(turn):
    scene = Scene().shell(0, 0, 7, 5).wall((4, 0), (4, 5), doors=(2.0,), thick=0.2)
    plan = structure(scene, turn)
    rooms = sorted(plan.rooms, key=lambda room: room.area)
    assert is_room(rooms[0], box(4.1, 0, 7, 5, turn)) and is_room(rooms[1], box(0, 0, 3.9, 5, turn))
    (shared,) = plan.walls[plan.walls["faces"] == 2]
    assert shared["thickness"] == pytest.approx(0.2, abs=0.02) and sorted(shared["rooms"]) == [0, 1]
    assert build_wall_polygon(shared).intersection(box(3.9, 0, 4.1, 5, turn)).area == pytest.approx(1.0, abs=0.1)
    assert all(room.distance(build_wall_polygon(shared)) < 0.005 for room in rooms), "a room ends at the face"
    (opening,) = plan.openings
    assert plan.walls[opening["wall"]] == shared and opening["kind"] == "door"
    door = shapely.affinity.rotate(shapely.Point(np.array([4.0, 2.0]) + OFF), np.degrees(turn), origin=(0, 0))
    assert shapely.Point(opening["centre"][:2]).distance(door) < 0.1
    line = shapely.LineString([shared["start"], shared["end"]])
    assert line.distance(shapely.Point(opening["centre"][:2])) < 1e-6, "in the middle of its wall"
    assert opening["width"] == pytest.approx(0.9, abs=0.2) and opening["height"] == pytest.approx(2.05, abs=0.15)
    left = np.array([-(line.coords[1][1] - line.coords[0][1]), line.coords[1][0] - line.coords[0][0]]) / line.length
    beside = shapely.Point(np.asarray(line.interpolate(0.5, normalized=True).coords[0]) + 0.5 * left)
    assert plan.rooms[shared["rooms"][0]].contains(beside), "the first room is to the left"


def angle_scene() -> Scene:
    corners = [(0, 0), (6, 0), (6, 3), (3, 3), (3, 6), (0, 6)]
    scene = Scene()
    for z in (0.0, HEIGHT):
        scene.floor(0, 0, 6, 3, z).floor(0, 3, 3, 6, z)
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        scene.parts.append(rectangle((*a, 0), (b[0] - a[0], b[1] - a[1], 0), (0, 0, HEIGHT)))
    return scene


@pytest.mark.parametrize("turn", [np.radians(30), *list_longer(0.0)])
def test_an_angle_whose_walls_have_one_face(turn):
    plan = structure(angle_scene(), turn)
    (outline,) = plan.rooms
    assert is_room(outline, expected((0, 0), (6, 0), (6, 3), (3, 3), (3, 6), (0, 6), turn=turn))
    assert len(plan.walls) == 6 and (plan.walls["faces"] == 1).all()


def test_a_pillar_is_no_wall():
    plan = structure(Scene().shell(0, 0, 6, 5).box(2.0, 2.0, 0.0, 2.4, 2.4, HEIGHT))
    assert is_room(plan.rooms[0], box(0, 0, 6, 5)) and len(plan.walls) == 4


@pytest.mark.longer
def test_a_round_wall_is_several_straight_ones():
    turns = np.arange(0, 2 * np.pi, 0.04 / 3)
    ring = 3 * np.column_stack([np.cos(turns), np.sin(turns)])
    scene = Scene()
    scene.parts += [np.column_stack([ring, np.full(len(ring), z)]) for z in np.arange(0, HEIGHT, 0.04)]
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(-3, 3, 0.04)] * 2))
    disc = np.column_stack([x, y])[np.hypot(x, y) < 3]
    scene.parts += [np.column_stack([disc, np.full(len(disc), z)]) for z in (0.0, HEIGHT)]
    plan = structure(scene)
    circle = shapely.Point(OFF).buffer(3)
    assert plan.rooms[0].symmetric_difference(circle).area < 0.05 * circle.area
    around = circle.exterior.buffer(0.1).union(shapely.Point(OFF).buffer(3.3).difference(circle))  # how thick it is is a guess
    assert len(plan.walls) >= 8
    length = shapely.length([shapely.LineString([w["start"], w["end"]]) for w in plan.walls]).sum()
    assert length > 0.8 * 2 * np.pi * 3
    assert all(build_wall_polygon(wall).difference(around).area < 0.1 * build_wall_polygon(wall).area for wall in plan.walls)


def same(a: PlanStructure, b: PlanStructure, moved) -> None:
    """Is the second the first one, moved?"""
    assert len(a.walls) == len(b.walls) and len(a.openings) == len(b.openings)
    walls = [shapely.transform(build_wall_polygon(wall), moved) for wall in a.walls]
    others = shapely.STRtree([build_wall_polygon(wall) for wall in b.walls])
    for wall, shape in zip(a.walls, walls, strict=True):
        near = others.geometries[others.nearest(shape.centroid)]
        twin = max(others.geometries, key=lambda other: other.intersection(shape).area, default=near)
        assert twin.intersection(shape).area > 0.9 * twin.union(shape).area, wall
    for mine, other in zip(a.rooms, b.rooms, strict=True):
        assert shapely.transform(mine, moved).symmetric_difference(other).area < 0.01 * other.area


@pytest.mark.longer
def test_a_moved_map_has_the_same_walls_moved():
    map = topomerge.extract(corridor().points())
    shift = np.array([432100.0, 5812300.0, 40.0])
    rooms, edges, storeys = map.rooms.copy(), map.edges.copy(), map.storeys.copy()
    for name in ("centroid", "lo", "hi"):
        rooms[name] += shift
    for name in ("centre", "lower", "upper"):
        edges[name] += shift
    for name in ("floor", "ceiling"):
        storeys[name] += shift[2]
    grids = {name: replace(getattr(map, name), origin=getattr(map, name).origin + shift) for name in ("grid", "navigable")}
    same(
        build_plan_structure(map),
        build_plan_structure(replace(map, rooms=rooms, edges=edges, storeys=storeys, **grids)),
        lambda p: p + shift[:2],
    )


def quarter(grid: VoxelGrid) -> tuple[VoxelGrid, np.ndarray]:
    """A grid turned by a quarter about the vertical, and the old row of each new cell."""
    x, y, z = grid.cells.T
    cells = np.column_stack([grid.shape[1] - 1 - y, x, z])
    properties = {"row": np.arange(len(grid))}
    if "offset" in grid.properties:
        a, b, c = grid.properties["offset"].T
        properties["offset"] = np.column_stack([255 - b, a, c])
    origin = np.array([-grid.origin[1] - grid.shape[1] * grid.edge, *grid.origin[[0, 2]]])
    turned = VoxelGrid.from_cells(cells, origin, grid.edge, (grid.shape[1], grid.shape[0], grid.shape[2]), properties)
    return turned, turned.properties["row"]


@pytest.mark.longer
def test_a_turned_map_has_the_same_walls_turned():
    map = corridor_map()
    grid, rows = quarter(map.grid)
    navigable, walked = quarter(map.navigable)
    rooms, edges = map.rooms.copy(), map.edges.copy()
    edges["direction"] = (edges["direction"] + np.pi / 2) % np.pi
    for table, names in ((rooms, ("centroid", "lo", "hi")), (edges, ("centre", "lower", "upper"))):
        for name in names:
            table[name] = table[name][:, [1, 0, 2]] * (-1, 1, 1)
    tables = {"rooms": rooms, "edges": edges, "room": map.room[rows], "navigable_room": map.navigable_room[walked]}
    areas = {"navigable_area": map.navigable_area[walked]}
    turned = replace(map, grid=grid, navigable=navigable, **tables, **areas)
    same(build_plan_structure(map), build_plan_structure(turned), lambda p: p[:, ::-1] * (-1, 1))


@pytest.mark.longer
def test_storeys_have_walls_of_their_own():
    plan = build_plan_structure(topomerge.extract(stair_scene().points()))
    for storey, floor in enumerate((0.0, 3.0)):
        walls = plan.walls[plan.walls["storey"] == storey]
        assert len(walls) >= 7 and walls["low"] == pytest.approx(floor, abs=0.15)
        assert (walls["faces"] == 2).sum() == 1


def test_a_neighbours_face_is_not_taken_for_ones_own():
    """The second room's side of the wall between is hidden: the room ends as far before the other side as walls are thick."""
    scene = Scene().shell(0, 0, 7, 5).wall((4, 0), (4, 5), doors=(2.0,))
    points = scene.points()
    hidden = (np.abs(points[:, 0] - 4 - THICK / 2 - OFF[0]) < 0.01) & (points[:, 1] > 2.6) & (points[:, 1] < 4.9)
    plan = build_plan_structure(topomerge.extract(points[~hidden]))
    right = min(plan.rooms, key=lambda room: room.area)
    assert right.symmetric_difference(box(4 + THICK / 2, 0, 7, 5)).area < 0.4
    left = max(plan.rooms, key=lambda room: room.area)
    assert is_room(left, box(0, 0, 4 - THICK / 2, 5))


@pytest.mark.longer
def test_openings_lie_in_walls_that_part_their_rooms():
    map = topomerge.extract(corridor().points())
    plan = build_plan_structure(map)
    assert len(plan.openings) == 8 and (plan.openings["wall"] >= 0).all()
    for opening in plan.openings:
        wall = plan.walls[opening["wall"]]
        assert sorted(wall["rooms"]) == sorted(map.edges["rooms"][opening["edge"]])
        assert build_wall_polygon(wall, opening).difference(build_wall_polygon(wall).buffer(1e-6)).is_empty


def test_without_means_of_points_outlines_are_floors():
    map = two_floors()
    plan = build_plan_structure(map)
    assert (plan.walls["faces"] == 2).sum() == 4 and (plan.openings["wall"] >= 0).all()
    assert plan.walls["thickness"][plan.walls["faces"] == 2] == pytest.approx(0.1, abs=0.05)


def test_maps_without_walls():
    assert len(build_plan_structure(nothing()).walls) == len(build_plan_structure(nothing()).openings) == 0
    bare = flat(np.ones((40, 50), bool))
    plan = build_plan_structure(bare)
    assert len(plan.walls) == 0 and plan.rooms[0].area == pytest.approx(20.0)


@pytest.mark.parametrize("seed", [0, *list_longer(*range(1, 8))])
def test_noise_gives_valid_walls_and_rooms(seed):
    rng = np.random.default_rng(seed)
    side = int(rng.integers(8, 40))
    floor = np.argwhere(rng.random((side, side)) < rng.choice([0.2, 0.6, 0.95]))
    solid = rng.random((side, side, 25)) < rng.choice([0.02, 0.3])
    solid[:, side // 2] = solid[side // 3] = True
    cells = np.argwhere(solid)
    grid = VoxelGrid.from_cells(cells, properties={"offset": rng.integers(0, 256, (len(cells), 3)).astype(np.uint8)})
    navigable = VoxelGrid.from_cells(np.column_stack([floor, np.ones(len(floor), int)]))
    rooms = np.zeros(3, ROOM_DTYPE)
    rooms["area"], rooms["height"], rooms["hi"] = 1.0, 2.4, (side / 10, side / 10, 2.5)
    edges = np.zeros(2, EDGE_DTYPE)
    edges["rooms"], edges["kind"], edges["centre"] = [(0, 1), (1, 2)], "door", rng.random((2, 3)) * side / 10
    edges["width"], edges["direction"] = 2 * rng.random(2), 3 * rng.random(2)
    labels = rng.integers(-1, 3, len(grid)).astype(np.int32), rng.integers(0, 3, len(navigable)).astype(np.int32)
    storey = np.array([(0.1, 2.5, 1.0)], STOREY_DTYPE)
    plan = build_plan_structure(TopometricMap(grid, labels[0], navigable, labels[1], rooms, edges, storey))
    assert all(room.is_valid for room in plan.rooms) and len(plan.openings) == 2
    assert all(a.intersection(b).area < 1e-6 for a, b in combinations(plan.rooms, 2))
    assert (plan.walls["high"] > plan.walls["low"]).all() and (plan.walls["thickness"] > 0).all()
    assert (np.hypot(*(plan.walls["end"] - plan.walls["start"]).T) > 0.02).all()


@pytest.mark.longer
def test_a_storey_without_rooms():
    map = topomerge.extract(stair_scene().points())
    below = map.rooms["storey"] == 0
    number = np.append(np.where(below, np.cumsum(below) - 1, -1), -1).astype(np.int32)
    kept_edges = map.edges[below[map.edges["rooms"]].all(axis=1)].copy()
    kept_edges["rooms"] = number[kept_edges["rooms"]]
    no_areas = {"areas": map.areas[:0], "navigable_area": None, "narrows": map.narrows[:0]}
    labels = {"room": number[map.room], "navigable_room": number[map.navigable_room]}
    half: TopometricMap = replace(map, rooms=map.rooms[below], edges=kept_edges, **labels, **no_areas)
    assert half.rooms.dtype == ROOM_DTYPE and len(half.storeys) == 2
    plan = build_plan_structure(half)
    assert (plan.walls["storey"] == 0).all() and len(plan.walls)


def test_two_rooms_are_apart_and_valid():
    plan = structure(two_rooms(), noise=0.02)
    assert all(room.is_valid and not room.is_empty for room in plan.rooms)
    assert plan.rooms[0].intersection(plan.rooms[1]).area == 0


def test_windows_below_the_floor_are_drawn_above_it() -> None:
    """A map whose windows end below the floor: a pane of less than no height is no solid."""
    map = topomerge.extract(two_rooms().points(0.0).astype(np.float32))
    windows = np.zeros(4, WINDOW_DTYPE)
    windows["rooms"], windows["centre"], windows["width"] = (0, -1), map.rooms["centroid"][0], 1.0
    windows["sill"], windows["head"] = [-3.0, np.nan, -0.5, 0.9], [-2.0, -2.0, np.nan, 1.1]
    panes = build_plan_structure(replace(map, windows=windows)).windows
    assert (panes["sill"] >= 0).all() and (panes["head"] > panes["sill"]).all()
    assert panes["sill"][3] == pytest.approx(0.9) and panes["head"][3] == pytest.approx(1.1)  # what was seen stays
