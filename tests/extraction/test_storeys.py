"""Which floors are storeys: galleries are, landings and what hangs in a hall are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from topomerge.extraction.storeys import find_storeys
from topomerge.types import Array, VoxelGrid

EDGE = 0.1
TALL, LOW = 5.0, 2.6  # m above a floor


def floor(x: tuple[int, int], y: tuple[int, int], z: int) -> Array:
    return np.stack(np.meshgrid(np.arange(*x), np.arange(*y), [z], indexing="ij"), axis=-1).reshape(-1, 3)


def flight(x: int, y: tuple[int, int], low: int, high: int) -> Array:
    """Steps of 0.2 m, 0.3 m deep."""
    steps = np.arange(low, high, 2)
    return np.concatenate([floor((x + 3 * k, x + 3 * k + 3), y, z) for k, z in enumerate(steps.tolist())])


def storeys_of(parts: list[tuple[Array, float]]) -> tuple[Array, Array]:
    cells = np.concatenate([c for c, _ in parts])
    above = np.concatenate([np.full(len(c), h) for c, h in parts])
    grid = VoxelGrid.from_cells(cells.astype(np.int32), np.zeros(3), EDGE, (200, 200, 80), {"above": above})
    return find_storeys(grid, grid.properties["above"])


HALL = (floor((0, 150), (0, 100), 2), TALL)
UPPER = (floor((0, 80), (0, 100), 57), LOW)


def test_stairs_with_a_landing_in_a_hall_through_two_storeys_are_no_storey() -> None:
    stairs = [(flight(90, (0, 15), 4, 30), TALL), (floor((129, 145), (0, 30), 30), LOW), (flight(90, (15, 30), 32, 57), LOW)]
    storeys, storey = storeys_of([HALL, UPPER, *stairs])
    assert np.allclose(storeys["floor"], (0.25, 5.75), atol=0.02) and set(storey.tolist()) == {0, 1}


def test_what_glass_mirrors_is_no_storey() -> None:
    astray = [(floor((k, k + 8), (40, 90), 22 + k // 8), LOW) for k in range(0, 96, 8)]  # it slopes
    assert np.allclose(storeys_of([HALL, UPPER, *astray])[0]["floor"], (0.25, 5.75), atol=0.02)
    assert np.allclose(storeys_of([HALL, *astray])[0]["floor"], 0.25, atol=0.02)


def test_a_level_gallery_in_a_hall_is_a_storey() -> None:
    storeys, _ = storeys_of([HALL, (floor((0, 150), (100, 130), 30), LOW)])
    assert np.allclose(storeys["floor"], (0.25, 3.05), atol=0.02)


def test_storeys_one_above_the_other() -> None:
    floors = [(floor((0, 100), (0, 80), z), LOW) for z in (2, 32, 62)]
    storeys, _ = storeys_of([*floors, (flight(20, (80, 92), 4, 32), LOW), (flight(20, (80, 92), 34, 62), LOW)])
    assert np.allclose(storeys["floor"], (0.25, 3.25, 6.25), atol=0.02)


@pytest.mark.data
@pytest.mark.longer
def test_a_real_atrium_has_two_storeys_and_ways_between_them(data_dir: Path) -> None:
    """Galleries about a hall: it came out with three storeys once."""
    path = data_dir / "scans_real_3d" / "atrium_two_storeys_2cm.laz"
    if not path.is_file():
        pytest.skip(f"TOPOMERGE_DATA has no {path.parent.name}")
    map = tm.extract(tm.read_points(path))
    assert len(map.storeys) == 2 and 5.0 < float(np.diff(map.storeys["floor"])[0]) < 6.5
    between = map.rooms["storey"][map.edges["rooms"]]
    assert (between[:, 0] != between[:, 1]).sum() >= 2 and set(map.rooms["storey"].tolist()) == {0, 1}
