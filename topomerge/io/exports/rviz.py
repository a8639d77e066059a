"""A map as markers for RViz: a bag of ROS 2 (MCAP) with an array of markers for each kind of thing, latched.

``ros2 bag play map.mcap`` with RViz' fixed frame `map`; Foxglove opens the file as it is. Topics: `/topomerge/rooms` (floor as
flat cells in the room's colour), `/topomerge/names`, `/topomerge/doors` (from jamb to jamb; shut ones red), `/topomerge/graph`
(from the middle of each room to its doors). Namespaces are storeys, so that RViz can hide one.
Sources: visualization_msgs/Marker; the names of QoS in rosbag2.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.io.rooms_ply import assign_room_colours
from topomerge.structure.floors import build_floor_polygons, compute_jambs, find_inside_point
from topomerge.types import Array, TopometricMap, find_room_names

FRAME = "map"
BAG_VERSION: Literal[8] = 8  # of rosbag2's metadata: Iron and later, read by Humble
LAST_TIME = 10**9  # ns, when all is told
CELL_HEIGHT = 0.02  # m, height of a cell of a floor
LETTERS = 0.4  # m
LINE = 0.06  # m
ABOVE_FLOOR = 0.05  # m above the floor, so that lines are not hidden by it
SOLID = 0.8
SHUT, OPEN, WAY, WHITE = (200, 40, 40), (40, 140, 60), (90, 90, 90), (255, 255, 255)
ARRAY, MARKER = "visualization_msgs/msg/MarkerArray", "visualization_msgs/msg/Marker"


def save(map: TopometricMap, path: Path) -> None:
    """Write the bag. The same map gives the same bytes.

    Raises:
        InputError: the path can't be written.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    markers = _MarkerFactory()
    with tempfile.TemporaryDirectory() as temporary:
        with Writer(Path(temporary) / "bag", version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
            for topic, listed in _iter_topics(map, markers):
                to = bag.add_connection(
                    f"/topomerge/{topic}", ARRAY, typestore=markers.store, offered_qos_profiles=[_build_latched_qos()]
                )
                bag.write(to, LAST_TIME, markers.store.serialize_cdr(markers.build_array(listed), ARRAY))
        (file,) = (Path(temporary) / "bag").glob("*.mcap")
        with replace_on_success(path) as temporary_path:
            temporary_path.write_bytes(file.read_bytes())


def _iter_topics(map: TopometricMap, markers: _MarkerFactory) -> Iterator[tuple[str, list[Any]]]:
    colours, floors = assign_room_colours(map), build_floor_polygons(map)
    middles = np.array(
        [[*find_inside_point(f, r["centroid"]), r["centroid"][2] + ABOVE_FLOOR] for f, r in zip(floors, map.rooms, strict=True)]
    )
    storeys = map.rooms["storey"].tolist()
    points, size = map.navigable.compute_centroids(), map.navigable.edge
    flat = (size, size, CELL_HEIGHT)
    of_rooms = [(s, r) for r, s in enumerate(storeys)]
    yield (
        "rooms",
        [markers.build_marker("CUBE_LIST", at, points[map.navigable_room == at[1]], colours[at[1]], flat) for at in of_rooms],
    )
    label = partial(markers.build_marker, "TEXT_VIEW_FACING", points=np.zeros((0, 3)), colour=WHITE, scale=(0, 0, LETTERS))
    names = [f"{r} {name}".strip() for r, name in enumerate(find_room_names(map.landmarks, len(map.rooms)))]
    yield "names", [label(at, text=names[at[1]], middle=middles[at[1]]) for at in of_rooms]
    doors, connections = [], []
    for k, edge in enumerate(map.edges):
        a, b = edge["rooms"].tolist()
        at, centre = (storeys[a], k), edge["centre"] + (0, 0, ABOVE_FLOOR)
        colour = OPEN if edge["open"] else SHUT
        doors.append(markers.build_marker("LINE_LIST", at, compute_jambs(edge) + (0, 0, ABOVE_FLOOR), colour, (2 * LINE, 0, 0)))
        ends = np.array([middles[a], centre, centre, middles[b]])
        connections.append(markers.build_marker("LINE_LIST", at, ends, WAY, (LINE, 0, 0)))
    yield "doors", doors
    yield "graph", connections


def _build_latched_qos() -> Any:
    """Build the quality of service that is reliable and transient local: who comes late gets the newest message, as of a latched
    topic."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(9223372036, 854775807)
    newest = QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL
    return Qos(*newest, never, never, QosLiveliness.AUTOMATIC, never, False)


class _MarkerFactory:
    """Makes messages of ROS 2."""

    @cached_property
    def store(self) -> Any:
        """The types of messages."""
        from rosbags.typesys import Stores, get_typestore

        return get_typestore(Stores.ROS2_HUMBLE)

    def build_array(self, markers: list[Any]) -> Any:
        """Return a MarkerArray."""
        return self._build_message(ARRAY, markers=markers)

    def build_marker(
        self,
        kind: str,
        at: tuple[int, int],
        points: Array,
        colour: Any,
        scale: Sequence[float],
        text: str = "",
        middle: Any = None,
    ) -> Any:
        """Return a marker.

        Args:
            kind: CUBE_LIST, LINE_LIST or TEXT_VIEW_FACING.
            at: storey, and a number that no other one of its topic has.
            points: (n, 3) m.
            colour: (3,) 0..255.
            scale: m; what it means depends on the kind.
            middle: (3,) m, of a text.
        """
        red, green, blue = (float(c) / 255 for c in colour)
        x, y, z = (0.0, 0.0, 0.0) if middle is None else (float(v) for v in middle)
        still = self._build_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        none = np.zeros(0, np.uint8)
        picture = self._build_message("sensor_msgs/msg/CompressedImage", header=self._build_header(""), format="", data=none)
        return self._build_message(
            MARKER,
            header=self._build_header(FRAME),
            ns=f"storey_{at[0]}",
            id=at[1],
            type=getattr(self.store.types[MARKER], kind),
            action=0,
            pose=self._build_message("geometry_msgs/msg/Pose", position=self._build_point("Point", x, y, z), orientation=still),
            scale=self._build_point("Vector3", *scale),
            color=self._build_message("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=SOLID),
            lifetime=self._build_message("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
            frame_locked=False,
            points=[self._build_point("Point", *p) for p in points.tolist()],
            colors=[],
            texture_resource="",
            texture=picture,
            uv_coordinates=[],
            text=text,
            mesh_resource="",
            mesh_file=self._build_message("visualization_msgs/msg/MeshFile", filename="", data=none),
            mesh_use_embedded_materials=False,
        )

    def _build_header(self, frame: str) -> Any:
        return self._build_message(
            "std_msgs/msg/Header", stamp=self._build_message("builtin_interfaces/msg/Time", sec=0, nanosec=0), frame_id=frame
        )

    def _build_point(self, kind: str, x: float, y: float, z: float) -> Any:
        return self._build_message(f"geometry_msgs/msg/{kind}", x=float(x), y=float(y), z=float(z))

    def _build_message(self, kind: str, **values: Any) -> Any:
        return self.store.types[kind](**values)
