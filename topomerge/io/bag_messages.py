"""Messages of robots as arrays: PointCloud2, LaserScan and OccupancyGrid.

Sources: the message definitions of sensor_msgs and nav_msgs, https://docs.ros2.org/latest/api/sensor_msgs
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from topomerge.io.bag_file import Message
from topomerge.io.grid import PIXELS, Plan
from topomerge.types import Array

POINT_CLOUD, LASER_SCAN = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/LaserScan"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
LONGEST_POINT = 1 << 16  # bytes of a point


def stamp(message: Message) -> float:
    """When it was measured, s: what its header says, or when it was recorded where the header says nothing."""
    time = message.content.header.stamp
    return message.recorded if time.sec == 0 and time.nanosec == 0 else time.sec + time.nanosec * 1e-9


def cloud_points(path: Path, message: Message) -> tuple[Array, Array | None]:
    """(n, 3) points and (n, 3) uint8 colours, or None, of a PointCloud2.

    Raises:
        InputError: it has no coordinates, or fewer bytes than it promises.
    """
    cloud = message.content
    order = ">" if cloud.is_bigendian else "<"
    offsets = {f.name: (int(f.offset), FIELD_TYPES.get(int(f.datatype))) for f in cloud.fields}
    step, row, width, height = int(cloud.point_step), int(cloud.row_step), int(cloud.width), int(cloud.height)
    if not {"x", "y", "z"} <= {name for name, (_, kind) in offsets.items() if kind in ("f4", "f8")}:
        raise message.fault(path, f"has the fields {' '.join(offsets)[:80]} but not x y z", "give --topic with another one")
    data = np.frombuffer(cloud.data, np.uint8)
    row = row if height > 1 else width * step
    if not 0 < step <= LONGEST_POINT or row < width * step or len(data) < height * row:
        raise message.fault(path, f"promises {height} x {width} points of {step} bytes and has {len(data):,} bytes")
    names = [n for n in ("x", "y", "z", "rgb", "rgba") if n in offsets and offsets[n][1] is not None]
    kinds = [order + str(offsets[n][1]) for n in names]
    if any(offsets[n][0] + np.dtype(k).itemsize > step for n, k in zip(names, kinds, strict=True)):
        raise message.fault(path, f"has fields beyond its {step} bytes a point")
    layout = np.dtype({"names": names, "formats": kinds, "offsets": [offsets[n][0] for n in names], "itemsize": step})
    rows = data[: height * row].reshape(height, row)[:, : width * step].reshape(height * width, step)
    points = np.ascontiguousarray(rows).view(layout)[:, 0] if len(rows) else np.empty(0, layout)
    with np.errstate(invalid="ignore"):  # a damaged number may be a nan that warns
        xyz = np.stack([points[n].astype(np.float64) for n in "xyz"], axis=1)
    name = next((n for n in ("rgb", "rgba") if n in names and layout[n].itemsize == 4), None)
    if name is None:
        return xyz, None
    packed = np.ascontiguousarray(points[name]).astype(layout[name].newbyteorder("=")).view(np.uint32)
    return xyz, np.stack([(packed >> s) & 255 for s in (16, 8, 0)], axis=1).astype(np.uint8)


def laser_points(path: Path, message: Message) -> tuple[Array, Array | None]:
    """(n, 3) points of a LaserScan, in its plane; None for colours.

    Raises:
        InputError: an angle is not finite.
    """
    scan = message.content
    ranges = np.asarray(scan.ranges, np.float64)
    if not (math.isfinite(scan.angle_min) and math.isfinite(scan.angle_increment)):
        raise message.fault(path, "has angles that are not finite")
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    met = (ranges >= scan.range_min) & (ranges <= scan.range_max) & np.isfinite(ranges)  # false for nan
    ranges, angles = ranges[met], angles[met]
    return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(len(ranges))]), None


def occupancy_plan(path: Path, message: Message) -> tuple[tuple[Array, Array], Plan]:
    """Brightness (h, w) in 0..1, where nothing is known (h, w), and what else a map_server file says, of an OccupancyGrid.

    Raises:
        InputError: a size that does not fit its cells, or numbers that are not finite.
    """
    info, cells = message.content.info, np.asarray(message.content.data, np.int8)
    height, width = int(info.height), int(info.width)
    if height * width != len(cells) or not 0 < len(cells) <= PIXELS:
        raise message.fault(path, f"has {len(cells):,} cells for {height} x {width}")
    place, turn = info.origin.position, info.origin.orientation
    yaw = math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))
    said: tuple[str, ...] = ()
    if math.isnan(yaw):
        yaw, said = (
            0.0,
            (f"{path}: the map on {message.topic} is turned by a quaternion that is no number; it was read as no turn",),
        )
    if not (info.resolution > 0 and np.isfinite((info.resolution, place.x, place.y, yaw)).all()):
        raise message.fault(path, f"has a resolution of {info.resolution:g} m or an origin that can't be used")
    values = cells.reshape(height, width)[::-1]  # the first row of a grid is the lowest, of an image the highest
    plan = Plan(path, float(info.resolution), (float(place.x), float(place.y), yaw), warnings=said)
    return (1.0 - values.clip(0, 100) / np.float32(100), values < 0), plan
