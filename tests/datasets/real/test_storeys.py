"""Real storeys to develop on: which pairs must not be merged, which may, and that their walls agree under the truth.

The robots' own rooms as what is compared with: where they are, which touch, and maps that tell none apart.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from topomerge.datasets.core.building import find_physical_building
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.real import sources, storeys
from topomerge.datasets.real import sources as wall_fit
from topomerge.datasets.real.robot_homes import compute_home_truth
from topomerge.datasets.simulation.floor_truth import TRUTH_CELL, evaluate_map

import topomerge as tm
from tests.datasets.plans import plan_files as write
from topomerge.errors import InputError
from topomerge.io import read_points


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Every map of the set, each a room of another size."""
    place = tmp_path / "storeys_jsk"
    place.mkdir()
    names = [f"{b}-{s}" for b, of in storeys.STOREYS.items() for s in of] + list(storeys.YEARS[:-1])
    for k, name in enumerate(names):
        image = np.full((120, 160), 205, np.uint8)
        image[20:90, 20 : 120 + 2 * k] = 0
        image[23:87, 23 : 117 + 2 * k] = 254
        Image.fromarray(image).save(place / f"{name}.png")
        (place / f"{name}.yaml").write_text(f"image: {name}.png\nresolution: 0.05\norigin: [0, 0, 0]\n")
    return place


def test_storeys_have_no_truth_and_years_of_one_storey_have(folder: Path) -> None:
    made = {name: make() for name, make in storeys.iter_pairs(folder)}
    apart = [p for p in made.values() if p.kind == "other-storey"]
    together = [p for p in made.values() if p.kind == "overlap"]
    assert len(apart) == 9 + 3 and len(together) == 6 and len(made) == 18
    assert all(p.truth is None and p.overlap == 0 for p in apart) and all(p.truth is not None for p in together)
    assert "eng2-7f-8f" not in made  # drawn over a copy: nobody could tell these apart
    assert {p.building for p in made.values()} == {"eng2", "eng8"}


def test_they_are_read_where_they_are_named_only(folder: Path) -> None:
    assert sum(isinstance(p, Pair) for _, p in sources.iter_real_pairs(folder.parent, ["storeys"])) == 18
    assert not any("eng2" in name for name, _ in sources.iter_real_pairs(folder.parent))


@pytest.mark.longer
@pytest.mark.data
def test_walls_of_one_storey_agree_over_the_years(data_dir: Path) -> None:
    makers = dict(storeys.iter_pairs(data_dir / sources.DEVELOPMENT_FOLDERS["storeys"]))
    assert wall_fit.measure_residual(makers["eng2-7f_2019-7f"]()).median < 0.05


def test_the_rooms_stand_where_the_map_is_read(tmp_path: Path) -> None:
    path = write.valetudo(tmp_path, 3)
    cloud = read_points(path)
    truth, rooms = compute_home_truth(path, cloud.points.astype(float))
    assert [r.name for r in rooms] == ["room 1", "room 2", "room 3"] and np.allclose(
        rooms[0].polygon.min(axis=0), (10, -8), atol=0.06
    )
    assert len(truth.visited) == 3 and truth.edges.tolist() == [[0, 1], [1, 2]] and len(truth.doors) == 2
    assert np.allclose((truth.raster == 0).sum() * TRUTH_CELL**2, 12, atol=0.5)
    assert np.allclose(truth.doors[0, 2:4], (14.05, -6.45), atol=0.06)  # in the robot's frame: x right, y up
    verdict = evaluate_map(tm.extract(cloud), truth)
    assert verdict.rooms.iou > 0.93 and verdict.rooms.precision == 1 and verdict.doors.recall == 1 and verdict.edges.recall == 1


def test_a_robot_that_tells_no_rooms_apart_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="tells 1 rooms apart"):
        compute_home_truth(write.valetudo(tmp_path, 1), np.zeros((1, 3)))


def test_maps_of_one_home_are_one_building() -> None:
    assert (
        find_physical_building("home", "1c_1096_a")
        == find_physical_building("home", "1c_1096_b")
        != find_physical_building("home", "d9_1058")
    )
