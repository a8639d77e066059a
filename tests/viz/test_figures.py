"""Plans: what stands where, and that any map can be drawn."""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.scenes_map import building
from topomerge.errors import InputError
from topomerge.io.listing import format_map
from topomerge.io.rooms_ply import assign_colour_numbers, assign_room_colours, find_adjacent_rooms
from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, STOREY_DTYPE, TopometricMap, VoxelGrid
from topomerge.viz.figures import plot_plan, save_figure
from topomerge.viz.plan import compute_frame, find_label_places, rasterize_storeys


def without_rooms(map: TopometricMap) -> TopometricMap:
    none = np.full(len(map.grid), -1, np.int32)
    tables = {name: np.zeros(0, d) for name, d in (("rooms", ROOM_DTYPE), ("edges", EDGE_DTYPE), ("storeys", STOREY_DTYPE))}
    return replace(map, room=none, navigable_room=np.full(len(map.navigable), -1, np.int32), **tables)


@pytest.mark.parametrize("storeys", [1, 2, 5])
def test_one_panel_a_storey_at_one_scale(storeys: int) -> None:
    figure = plot_plan(building(2, storeys))
    assert len(figure.axes) == storeys
    scales = set()
    for ax in figure.axes:
        box = ax.get_position()
        across, down = figure.get_size_inches() * (box.width, box.height)
        (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
        scales |= {round(across / (x1 - x0), 6), round(down / (y1 - y0), 6)}
    assert len(scales) == 1


def test_title_and_legend_tell_what_is_drawn() -> None:
    figure = plot_plan(building(2, 2))
    words = [text.get_text() for text in figure.texts]
    assert "building.ply: 10 rooms, 2 storeys" in words
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["door", "opening", "stairs", "wall", "no room"]


def test_a_joined_map_has_the_names_of_all_its_files() -> None:
    scene = replace(building(2, 2), source="house/a.tmap + other house/b.ply + ")
    assert scene.title == "a.tmap + b.ply + map"
    assert "a.tmap + b.ply + map: 10 rooms, 2 storeys" in [text.get_text() for text in plot_plan(scene).texts]


def test_ramps_are_drawn_and_listed_as_ramps() -> None:
    scene = building(2, 2)
    edges = scene.edges.copy()
    edges["kind"][edges["kind"] == "stairs"] = "ramp"
    sloped = replace(scene, edges=edges)
    legend = [text.get_text() for text in plot_plan(sloped).legends[0].get_texts()]
    assert legend == ["door", "opening", "ramp", "wall", "no room"]
    text = format_map(sloped)
    assert " 0 stairs, 1 ramp;" in text and "(ramp)" in text and "(stairs)" not in text


def test_every_room_has_its_number_inside_it() -> None:
    scene = building(3, 2)
    frame = compute_frame(scene)
    for storey, plan in enumerate(rasterize_storeys(scene, frame)):
        place_of_room = find_label_places(plan, frame)
        assert sorted(place_of_room) == np.flatnonzero(scene.rooms["storey"] == storey).tolist()
        for room, place in place_of_room.items():
            i, j = ((np.array([place.x, place.y]) - frame.low) / frame.size).astype(int)
            assert plan.room[i, j] == room and not plan.wall[i, j]
    texts = [text.get_text() for ax in plot_plan(scene).axes for text in ax.texts]
    assert [t for t in texts if t.isdigit()] == [str(i) for i in range(len(scene.rooms))]


def test_walls_are_cut_and_doors_are_open() -> None:
    scene = building(1, 2)
    frame = compute_frame(scene)
    for storey, plan in enumerate(rasterize_storeys(scene, frame)):
        assert plan.wall[0].all() and plan.wall[:, 0].all()
        for edge in scene.edges[(scene.rooms["storey"][scene.edges["rooms"]] == storey).all(axis=1)]:
            i, j = ((edge["centre"][:2] - frame.low) / frame.size).astype(int)
            assert not plan.wall[i, j]


def test_rooms_side_by_side_differ() -> None:
    scene = building(6, 3)
    pairs = find_adjacent_rooms(scene)
    assert {(0, 2), (0, 12), (12, 25)} <= {tuple(pair) for pair in pairs.tolist()}
    colours = assign_room_colours(scene)
    assert (colours[pairs[:, 0]] != colours[pairs[:, 1]]).any(axis=1).all()


def test_colours_of_a_dense_graph() -> None:
    pairs = np.array([(a, b) for a in range(14) for b in range(a)])
    assert len(set(assign_colour_numbers(14, pairs).tolist())) == 14
    assert len(assign_colour_numbers(40, np.array([(a, b) for a in range(40) for b in range(a)]))) == 40
    assert len(assign_colour_numbers(0, np.zeros((0, 2), int))) == 0


@pytest.mark.parametrize("joins", [0, 30, 120, 400])
def test_the_most_constrained_room_is_next(joins: int) -> None:
    """Against a search through all rooms that are left, in every step."""
    rng = np.random.default_rng(joins)
    pairs = np.unique(np.sort(rng.integers(0, 60, (joins, 2)), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    near = [set(pairs[pairs[:, 1] == i, 0].tolist()) | set(pairs[pairs[:, 0] == i, 1].tolist()) for i in range(60)]
    numbers: dict[int, int] = {}
    while len(numbers) < 60:
        taken = [{numbers[j] for j in near[i] if j in numbers} for i in range(60)]
        room = min(set(range(60)) - set(numbers), key=lambda i: (-len(taken[i]), -len(near[i]), i))
        free = [c for c in range(8) if c not in taken[room]] or [c for c in range(16) if c not in taken[room]] or list(range(16))
        counts = Counter(numbers.values())
        numbers[room] = min(free, key=lambda c: (counts[c], c))
    assert assign_colour_numbers(60, pairs).tolist() == [numbers[i] for i in range(60)]


@pytest.mark.longer
def test_same_map_same_file(tmp_path: Path) -> None:
    for name in ("a.png", "a.svg", "a.pdf"):
        save_figure(building(1, 1), tmp_path / name)
        save_figure(building(1, 1), tmp_path / f"again_{name}")
        assert (tmp_path / name).read_bytes() == (tmp_path / f"again_{name}").read_bytes()
    image = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"))
    assert min(image.shape[:2]) > 500 and len(np.unique(image.reshape(-1, 3), axis=0)) > 5


def test_maps_with_little_in_them(tmp_path: Path) -> None:
    save_figure(without_rooms(building(1, 1)), tmp_path / "walls.png")
    grid = VoxelGrid.from_cells(np.zeros((0, 3), np.int32))
    none = np.zeros(0, np.int32)
    cells = {"room": none, "navigable_room": none, "navigable_area": none}
    empty = without_rooms(replace(building(1, 1), grid=grid, navigable=grid, **cells))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ("$x^2$", "房间"):
            save_figure(replace(empty, source=name), tmp_path / "empty.png")
    assert len(list(tmp_path.iterdir())) == 2


def test_far_apart_cells_are_drawn_together() -> None:
    cells = np.array([[0, 0, 0], [200_000, 5, 3]])
    grid = VoxelGrid.from_cells(cells)
    scene = without_rooms(replace(building(1, 1), grid=grid, room=np.full(2, -1, np.int32)))
    assert max(compute_frame(scene).shape) <= 1500


def test_unknown_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="can't be written"):
        save_figure(building(1, 1), tmp_path / "absent" / "a.png")
