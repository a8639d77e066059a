"""A plan whose walls were raised is told from a scan: its walls show no doors, and are not asked."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.scenes import two_rooms
from topomerge import networks
from topomerge.archive import VARIABLE
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.extraction.scan import read_scan
from topomerge.extraction.slices import is_raised, raise_slice
from topomerge.extraction.voxels import voxelise
from topomerge.io import read_points


@pytest.fixture
def drawn(tmp_path: Path) -> Path:
    image = np.full((80, 120), 254, np.uint8)
    image[[0, 79]] = image[:, [0, 60, 119]] = 0
    image[30:40, 60] = 254
    Image.fromarray(image).save(tmp_path / "plan.png")
    return tmp_path / "plan.png"


@pytest.mark.parametrize("ceiling", [False, True])
def test_a_raised_plan_is_one_in_any_frame(drawn: Path, ceiling: bool) -> None:
    cloud = read_points(drawn, resolution=0.05, ceiling=ceiling)
    scan = read_scan(cloud, 0.1)
    assert is_raised(scan.grid) and scan.fine is not None and raise_slice(scan).fine is None
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    assert is_raised(read_scan(cloud.points @ turn.T + (3.03, -7.1, 2.22), 0.1).grid)


@pytest.mark.parametrize("resolution", [0.02, 0.04, 0.08, 0.1, 0.12, 0.15])
def test_a_raised_plan_is_one_at_any_resolution(drawn: Path, resolution: float) -> None:
    """Pixels of a cell's size leave some levels of the walls empty, but the same ones everywhere."""
    assert is_raised(read_scan(read_points(drawn, resolution=resolution), 0.1).grid)


def test_a_scan_is_none() -> None:
    scan = read_scan(two_rooms().points(), 0.1)
    assert not is_raised(scan.grid) and raise_slice(scan) is scan


def test_walls_without_anything_in_between_but_with_a_lintel_are_none(drawn: Path) -> None:
    points = read_points(drawn, resolution=0.05).points.astype(float)
    above_door = np.stack(np.meshgrid([3.025], np.arange(2.0, 2.5, 0.05), np.arange(1.5, 2.5, 0.05)), axis=-1).reshape(-1, 3)
    window = (points[:, 1] < 0.06) & (points[:, 0] > 1) & (points[:, 0] < 2) & (points[:, 2] > 0.9)
    assert not is_raised(read_scan(np.concatenate([points[~window], above_door]), 0.1).grid)


def test_no_cells() -> None:
    assert not is_raised(voxelise(np.zeros((1, 3)), 0.1))


@pytest.mark.parametrize("broken", ["plan_network.onnx", "grid_network.onnx"])
def test_a_raised_plan_is_looked_at_by_its_own_network(drawn: Path, broken: str, tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / broken).write_bytes(b"no network")
    card = broken.replace(".onnx", ".card.json")
    shutil.copy(Path(networks.__file__).parent / card, tmp_path / "weights" / card)
    plan, scan = read_points(drawn, resolution=0.05), two_rooms().points()
    used, other = (scan, plan) if broken == "plan_network.onnx" else (plan, scan)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "weights"))
    assert len(extract(other).rooms) == 2
    with pytest.raises(InputError, match=broken):
        extract(used)
