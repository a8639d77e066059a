"""The nouns of the library: frozen dataclasses over arrays, validated when they are made.

Conventions: z is up, lengths are metres, angles radians. Poses are float64, points float32 about a float64 shift. ``T_ab`` maps
points of map b into the frame of map a. A room label of -1 means "no room".
"""

from topomerge.types.grid import Array, LogFn, PointCloud, Sim3, TrueRoom, VoxelGrid, select_lowest_of_column
from topomerge.types.landmarks import LANDMARK_DTYPE, LANDMARK_KINDS, Landmarks, build_landmarks, join_landmarks, move_landmarks
from topomerge.types.placement import Deformation, Placement
from topomerge.types.topometric_map import (
    AREA_DTYPE,
    EDGE_DTYPE,
    JOINED,
    LEVELLED,
    OLDER_EDGE_DTYPE,
    ROOM_DTYPE,
    ROOM_ODDS,
    STOREY_DTYPE,
    WINDOW_DTYPE,
    TopometricMap,
    add_outline_odds,
    classify_door_state,
    convert_pose_to_files,
    convert_pose_to_maps,
    filter_confident,
    is_level,
    is_mostly_unseen,
    parse_levelling,
    read_levelling,
    select_rooms,
    transform_points,
)

__all__ = [
    "AREA_DTYPE",
    "EDGE_DTYPE",
    "JOINED",
    "LANDMARK_DTYPE",
    "LANDMARK_KINDS",
    "LEVELLED",
    "OLDER_EDGE_DTYPE",
    "ROOM_DTYPE",
    "ROOM_ODDS",
    "STOREY_DTYPE",
    "WINDOW_DTYPE",
    "Array",
    "Deformation",
    "Landmarks",
    "LogFn",
    "Placement",
    "PointCloud",
    "Sim3",
    "TopometricMap",
    "TrueRoom",
    "VoxelGrid",
    "add_outline_odds",
    "build_landmarks",
    "classify_door_state",
    "convert_pose_to_files",
    "convert_pose_to_maps",
    "filter_confident",
    "is_level",
    "is_mostly_unseen",
    "join_landmarks",
    "move_landmarks",
    "parse_levelling",
    "read_levelling",
    "select_lowest_of_column",
    "select_rooms",
    "transform_points",
]
