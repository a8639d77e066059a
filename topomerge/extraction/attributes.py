"""Attributes of a map, once its rooms are cut: odds of rooms, doors with their kinds and states, windows (beyond the thesis)."""

from __future__ import annotations

from topomerge.extraction.distinct_doors import distinct_doors
from topomerge.extraction.elevations.doorways import StoreyWalls
from topomerge.extraction.elevations.wall_doors import with_wall_doors
from topomerge.extraction.elevations.windows import with_windows
from topomerge.extraction.floor import Floor
from topomerge.extraction.floor_patches import without_patches
from topomerge.extraction.room_odds import with_room_odds
from topomerge.extraction.scan import Scan
from topomerge.extraction.walked_doors import with_walked_doors
from topomerge.types import TopometricMap


def estimate_attributes(
    map: TopometricMap, scan: Scan, floor: Floor, walls: StoreyWalls | None, doors: bool = True
) -> tuple[TopometricMap, list[str]]:
    """The map with how likely each room is one, its doors and windows; and what is odd about the sensor's way.

    Args:
        floor: that the map was made of.
        walls: with the map's rooms beside them; None of a scan that shows none at heights.
        doors: are the doors of plans weighed with what walls and the plan network show?
    """
    map = with_room_odds(map, scan.rays, scan.raised)
    if doors:
        map = with_wall_doors(map, floor.classified_storeys, walls)
    map, doubt = with_walked_doors(map, scan.places)
    map = distinct_doors(map)
    if walls is not None:
        map = without_patches(with_windows(map, walls.elevations, walls.classes), scan.places)
    return map, [doubt] if doubt else []
