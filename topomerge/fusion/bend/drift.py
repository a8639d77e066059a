"""How much the sensors of maps go astray, as fitted on simulated and development maps."""

from __future__ import annotations

from dataclasses import dataclass

from topomerge.errors import InputError
from topomerge.fusion.storey_levels import extruded, slices
from topomerge.io.weight_files import read_weights_json
from topomerge.types import TopometricMap, VoxelGrid


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


def sensor_drift(sensor: str) -> Drift:
    """The usual drift of a sensor.

    Raises:
        InputError: none that is listed in `drift.json`.
    """
    sensors = read_weights_json("topomerge.fusion.bend", "drift.json")
    if sensor not in sensors:
        raise InputError(f"sensor must be one of {', '.join(sorted(sensors))}, not {sensor!r}")
    return Drift(float(sensors[sensor]["shift"]), float(sensors[sensor]["turn"]))


def map_drift(map: TopometricMap | VoxelGrid) -> Drift:
    """The drift of a map: of the sensor that its parameters name, of a drawing or a slice where it looks like one, else of an
    unknown sensor."""
    grid = map
    if isinstance(map, TopometricMap):
        grid = map.grid
        sensor = map.parameters.get("sensor")
        if isinstance(sensor, str) and sensor:
            return sensor_drift(sensor)
    assert isinstance(grid, VoxelGrid)
    if extruded(grid):
        return sensor_drift("drawing")
    return sensor_drift("laser2d" if slices(grid) else "unknown")
