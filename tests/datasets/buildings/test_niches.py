"""Recesses in walls: cut out of the wall alone, and labelled where a wall's own face shows them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.buildings.openings import BEHIND_NICHE, CORNER, NICHE_DEPTHS
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.pairs.wall_examples import compute_true_classes

from tests.datasets.boxes import BARE, two_rooms
from topomerge.extraction.elevations.elevation import ALONG, DEPTHS, FACE_DTYPE, STRIP_CHANNELS, WALL_CLASSES, Elevations
from topomerge.types import Sim3

MANY = replace(BARE, niches=1.0)


def walls_at(*faces: tuple[object, ...]) -> Elevations:
    """Faces as of FACE_DTYPE, with empty strips."""
    table = np.array(list(faces), FACE_DTYPE)
    sizes = np.rint(table["length"] / ALONG).astype(int)
    return Elevations(table, np.concatenate([[0], np.cumsum(sizes)]), np.zeros((sizes.sum(), DEPTHS, STRIP_CHANNELS), np.float32))


def test_without_niches_buildings_stay_what_they_were():
    one, same = build_building([two_rooms()], BARE, 3), build_building([two_rooms()], replace(BARE, niches=0.0), 3)
    assert one.vertices.tobytes() == same.vertices.tobytes() and not len(one.niches)


@pytest.mark.parametrize("seed", range(4))
def test_niches_lie_in_walls_and_leave_something_behind(seed):
    building = build_building([two_rooms()], MANY, seed)
    assert len(building.niches) >= 2
    rooms = shapely.union_all([shapely.Polygon(r.polygon) for r in building.rooms])
    for niche in building.niches:
        out = np.array([np.cos(niche["direction"]), np.sin(niche["direction"])])
        along = np.array([-out[1], out[0]])
        half = [niche["depth"] / 2 * out, niche["width"] / 2 * along]
        corners = [niche["centre"][:2] + i * half[0] + j * half[1] for i, j in ((-1, -1), (-1, 1), (1, 1), (1, -1))]
        box = shapely.Polygon(corners)
        assert NICHE_DEPTHS[0] <= niche["depth"] <= NICHE_DEPTHS[1] and niche["top"] <= 2.7 - CORNER + 1e-9
        assert box.intersection(rooms).area < 1e-6
        deeper = shapely.Polygon([*corners[:2], *(c + 0.99 * BEHIND_NICHE * out for c in corners[2:])])
        assert deeper.intersection(rooms).area < 1e-6
        face = niche["centre"] + [*(niche["depth"] / 2 * out), (niche["bottom"] + niche["top"]) / 2]
        assert np.abs(building.vertices[:, :2] - corners[2]).max(axis=1).min() < 0.002  # its back is modelled
        assert niche["bottom"] < face[2] < niche["top"]


@pytest.mark.longer
def test_the_same_seed_gives_the_same_niches_and_every_room_stays_reachable():
    one, same = (make_building("office", 7, 1, MANY) for _ in range(2))
    assert one.niches.tobytes() == same.niches.tobytes() and len(one.niches) > 20


def test_a_niche_is_labelled_on_its_own_face_alone():
    building = build_building([two_rooms()], MANY, 0)
    niche = building.niches[0]
    out = np.array([np.cos(niche["direction"]), np.sin(niche["direction"])])
    along, before = np.array([-out[1], out[0]]), niche["centre"][:2] - niche["depth"] / 2 * out
    start = before - 2 * along
    own = (0, start, along, out, 4.0, 0.0)
    behind = (1, start + (niche["depth"] + 0.06) * out, along, -out, 4.0, 0.0)
    truth = compute_true_classes(building, walls_at(own, behind), Sim3(), None)
    at = np.flatnonzero(truth[:80] == WALL_CLASSES.index("niche")) * ALONG
    assert at.mean() + ALONG / 2 == pytest.approx(2.0, abs=ALONG) and np.ptp(at) + ALONG == pytest.approx(niche["width"], abs=0.1)
    assert not (truth[80:] == WALL_CLASSES.index("niche")).any()


@pytest.mark.parametrize(("state", "name"), [("open", "open"), ("half", "half"), ("shut", "shut")])
def test_doors_are_labelled_by_how_they_stand(state, name):
    building = build_building([two_rooms(state=state)], BARE, 0)
    truth = compute_true_classes(building, walls_at((0, (4.0, 0.5), (0, 1), (1, 0), 4.0, 0.0)), Sim3(), None)
    there = np.flatnonzero(truth == WALL_CLASSES.index(name)) * ALONG + 0.5
    assert there.min() == pytest.approx(2.0, abs=ALONG) and there.max() == pytest.approx(2.9, abs=2 * ALONG)
    assert set(truth.tolist()) == {0, WALL_CLASSES.index(name)}


def test_a_cupboard_is_labelled_in_its_own_room_and_not_behind_the_wall():
    building = make_building("office", 3, 1, replace(BARE, furniture=2.0))
    tall = building.things[
        np.isin(building.things["kind"], ["shelf", "cabinet", "wardrobe"]) & (building.things["size"][:, 2] > 1)
    ]
    thing = tall[0]
    out = np.array([-np.sin(thing["yaw"]), np.cos(thing["yaw"])])  # its back is to the wall
    along = np.array([np.cos(thing["yaw"]), np.sin(thing["yaw"])])
    back = thing["centre"][:2] + (thing["size"][1] / 2 + 0.03) * out
    own = (0, back - 2 * along, along, out, 4.0, 0.0)
    beyond = (1, back + 0.12 * out - 2 * along, along, -out, 4.0, 0.0)
    truth = compute_true_classes(building, walls_at(own, beyond), Sim3(), None)
    middle = slice(36, 44)
    assert (truth[:80][middle] == WALL_CLASSES.index("cupboard")).all()
    assert not (truth[80:][middle] == WALL_CLASSES.index("cupboard")).any()
