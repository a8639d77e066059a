"""One real file of every format that the data folder has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.real_models import duplex
from topomerge.io import read_chunks, read_points
from topomerge.io.ifc import compute_signed_area

pytestmark = pytest.mark.data


@pytest.mark.longer
def test_octomap_of_freiburg(data_dir: Path) -> None:
    cloud = read_points(data_dir / "octomap_freiburg078" / "fr_078_tidyup.bt")
    assert len(cloud) == 287_664  # as octomap itself counts them
    assert cloud.free is not None and cloud.free.edge == pytest.approx(0.05)
    assert not cloud.free.contains(cloud.free.locate(cloud.points)).any()
    assert cloud.warnings == ()


@pytest.mark.parametrize("name", ["807-60", "808-30", "808-60"])
def test_ipad_clouds_that_lie_on_their_side(data_dir: Path, name: str) -> None:
    path = data_dir / "ipad_lidar_rooms" / "user" / f"{name}.ply"
    assert "give --up y" in read_points(path).warnings[0]
    cloud = read_points(path, up="y")
    assert cloud.warnings == () and cloud.colors is not None
    assert 2 < np.ptp(np.percentile(cloud.points[:, 2], (1, 99))) < 5


def test_ipad_clouds_that_stand(data_dir: Path) -> None:
    paths = sorted((data_dir / "ipad_lidar_rooms").glob("pix4d_*/*.ply"))
    assert paths
    for path in paths:
        cloud = read_points(path)
        assert cloud.warnings == (), path
        assert len(cloud) > 36_000 and cloud.colors is not None


@pytest.mark.longer
@pytest.mark.parametrize(("floor", "corner"), [("1", (-60.45, -23.4)), ("2", (-53.95, -29.15)), ("1s", (-50.0, -50.0))])
def test_robot_maps_of_texas(data_dir: Path, floor: str, corner: tuple[float, float]) -> None:
    path = data_dir / "utexas_gdc_floors" / "maps" / "real" / floor / f"{floor}.yaml"
    cloud = read_points(path)
    assert "beside it was read" in cloud.warnings[0] and len(cloud.warnings) == 1  # the yaml says pgm, the file is png
    cells = (cloud.points[:, :2].astype(float) - corner) / 0.05 - 0.5
    np.testing.assert_allclose(cells, np.round(cells), atol=1e-3)  # pixel centres
    assert cells.min() > -1e-3
    assert set(np.unique(cloud.points[:, 2])[[0, -1]].tolist()) == {0.0, 2.5}


def test_apartment_of_halmstad(data_dir: Path) -> None:
    path = data_dir / "halmstad_robot_maps" / "maps" / "HIH" / "pseudo_occupancy" / "HIH_01.png"
    cloud = read_points(path, resolution=0.02)
    floor = cloud.points[cloud.points[:, 2] == 0]
    assert 40 < len(floor) * 0.02**2 < 80
    chunks = list(read_chunks(path, resolution=0.02, chunk=500_000))
    assert sum(len(c) for c in chunks) == len(cloud) and len(chunks) > 2


@pytest.mark.longer
@pytest.mark.parametrize(
    ("name", "rooms", "storeys", "size"),
    [("duplex", 21, {0, 1, 2}, (9.3, 26.6, 8.2)), ("ExampleHOM", 11, {0, 1, 2}, (8.6, 11.4, 10.6))],
)
def test_building_models(data_dir: Path, name: str, rooms: int, storeys: set[int], size: tuple[float, float, float]) -> None:
    cloud = duplex(data_dir) if name == "duplex" else read_points(data_dir / "ifc_buildings" / f"{name}.ifc", spacing=0.2)
    assert len(cloud.rooms) == rooms
    assert {r.storey for r in cloud.rooms} == storeys
    np.testing.assert_allclose(np.ptp(cloud.points, axis=0), size, atol=0.1)
    assert all(compute_signed_area(r.polygon) > 1 and r.ceiling > r.floor + 1.5 for r in cloud.rooms)
    if name == "duplex":
        assert {r.kind for r in cloud.rooms} >= {"Kitchen", "Living Room", "Foyer"}
