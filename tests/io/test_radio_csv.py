"""Readings of radio beside a trajectory: names of columns, places, and what is wrong with which line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from topomerge.errors import InputError
from topomerge.io.landmarks import read_radio_csv
from topomerge.io.points import read_points
from topomerge.io.trajectory import Trajectory, read_trajectory

TUM = "# time tx ty tz qx qy qz qw\n0 0 0 1 0 0 0 1\n10 20 0 1 0 0 0 1\n"


@pytest.fixture
def trajectory(tmp_path: Path) -> Trajectory:
    path = tmp_path / "poses.txt"
    path.write_text(TUM)
    return read_trajectory(path)


def write(path: Path, text: str) -> Path:
    (path / "wifi.csv").write_text(text)
    return path / "wifi.csv"


@pytest.mark.parametrize(
    "text",
    [
        "5.0,AA:01,-60\n2.5,aa:02,-70\n2.7,aa:01,-65\n99,aa:01,-50\n",
        "time,bssid,rssi\n5.0,AA:01,-60\n2.5,aa:02,-70\n2.7,aa:01,-65\n99,aa:01,-50\n",
        "SSID;dBm;Timestamp;MAC\nhome;-60;5.0;AA:01\nx;-70;2.5;aa:02\nx;-65;2.7;aa:01\n;-50;99;aa:01\n",
        "\ufeff# a walk\n5.0\tAA:01\t-60\n\n2.5\taa:02\t-70\n2.7\taa:01\t-65\n99\taa:01\t-50\n",
    ],
)
def test_readings_have_places(text: str, tmp_path: Path, trajectory: Trajectory) -> None:
    if text.startswith("\ufeff"):
        text = text.replace("# a walk\n", "")
    table = read_radio_csv(write(tmp_path, text), trajectory)
    rows = table.table
    assert table.get_values().tolist() == ["aa:02", "aa:01", "aa:01", "aa:01"] and table.is_kind("radio").all()
    assert rows["time"].tolist() == [2.5, 2.7, 5, 99] and rows["number"].tolist() == [-70, -65, -60, -50]
    assert rows["position"][:3, 0] == pytest.approx([5, 5.4, 10]) and np.isnan(rows["position"][3]).all()
    assert rows["group"].tolist() == [0, 0, 1, 2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,aa\n", "line 1 has 2 columns"),
        ("time,mac,dbm\n1,aa,-50\n2,aa,loud\n", "line 3 has no number"),
        ("1,aa,-50\nx,aa,-50\n", "line 2 has no number"),
        ("1,aa,nan\n", "line 1 holds nan dBm"),
        ("1,aa,-50\n2,aa,500\n", "line 2 holds 500 dBm"),
        ("inf,aa,-50\n", "line 1 holds -50 dBm at inf s"),
        ("1,,-50\n", "line 1 has no address"),
        ('1,"' + "a" * 200_000 + '",-50\n', "is no CSV"),
    ],
)
def test_what_is_wrong_is_said(text: str, message: str, tmp_path: Path, trajectory: Trajectory) -> None:
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=message) as caught:
        read_radio_csv(path, trajectory)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_are_none(tmp_path: Path, trajectory: Trajectory) -> None:
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(InputError, match=str(path)):
            read_radio_csv(path, trajectory)
    with pytest.raises(InputError, match="no times"):
        read_radio_csv(write(tmp_path, "1,aa,-50\n"), Trajectory(np.eye(4)[None]))
    assert (
        len(read_radio_csv(write(tmp_path, ""), trajectory))
        == len(read_radio_csv(write(tmp_path, "t,mac,dbm\n"), trajectory))
        == 0
    )


def test_a_table_beside_a_cloud_is_read_without_an_option(tmp_path: Path) -> None:
    cloud = tmp_path / "a.xyz"
    np.savetxt(cloud, np.random.default_rng(0).uniform(0, 5, (200, 3)))
    assert read_points(cloud).landmarks is None or not len(read_points(cloud).landmarks)
    (tmp_path / "a.radio.csv").write_text("5.0,aa:01,-60\n2.5,aa:02,-70\n")
    with pytest.raises(InputError, match=r"a\.radio\.csv: has no trajectory; put a\.poses\.txt"):
        read_points(cloud)
    (tmp_path / "a.poses.txt").write_text(TUM)
    found = read_points(cloud).landmarks
    assert found is not None and found.get_values().tolist() == ["aa:02", "aa:01"] and found.is_kind("radio").all()
    assert np.allclose(found.table["position"][:, 0], [5.0, 10.0])
