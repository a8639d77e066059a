"""What the networks read of rooms, edges and pairs of doors: the names of all columns, once.

Widths of layers, of stored tables and of examples follow from these tuples, and places of columns are looked up by name. Adding a
feature takes a line here and its value in `embedding.graph`; weights that were trained without it are refused with a message.
"""

from __future__ import annotations

POINTS_PER_ROOM = 512  # that stand for a room
EDGE_KINDS = ("door", "opening", "stairs")  # of edges
ROOM_FEATURES = (
    "area",  # m2
    "height",  # m; 0: no ceiling seen
    "volume",  # m3
    "length",  # m, along the first principal axis seen from above: the side of a rectangle of the same spread
    "width",  # m, along the second
    "elongation",  # width / length
    "fill",  # area / (length * width): 1 for a rectangle
    "floor_spread",  # m, standard deviation of the floor's height: stairs, ramps
    "degree",  # rooms that one can walk to
    "doors",
    "openings",
    "stairs",
    "door_width",  # m, mean over doors and openings; 0: none
    "reach",  # m, from the middle to the farthest door; 0: none
    "completeness",  # share of the outline that was seen
    "glimpsed",  # 0 or 1
)
EDGE_FEATURES = (
    "width",  # m
    "height",  # m; 0: nothing seen above
    *EDGE_KINDS,  # one of them is 1
    "distance",  # m, between the middles of the rooms, seen from above
    "climb",  # m, from floor to floor
    "from_middle",  # m, from the first room's middle to the door, seen from above
    "to_middle",  # m, from the door to the second room's middle
    "turn_sin",  # of the turn at the door, walking from middle to middle; to the left is positive
    "turn_cos",
)
DOOR_FEATURES = (
    "distance",  # m, between two doors of a room, seen from above
    "angle_sin",  # of the angle at the room's middle from the first door to the second, counter-clockwise
    "angle_cos",
)
LAYOUT_FEATURES = (
    "distance",  # m, between two doors nearby, seen from above
    "climb",  # m
    "angle_sin",  # of the angle from the way out of the room to the way to the other door, counter-clockwise
    "angle_cos",
    "same",  # 1: both lead out of one room
)
WAY_FEATURES = (  # in the direction of the walls, in which crops are turned, too
    "room_x",  # m, from the middle of the first room to that of the second
    "room_y",
    "door_x",  # m, to the door between them
    "door_y",
)
THESIS_FEATURES = (
    "points",  # log of 1 + m2: occupied cells times the area of a cell's face
    "planarity",  # (s2 - s3) / s1 of the singular values s
    "box_volume",  # log of 1 + m3, of the smallest upright box
    "height",  # m, of that box
    "projection",  # log of 1 + m2, of the cells seen from above
    "spread",  # m, mean distance to the centroid
    "eigenvalues",  # smallest over largest eigenvalue of the covariance
    "smallest",  # m, smallest singular value over the root of the number of cells
    "s3_s12",  # s3 / (s1 + s2)
    "s2_s1",  # s2 / s1, not s1 / s2: that of a line is not finite
    "verticality",  # of the first principal axis: 0 level, 1 upright
    "roughness",  # m, mean distance to the plane of the 32 nearest cells
)
SPECTRUM_FEATURES = tuple(f"eigenvalue_{k}" for k in range(1, 33))  # 1/m2, ascending

TABLES = {  # tensor of the graph -> its columns
    "x": ROOM_FEATURES,
    "edge_attr": EDGE_FEATURES,
    "door_attr": DOOR_FEATURES,
    "near_attr": LAYOUT_FEATURES,
    "edge_way": WAY_FEATURES,
    "engineered": THESIS_FEATURES,
    "shapedna": SPECTRUM_FEATURES,
}
LENGTH_POWERS = {  # tensor -> column -> power of a length in its unit: how it grows when a map does
    "x": {
        "area": 2, "height": 1, "volume": 3, "length": 1, "width": 1, "floor_spread": 1, "door_width": 1, "reach": 1,
    },
    "edge_attr": {"width": 1, "height": 1, "distance": 1, "climb": 1, "from_middle": 1, "to_middle": 1},
    "door_attr": {"distance": 1},
}  # fmt: skip


def width(tensor: str) -> int:
    """Number of columns of a tensor of the graph."""
    return len(TABLES[tensor])


def column(tensor: str, feature: str) -> int:
    """Place of a feature among the columns of a tensor."""
    return TABLES[tensor].index(feature)


def columns_of_power(tensor: str, power: int) -> list[int]:
    """Columns whose unit is this power of a length, ascending."""
    powers = LENGTH_POWERS[tensor]
    return [k for k, feature in enumerate(TABLES[tensor]) if powers.get(feature) == power]
