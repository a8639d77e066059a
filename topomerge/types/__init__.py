"""The nouns of the library: frozen dataclasses over arrays, validated when they are made.

Conventions: z is up, lengths are metres, angles radians. Poses are float64, points float32 about a float64 shift. ``T_ab`` maps
points of map b into the frame of map a. A room label of -1 means "no room".
"""

from topomerge.types.arrays import Array
from topomerge.types.cloud import PointCloud, TrueRoom
from topomerge.types.deformation import Deformation
from topomerge.types.grid import VoxelGrid
from topomerge.types.levelling import (
    LEVELLED,
    between_files,
    between_maps,
    checked_levelling,
    is_level,
    levelling_of,
    transformed,
)
from topomerge.types.placement import Placement
from topomerge.types.similarity import Sim3
from topomerge.types.some_rooms import confident, of_rooms
from topomerge.types.topometric_map import (
    AREA_DTYPE,
    EDGE_DTYPE,
    JOINED,
    OLDER_EDGE_DTYPE,
    ROOM_DTYPE,
    ROOM_ODDS,
    STOREY_DTYPE,
    WINDOW_DTYPE,
    TopometricMap,
    door_state,
    mostly_unseen,
    with_outline_odds,
)

__all__ = [
    "AREA_DTYPE",
    "EDGE_DTYPE",
    "JOINED",
    "LEVELLED",
    "OLDER_EDGE_DTYPE",
    "ROOM_DTYPE",
    "ROOM_ODDS",
    "STOREY_DTYPE",
    "WINDOW_DTYPE",
    "Array",
    "Deformation",
    "Placement",
    "PointCloud",
    "Sim3",
    "TopometricMap",
    "TrueRoom",
    "VoxelGrid",
    "between_files",
    "between_maps",
    "checked_levelling",
    "confident",
    "door_state",
    "is_level",
    "levelling_of",
    "mostly_unseen",
    "of_rooms",
    "transformed",
    "with_outline_odds",
]
