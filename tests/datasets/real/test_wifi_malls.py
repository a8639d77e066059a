"""WiFi of a mall: its file, two maps out of one storey's walks, and poses of the real ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.real.wifi_malls import HELD_HIGH, WIFI_STOREYS, read_wifi_storey, split_walks

from topomerge.errors import InputError
from topomerge.landmarks.radio import score_radio
from topomerge.landmarks.radio_search import propose_radio_poses


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "wifi_malls"
    place.mkdir()
    xy = np.column_stack([np.arange(12.0), np.repeat([0.0, 5, 10, 15], 3)]).astype(np.float32)
    scan = np.repeat(np.arange(12), 2)
    np.savez(
        place / "site1_F1.npz",
        scan_xy=xy,
        scan_walk=np.repeat(np.arange(4), 3),
        obs_scan=scan,
        obs_ap=np.tile([7, 9], 12),
        obs_rssi=np.full(24, -60, np.int8),
    )
    return tmp_path


def test_walks_of_a_storey_become_two_maps(folder: Path) -> None:
    storey = read_wifi_storey(folder, "F1")
    assert len(storey.landmarks) == 24 and storey.landmarks.values == ("ap7", "ap9")
    assert (storey.position[:, 2] == HELD_HIGH).all() and (storey.landmarks.table["number"] == -60).all()
    a, b, truth = split_walks(storey, 3)
    both = np.concatenate([a.landmarks.table["position"], truth.apply(b.landmarks.table["position"])])
    assert len(a.landmarks) == len(b.landmarks) == 12
    assert np.allclose(both[np.argsort(both[:, 0])], np.repeat(storey.position, 2, axis=0))
    again = split_walks(storey, 3)
    assert again[2] == truth and again[0].landmarks.table.tobytes() == a.landmarks.table.tobytes()
    assert len(split_walks(storey, 3, 1)[0].landmarks) == 6


def test_a_file_that_is_none_is_named(folder: Path) -> None:
    (folder / "wifi_malls" / "site1_F2.npz").write_bytes(b"PK nothing")
    for name in ("F2", "B1"):
        with pytest.raises(InputError, match=f"site1_{name}.npz.*TOPOMERGE_DATA"):
            read_wifi_storey(folder, name)


@pytest.mark.data
@pytest.mark.longer
def test_real_walks_are_laid_on_each_other(data_dir: Path) -> None:
    storey = read_wifi_storey(data_dir, WIFI_STOREYS[0])
    a, b, truth = split_walks(storey, 1)
    best = propose_radio_poses(a, b)[0]
    at = b.landmarks.table["position"]
    assert np.linalg.norm((best.pose.apply(at) - truth.apply(at))[:, :2], axis=1).mean() < 5 and best.is_sure
    assert score_radio(a, b, truth)["elsewhere"] < -6
