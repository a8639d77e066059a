"""How much the sensors of maps go astray, as fitted on simulated and development maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from topomerge.errors import InputError
from topomerge.fusion.storey_levels import extruded, slices
from topomerge.io.weight_files import read_weights_json
from topomerge.types import TopometricMap, VoxelGrid

SOFTER = 2.0  # times the fitted drift of a sensor: rooms that drifted within themselves are no rigid pieces (validation pairs)


@dataclass(frozen=True)
class Drift:
    """Standard deviation of shifts, m, and of turns, rad, over a walk of one metre; they grow with the square root of the walk.
    0: the map does not bend."""

    shift: float
    turn: float

    @property
    def rigid(self) -> bool:
        """Does the map not bend at all?"""
        return self.shift <= 0


def sensor_drift(sensor: str, fitted: bool = False) -> Drift:
    """The drift that joints of a sensor's maps are as stiff as; `fitted`: as it was fitted.

    Raises:
        InputError: none that is listed in `drift.json`.
    """
    sensors = _fitted_drifts()
    if sensor not in sensors:
        raise InputError(f"sensor must be one of {', '.join(sorted(sensors))}, not {sensor!r}")
    softer = 1.0 if sensor == "unknown" or fitted else SOFTER
    return Drift(softer * float(sensors[sensor]["shift"]), softer * float(sensors[sensor]["turn"]))


def _fitted_drifts() -> dict[str, Any]:
    return read_weights_json("topomerge.fusion.bend", "drift.json")


def map_sensor(map: TopometricMap | VoxelGrid) -> str:
    """The sensor of a map: the one that its parameters name; else a drawing or a slice where it looks like one, or unknown. A
    name that nobody fitted a drift to says nothing."""
    named = map.parameters.get("sensor") if isinstance(map, TopometricMap) else None
    if isinstance(named, str) and named in _fitted_drifts():
        return named
    grid = map.grid if isinstance(map, TopometricMap) else map
    if extruded(grid):
        return "raised"
    return "laser2d" if slices(grid) else "unknown"


def drifts_of(sensors: Sequence[str]) -> list[Drift]:
    """The drift of each of several maps. One that was raised from lines is taken for a drawing, which does not bend, among maps
    that were measured in space; among maps of lines alone, nobody knows which ones were measured.

    Raises:
        InputError: a sensor that is not in `drift.json`.
    """
    flat = all(s == "raised" for s in sensors)
    return [sensor_drift(("unknown" if flat else "drawing") if s == "raised" else s) for s in sensors]
