"""Homes as vacuum robots mapped them (`*.json` of Valetudo), with the robots' own rooms.

Walls have no thickness of their own there: rooms end where the floor does. Furniture that the robot drove around is left out
where it is an island, and cuts a bay out of its room where it stands at a wall. Heights are guesses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import shapely
from topomerge.datasets.plans.grid import add_contacts, add_rooms, find_contacts, flood, guess_kinds
from topomerge.datasets.plans.sketch import Sketch

from topomerge.errors import InputError
from topomerge.io.json_map import load_json_map
from topomerge.io.valetudo import RobotMap, is_robot_map, parse_robot_map
from topomerge.types import Array

SMALLEST_HOME_ROOM = 0.8  # m2
HOME_CAVITY = 0.3  # m; narrower strips of a room are left out
HOME_INSET = 0.03  # m, half the wall between rooms whose floors touch
WIDEST_LEAF = 1.3  # m; wider contacts of two rooms are openings without a leaf
ISLAND = 2.0  # m2; smaller islands in a room are furniture
HEAD = 400  # bytes of a file that say what it is


def is_robot_home(path: Path) -> bool:
    """Return whether a JSON file begins as a map of Valetudo does."""
    try:
        with path.open("rb") as file:
            return b'"ValetudoMap"' in file.read(HEAD)
    except OSError:
        return False


def iter_sketches(path: Path) -> Iterator[tuple[str, Callable[[], Sketch]]]:
    """Yield the name and maker of the one storey."""
    yield path.stem, partial(read_robot_home, path)


def read_robot_home(path: Path) -> Sketch:
    """Read the robot's rooms, and a doorway wherever the floors of two of them touch.

    Raises:
        InputError: the file is no map of Valetudo, or the robot tells no rooms apart.
    """
    about = load_json_map(path)
    if not is_robot_map(about):
        raise InputError("not a robot's map: its class is not ValetudoMap")
    drawn = parse_robot_map(path, about)
    labels, _ = spread_rooms(drawn)
    result = Sketch(height=2.8, ceiling=2.5, inset=HOME_INSET)
    names = {k: name for k, name in enumerate(drawn.names, 1) if name}
    index = add_rooms(result, labels, names, drawn.resolution, drawn.origin, SMALLEST_HOME_ROOM, HOME_CAVITY / 2)
    if not index:
        raise InputError("too few rooms: the robot tells none apart")
    result.shapes = [_remove_islands(shape) for shape in result.shapes]
    touching = find_contacts(labels, drawn.resolution, drawn.origin)
    for kind, wide in (("door", False), ("opening", True)):
        add_contacts(result, [c for c in touching if (np.hypot(*(c[2][1] - c[2][0])) > WIDEST_LEAF) == wide], index, kind)
    guess_kinds(result, "")
    return result


def spread_rooms(drawn: RobotMap) -> tuple[Array, Array]:
    """Return (h, w) the robot's rooms of `SMALLEST_HOME_ROOM` and more, spread over the floor around them, 0: none; and the
    numbers (k,) of these rooms."""
    sizes = np.bincount(drawn.rooms.ravel())[1:] * drawn.resolution**2
    large = 1 + np.flatnonzero(sizes >= SMALLEST_HOME_ROOM)
    return flood(np.where(np.isin(drawn.rooms, large), drawn.rooms, 0), drawn.free), large


def _remove_islands(shape: shapely.Polygon) -> shapely.Polygon:
    """Return a room without the islands that a robot drove around."""
    return shapely.Polygon(shape.exterior, [ring for ring in shape.interiors if shapely.Polygon(ring).area >= ISLAND])
