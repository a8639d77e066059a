"""The office floor to develop on: read where it is named only, with a scale and a truth that its walls agree with."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from topomerge.datasets.pairs.pairs import Pair
from topomerge.datasets.real import halmstad, office_floor, sources
from topomerge.datasets.real import sources as wall_fit

from topomerge.config import compose
from topomerge.errors import InputError
from topomerge.evaluation.settings import Evaluation


@pytest.fixture
def floor(tmp_path: Path) -> Path:
    """Two captures of one room of 100 by 60 px, the second shifted by (20, 10) px, with key points from the lower left."""
    folder = tmp_path / "halmstad_office_f5"
    for number, (x, y) in enumerate(((30, 30), (50, 40)), 1):
        image = np.full((140, 200), 127, np.uint8)
        image[140 - y - 60 : 140 - y, x : x + 100] = 0
        image[140 - y - 57 : 140 - y - 3, x + 3 : x + 97] = 255
        path = folder / "maps" / "F5" / "pseudo_occupancy" / f"F5_0{number}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(path)
    corners = np.array([[0, 0], [100, 0], [100, 60], [0, 60]])
    points = {"F5_01": (corners + (30, 30)).tolist(), "F5_02": (corners + (50, 40)).tolist()}
    pair = {"a": "F5_01", "b": "F5_02", "idx": [[k, k] for k in range(4)]}
    (folder / "ground_truth_pairs.json").write_text(
        json.dumps({"keypoints_px": points, "pairs": [pair, {**pair, "a": "F5_02", "b": "F5_01"}]})
    )
    return folder


def test_key_points_count_from_the_lower_left_in_metres(floor: Path) -> None:
    ((name, make),) = office_floor.iter_pairs(floor)
    pair = make()
    assert (name, pair.source, pair.building) == ("F5_01-F5_02", "halmstad", "F5")
    assert pair.truth.translation == pytest.approx((-20 * 0.03, -10 * 0.03, 0.0))
    assert pair.truth.scale == pytest.approx(1) and pair.truth.yaw == pytest.approx(0)
    assert np.ptp(pair.a.points[:, 0]) == pytest.approx(100 * 0.03, abs=0.1)
    assert wall_fit.measure_residual(pair).median < 0.02
    ((_, smaller),) = halmstad.iter_pairs(floor)  # the apartments' pixels are smaller
    assert smaller().truth.translation == pytest.approx((-0.4, -0.2, 0.0))


def test_it_is_read_where_it_is_named_only(floor: Path) -> None:
    results = dict(sources.iter_real_pairs(floor.parent, ["office_floor"]))
    assert isinstance(results["office_floor/F5_01-F5_02"], Pair)
    assert not any("F5" in name for name, _ in sources.iter_real_pairs(floor.parent))
    with pytest.raises(InputError, match="office_floor, storeys are possible"):
        sources.iter_real_pairs(floor.parent, ["office"])


def test_no_other_set_is_of_it() -> None:
    pytest.importorskip("hydra")
    assert compose("evaluate", Evaluation, ["data=development"]).data.real == ["office_floor"]
    assert not set(compose("evaluate", Evaluation, ["data=real"]).data.real) & set(sources.DEVELOPMENT_FOLDERS)


@pytest.mark.longer
@pytest.mark.data
def test_walls_agree_though_drift_bends_them(data_dir: Path) -> None:
    makers = list(office_floor.iter_pairs(data_dir / sources.DEVELOPMENT_FOLDERS["office_floor"]))
    assert len(makers) == 15 * 14 / 2
    for _, make in (makers[0], makers[-1]):
        pair = make()
        assert wall_fit.measure_residual(pair).median < 0.15
        drawn = "drawing" in pair.sensors
        assert (abs(pair.truth.scale - 1) > 0.1) == drawn
