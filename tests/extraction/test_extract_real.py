"""Extraction of real maps: nothing that a glance at the picture would contradict."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.real_models import duplex, duplex_map
from topomerge.extraction.extract import extract
from topomerge.io.points import read_chunks
from topomerge.types import TopometricMap

pytestmark = pytest.mark.data


@pytest.fixture(scope="module")
def lab(data_dir: Path) -> TopometricMap:
    """IPA's own lab: a hexagonal hall, corridors and rooms: ten in the set's own segmentation."""
    return extract(read_chunks(data_dir / "grids_ipa_room_segmentation" / "lab_ipa.png", resolution=0.05))


def test_a_robot_grid(lab: TopometricMap) -> None:
    assert 9 <= len(lab.rooms) <= 12 and len(lab.storeys) == 1
    assert lab.rooms["area"].sum() == pytest.approx(300, rel=0.15)
    reached = {0}
    for _ in lab.edges:
        reached |= {int(r) for e in lab.edges for r in e["rooms"] if reached & set(e["rooms"].tolist())}
    assert len(reached) == len(lab.rooms)


def test_no_corner_of_a_robot_grid_is_a_room(lab: TopometricMap) -> None:
    assert 9 <= (lab.rooms["area"] > 5).sum() <= 10 and 9 <= len(lab.rooms) <= 11


@pytest.mark.longer
def test_an_octree_map_keeps_its_free_space(data_dir: Path) -> None:
    result = extract(read_chunks(data_dir / "octomap_freiburg078" / "fr_078_tidyup.bt"))
    assert len(result.storeys) == 1 and 2 <= len(result.rooms) <= 8
    assert result.free is not None and len(result.free) == 2_610_011


@pytest.mark.slow  # its rooms as they are drawn: tests/io/test_read_real.py
def test_a_building_model(data_dir: Path) -> None:
    """Two flats of two storeys: every room that the model calls one and somebody can stand in lies in one room of its own."""
    cloud, result = duplex(data_dir), duplex_map(data_dir)
    assert len(result.storeys) == 2
    np.testing.assert_allclose(np.diff(result.storeys["floor"]), 3.1, atol=0.15)
    assert (result.edges["kind"] == "stairs").sum() == 2
    found = set()
    large = [r for r in cloud.rooms if r.kind not in ("Roof", "Foyer", "Stair", "Hallway") and _area(r.polygon) > 8]
    for room in large:
        middle = np.array([*room.polygon.mean(axis=0), room.floor])
        found.add(int(result.navigable_room[np.linalg.norm(result.navigable.compute_centroids() - middle, axis=1).argmin()]))
    assert len(found) >= 0.7 * len(large)


def test_a_tablet_scan_of_the_upper_half(data_dir: Path) -> None:
    """One room, hardly any floor: either a room or the reason why not."""
    result = extract(read_chunks(data_dir / "ipad_lidar_rooms" / "pix4d_database" / "808_db.ply"))
    assert 1 <= len(result.rooms) <= 3


def _area(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return 0.5 * abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))
