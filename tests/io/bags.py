"""Writers of small true bags of ROS 1 and ROS 2."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.io.walks import Walk, quaternion
from topomerge.io.bag_file import TRANSFORMS

KINDS = ("bag", "db3", "mcap", "folder")
Entry = tuple[str, str, float, Any]  # topic, type, time (s), message


@dataclass(frozen=True)
class Messages:
    """Makes messages of one version of ROS."""

    store: Any

    def _of(self, kind: str, **values: Any) -> Any:
        return self.store.types[kind](**values)

    def stamp(self, time: float) -> Any:
        seconds, rest = divmod(round(time * 1e9), 10**9)
        return self._of("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)

    def header(self, time: float, frame: str) -> Any:
        seq = {"seq": 0} if self.first else {}
        return self._of("std_msgs/msg/Header", **seq, stamp=self.stamp(time), frame_id=frame)

    @property
    def first(self) -> bool:
        """Is it ROS 1, whose headers are counted?"""
        return any(name == "seq" for name, _ in self.store.fielddefs["std_msgs/msg/Header"][1])

    def turn(self, pose: np.ndarray) -> Any:
        return self._of("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quaternion(pose).tolist(), strict=True)))

    def place(self, pose: np.ndarray, kind: str = "Point") -> Any:
        return self._of(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", pose[:3, 3].tolist(), strict=True)))

    def cloud(self, points: np.ndarray, time: float, frame: str, colors: np.ndarray | None = None) -> Any:
        """A PointCloud2 with an intensity between, as LiDAR drivers have it."""
        layout = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("rgb", "<u4")]
        rows = np.zeros(len(points), layout if colors is not None else layout[:4])
        for axis, name in enumerate("xyz"):
            rows[name] = points[:, axis]
        if colors is not None:
            rows["rgb"] = (colors.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(axis=1)
        fields = [
            self._of(
                "sensor_msgs/msg/PointField", name=n, offset=rows.dtype.fields[n][1], datatype=6 if n == "rgb" else 7, count=1
            )
            for n in rows.dtype.names
        ]
        data = np.frombuffer(rows.tobytes(), np.uint8)
        size = {"height": 1, "width": len(rows), "point_step": rows.itemsize, "row_step": rows.nbytes}
        more = {"is_bigendian": False, "is_dense": True}
        return self._of("sensor_msgs/msg/PointCloud2", header=self.header(time, frame), fields=fields, data=data, **size, **more)

    def laser(self, ranges: np.ndarray, time: float, frame: str) -> Any:
        """A LaserScan all around."""
        step = 2 * np.pi / len(ranges)
        angles = {"angle_min": -np.pi, "angle_max": np.pi - step, "angle_increment": step}
        more = {
            "time_increment": 0.0,
            "scan_time": 0.1,
            "range_min": 0.1,
            "range_max": 30.0,
            "intensities": np.zeros(0, np.float32),
        }
        return self._of(
            "sensor_msgs/msg/LaserScan", header=self.header(time, frame), ranges=ranges.astype(np.float32), **angles, **more
        )

    def image(self, values: np.ndarray, time: float, frame: str, encoding: str = "16UC1", order: str = "<") -> Any:
        """An Image whose rows end with two bytes that say nothing."""
        height, width = values.shape[:2]
        rows = values.astype(values.dtype.newbyteorder(order)).reshape(height, -1).view(np.uint8)
        data = np.hstack([rows, np.full((height, values.itemsize), 7, np.uint8)])
        size = {"height": height, "width": width, "step": data.shape[1], "is_bigendian": int(order == ">")}
        return self._of("sensor_msgs/msg/Image", header=self.header(time, frame), encoding=encoding, data=data.ravel(), **size)

    def packed_image(self, data: bytes, time: float, frame: str, form: str = "16UC1; compressedDepth png") -> Any:
        """A CompressedImage of depth, behind its twelve bytes."""
        packed = np.frombuffer(bytes(12) + data, np.uint8)
        return self._of("sensor_msgs/msg/CompressedImage", header=self.header(time, frame), format=form, data=packed)

    def camera(self, matrix: np.ndarray, shape: tuple[int, int], time: float, frame: str, rectified: bool = True) -> Any:
        """A CameraInfo with P and another K, or with K alone."""
        k, p = (matrix[:3, :3] * (1.5 if rectified else 1)).ravel(), matrix[:3].ravel() * rectified
        numbers = {"d": np.zeros(5), "k": k, "r": np.eye(3).ravel(), "p": p}
        numbers = {name.upper() if self.first else name: value for name, value in numbers.items()}
        region = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
        more = {"roi": self._of("sensor_msgs/msg/RegionOfInterest", **region, do_rectify=False), "binning_x": 0, "binning_y": 0}
        size = {"height": shape[0], "width": shape[1], "distortion_model": "plumb_bob"}
        return self._of("sensor_msgs/msg/CameraInfo", header=self.header(time, frame), **size, **numbers, **more)

    def transforms(self, poses: Iterable[tuple[str, str, np.ndarray]], time: float) -> Any:
        """A message of tf from (parent, child, pose)."""
        all_transforms = [
            self._of(
                "geometry_msgs/msg/TransformStamped",
                header=self.header(time, parent),
                child_frame_id=child,
                transform=self._of(
                    "geometry_msgs/msg/Transform", translation=self.place(pose, "Vector3"), rotation=self.turn(pose)
                ),
            )
            for parent, child, pose in poses
        ]
        return self._of(TRANSFORMS, transforms=all_transforms)

    def odometry(self, pose: np.ndarray, time: float, parent: str, child: str) -> Any:
        body = self._of("geometry_msgs/msg/Pose", position=self.place(pose), orientation=self.turn(pose))
        zero = self._of("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        return self._of(
            "nav_msgs/msg/Odometry",
            header=self.header(time, parent),
            child_frame_id=child,
            pose=self._of("geometry_msgs/msg/PoseWithCovariance", pose=body, covariance=np.zeros(36)),
            twist=self._of(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._of("geometry_msgs/msg/Twist", linear=zero, angular=zero),
                covariance=np.zeros(36),
            ),
        )

    def grid(self, cells: np.ndarray, resolution: float, origin: np.ndarray, time: float) -> Any:
        """An OccupancyGrid; the first row of the (h, w) cells is the lowest."""
        body = self._of("geometry_msgs/msg/Pose", position=self.place(origin), orientation=self.turn(origin))
        size = {"width": cells.shape[1], "height": cells.shape[0], "resolution": resolution}
        info = self._of("nav_msgs/msg/MapMetaData", map_load_time=self.stamp(time), origin=body, **size)
        return self._of(
            "nav_msgs/msg/OccupancyGrid", header=self.header(time, "map"), info=info, data=cells.ravel().astype(np.int8)
        )


def write_bag(folder: Path, kind: str, make: Callable[[Messages], Iterable[Entry]], name: str = "walk") -> Path:
    """A bag of one of the `KINDS` in a folder; what it holds is made by a function, for either version of ROS."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    folder.mkdir(parents=True, exist_ok=True)
    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    if kind == "bag":
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", TRANSFORMS))
    path = folder / (f"{name}.bag" if kind == "bag" else name)
    plugin = StoragePlugin.SQLITE3 if kind == "db3" else StoragePlugin.MCAP
    with Writer1(path) if kind == "bag" else Writer2(path, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for topic, type_name, time, message in make(Messages(store)):
            connections.setdefault(topic, None)
            connections[topic] = connections[topic] or writer.add_connection(topic, type_name, typestore=store)
            data = store.serialize_ros1(message, type_name) if kind == "bag" else store.serialize_cdr(message, type_name)
            writer.write(connections[topic], round(time * 1e9), data)
    return path if kind in ("bag", "folder") else next(path.glob(f"*.{kind}"))


MOUNT = np.array([[0.0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, 0.3], [0, 0, 0, 1]])  # the LiDAR on the robot


def walk_messages(walk: Walk, poses: str = "tf", topic: str = "/points") -> Callable[[Messages], Iterable[Entry]]:
    """What a robot records on a walk.

    Args:
        poses: by "tf" (the LiDAR on the robot, the robot in odom, and odom in a map that is corrected), by "odometry" of the
            robot with the LiDAR's mount in tf, or "none".
    """

    def make(m: Messages) -> Iterable[Entry]:
        start = float(walk.times[0])
        robot = walk.poses @ np.linalg.inv(MOUNT)
        if poses != "none":
            yield "/tf_static", TRANSFORMS, start, m.transforms([("/base_link", "/lidar", MOUNT)], start)
        for number, (points, time) in enumerate(zip(walk.scans, walk.times.tolist(), strict=True)):
            if poses == "tf":
                correction = np.eye(4)
                correction[:3, 3] = (0.01 * number, -1.0, 0.5)
                odom = np.linalg.inv(correction) @ robot[number]
                yield "/tf", TRANSFORMS, time, m.transforms([("odom", "base_link", odom), ("map", "odom", correction)], time)
            if poses == "odometry":
                yield "/odom", "nav_msgs/msg/Odometry", time, m.odometry(robot[number], time, "odom", "base_link")
            yield topic, "sensor_msgs/msg/PointCloud2", time, m.cloud(points, time, "lidar")

    return make
