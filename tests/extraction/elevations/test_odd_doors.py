"""Doors that are unlike others, and what is like a door and none: niches, double and sliding doors, walls of few points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.cases import list_longer
from tests.extraction.elevations.doors import (
    AJAR_DOOR,
    SHUT_DOOR,
    ajar_door,
    double_door,
    extracted,
    niche,
    sliding_door,
    three_doors,
)
from tests.scenes import Scene
from topomerge.extraction.elevations.doorways import classify_places, compute_door_probabilities, detect_doorways
from topomerge.extraction.elevations.elevation import BANDS, DEPTHS, FACE_DTYPE, STRIP_CHANNELS, Elevations
from topomerge.extraction.extract import extract, gather_evidence, read_navigable
from topomerge.extraction.parameters import PRESETS
from topomerge.progress import Stopwatch
from topomerge.types import classify_door_state


@pytest.mark.parametrize(
    ("depth", "width", "bottom", "top", "behind"),
    [
        (0.2, 0.9, 0.0, 2.05, 0.15),
        *list_longer((0.1, 0.6, 1.0, 1.6, 0.15), (0.2, 0.6, 1.0, 1.6, 0.1), (0.3, 0.9, 0.9, 2.05, 0.1)),
    ],
    ids=["of a door's size", "shallow", "shelf", "deep"],
)
def test_a_niche_is_no_door(depth: float, width: float, bottom: float, top: float, behind: float):
    map = extracted(niche(depth, width, bottom, top, behind).points(0.003))
    (door,) = map.edges
    assert len(map.rooms) == 2 and door["open"] and door["centre"][:2] == pytest.approx([4, 4], abs=0.15)


@pytest.mark.parametrize("depth", [0.2, *list_longer(0.1, 0.3)])
def test_a_niche_in_an_outer_wall_leads_nowhere(depth: float):
    scene = Scene().shell(0, 0, 5, 4)
    scene.parts = [p[~((p[:, 0] > 5 - 1e-6) & (np.abs(p[:, 1] - 2) < 0.45) & (p[:, 2] < 2.05))] for p in scene.parts]
    scene.box(5, 1.55, 0, 5 + depth, 2.45, 2.05)
    scene.parts[-2] = scene.parts[-2][:0]  # the side towards the room
    map = extract(scene.points(0.003))
    assert len(map.rooms) == 1 and not len(map.edges)


@pytest.mark.parametrize(("width", "is_open"), [(1.8, True), *list_longer((1.8, False), (2.0, True), (1.6, False), (2.0, False))])
def test_a_double_door_is_one_door_as_wide(width: float, is_open: bool):
    map = extracted(double_door(width, is_open).points(0.003))
    (door,) = map.edges
    assert len(map.rooms) == 2 and bool(door["open"]) == is_open
    assert door["centre"][:2] == pytest.approx([3.5, 5], abs=0.1) and door["width"] == pytest.approx(width, abs=0.15)


@pytest.mark.parametrize("cover", [0.3, *list_longer(0.45)])
def test_a_sliding_door_that_stands_half_open_is_one_open_door(cover: float):
    (door,) = extracted(sliding_door(cover).points(0.003)).edges
    assert door["open"] and door["kind"] == "door"
    assert door["centre"][:2] == pytest.approx([4, 2], abs=0.15) and door["width"] == pytest.approx(0.9, abs=0.15)


@pytest.mark.parametrize("angle", [0.8, *list_longer(0.5, 1.1)])
def test_a_leaf_that_stands_half_open_is_told_from_one_that_is_shut_or_wide_open(angle: float):
    map = extracted(ajar_door(angle).points(0.003))
    shut, ajar, wide = (map.edges[int(np.abs(map.edges["centre"][:, 1] - y).argmin())] for y in (SHUT_DOOR, AJAR_DOOR, 7.0))
    assert len(map.edges) == 3 and [classify_door_state(door) for door in (shut, ajar, wide)] == ["shut", "half open", "open"]


@pytest.mark.parametrize("side", [-1, *list_longer(1)])
def test_a_shut_door_that_was_seen_from_one_side_only(side: int):
    """The wall was not seen from the other room: neither its face nor that of the leaf has points there."""
    points = three_doors().points(0.003)
    unseen = (side * (points[:, 0] - 4.013) > 0) & (np.abs(points[:, 0] - 4) < 0.2) & (np.abs(points[:, 1] - SHUT_DOOR) < 1.5)
    map = extract(points[~unseen | (points[:, 2] < 0.1) | (points[:, 2] > 2.6)])
    shut, opened = map.edges[np.argsort(map.edges["centre"][:, 1])]
    assert not shut["open"] and opened["open"] and shut["rooms"].tolist() == [0, 1]
    assert shut["centre"][:2] == pytest.approx([4, SHUT_DOOR], abs=0.2) and shut["width"] == pytest.approx(0.9, abs=0.15)


def floors(*walls: np.ndarray) -> np.ndarray:
    """Floor and ceiling of 5 x 4 m with some points of walls."""
    scene = Scene().floor(0, 0, 5, 4).floor(0, 0, 5, 4, 2.7)
    scene.parts += walls
    return scene.points()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", [1, *list_longer(2, 30)])
def test_walls_of_hardly_any_points_have_no_doors(count: int):
    few = np.random.default_rng(count).uniform((2.5, 0, 0.3), (2.5, 4, 2.2), (count, 3))
    map = extract(floors(few))
    assert len(map.rooms) == 1 and not len(map.edges)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", [0, *list_longer(1, 5)])
def test_elevations_of_hardly_any_points_show_no_doorways(count: int):
    """The walls stand, but of what is looked at closely hardly a point is left."""
    scan, navigable = read_navigable(three_doors().points(), 0.1, PRESETS["default"], Stopwatch())
    assert scan.fine is not None
    cells = scan.fine.select_cells(np.arange(len(scan.fine)) < count)
    seen = gather_evidence(replace(scan, fine=cells), navigable, PRESETS["default"], Stopwatch()).walls
    assert seen is not None and not len(seen.doorways)
    walls = seen.elevations
    assert len(walls.faces) and not len(detect_doorways(walls, compute_door_probabilities(walls, classify_places(walls))))


def test_a_wall_as_short_as_one_place_shows_no_doorway():
    face = np.array([(0, (0, 0), (1, 0), (0, 1), 0.1, 0.0)], FACE_DTYPE)
    strips = np.zeros((2, DEPTHS, STRIP_CHANNELS), np.float32)
    strips[0, DEPTHS // 2, BANDS // 2] = 1
    walls = Elevations(face, np.array([0, 2]), strips)
    classes = classify_places(walls)
    assert classes.shape == (1, 7) and not len(detect_doorways(walls, compute_door_probabilities(walls, classes)))
