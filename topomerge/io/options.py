"""How a file is to be read: what formats leave open, such as the unit, and how drawings become walls."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from numbers import Real
from pathlib import Path
from typing import Any

from topomerge.errors import InputError
from topomerge.io.frame import TURNS, UNITS


@dataclass(frozen=True)
class ReadOptions:
    """What `read_points`, `read_chunks` and each reader are given; lengths in metres.

    Args:
        up: axis of the file that points up: "z", "y", "x" or "-z", "-y", "-x"; None: what the format says, which is y for
            glTF and z for all others.
        unit: of the file's coordinates: "m", "cm", "mm", "ft" or "in"; None: metres.
        scale: factor on the coordinates, beside the unit.
        resolution: m per pixel; needed for an image without a map_server file.
        extrude: height of the walls made from a floor plan, m.
        ceiling: also close a floor plan from above.
        spacing: distance between points sampled on meshes, building models and floor plans, m; None: 0.05 m for surfaces
            and the resolution for floor plans. Of clouds cut into octrees, that of the finest level to read; None: all levels.
        doors: keep the door leaves of a building model; by default its doors stand open.
        poses: file with the trajectory of a folder of scans, RGB-D images or a bag (KITTI or TUM format); of a bag also the name
            of a topic with poses. None: what lies beside the scans, or what the bag holds.
        one_frame: read all files of a folder as parts of one cloud, whose points lie in one frame.
        topic: of a bag, where it has several with points or maps.
    """

    up: str | None = None
    unit: str | None = None
    scale: float = 1.0
    resolution: float | None = None
    extrude: float = 2.5
    ceiling: bool = False
    spacing: float | None = None
    doors: bool = False
    poses: str | None = None
    topic: str | None = None
    one_frame: bool = False

    @property
    def factor(self) -> float:
        """Metres per unit of the file."""
        return UNITS[self.unit or "m"] * self.scale


OPTION_NAMES = tuple(field.name for field in fields(ReadOptions))
LENGTH_NAMES = ("scale", "resolution", "extrude", "spacing")


def read_options(path: Path, values: Mapping[str, Any]) -> ReadOptions:
    """The options of these names and values.

    Raises:
        InputError: there is no such option, or it can't have such a value; the line names the file that was to be read.
    """
    for name in values:
        if name not in OPTION_NAMES:
            raise InputError(f"{path}: {name} is no option of reading; give one of {', '.join(OPTION_NAMES)}")
    options = ReadOptions(**values)
    for name, allowed in (("up", TURNS), ("unit", UNITS)):
        if values.get(name) is not None and values[name] not in allowed:
            wrong = "not an axis" if name == "up" else "not known"
            raise InputError(f"{path}: --{name} {values[name]} is {wrong}; give one of {', '.join(allowed)}")
    for name in ("poses", "topic"):
        if getattr(options, name) is not None and not str(getattr(options, name)).strip():
            raise InputError(f"{path}: --{name} is empty; give a name")
    for name in LENGTH_NAMES:
        value = getattr(options, name)
        if value is not None and not (isinstance(value, Real) and math.isfinite(value) and float(value) > 0):
            shown = f"{value:g}" if isinstance(value, Real) else repr(value)
            raise InputError(f"{path}: --{name} {shown} can't be used; give a number above 0")
    return options
