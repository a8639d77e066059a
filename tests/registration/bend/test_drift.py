"""The sensor of a map says how much it may bend."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.fusion.plans_of import grid_of, office
from topomerge.cli.options import SENSORS
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.io.maps import load_map, save_map
from topomerge.registration.bend.pieces import Drift, detect_sensor, get_sensor_drift, select_drifts


@pytest.fixture(scope="module")
def office_map():
    return extract(grid_of(office().points(), mean=False))


def test_the_command_line_names_the_sensors_that_were_fitted() -> None:
    assert all(get_sensor_drift(name).shift >= 0 for name in SENSORS)
    assert get_sensor_drift("drawing").rigid and get_sensor_drift("tls").shift < get_sensor_drift("depth").shift


def test_a_map_remembers_its_sensor(office_map, tmp_path) -> None:
    assert detect_sensor(office_map) == "unknown"
    save_map(replace(office_map, parameters={**office_map.parameters, "sensor": "tls"}), tmp_path / "a.tmap")
    assert detect_sensor(load_map(tmp_path / "a.tmap")) == "tls"


@pytest.mark.parametrize("name", ["sextant", "", 7, None, ["tls"]])
def test_a_sensor_that_nobody_fitted_is_unknown(office_map, name) -> None:
    assert detect_sensor(replace(office_map, parameters={"sensor": name})) == "unknown"


def test_lines_beside_a_scan_are_a_drawing_and_beside_lines_anything() -> None:
    assert select_drifts(["raised", "tls"]) == [Drift(0.0, 0.0), get_sensor_drift("tls")]
    assert select_drifts(["raised", "raised"]) == [get_sensor_drift("unknown")] * 2


def test_another_word_is_refused() -> None:
    with pytest.raises(InputError, match="sensor must be one of depth, drawing"):
        get_sensor_drift("sextant")
