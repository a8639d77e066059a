"""A plain ROS 2 node: scans, clouds or grids of robots in, the transforms between their maps out.

It needs `rclpy` and the installed package `topomerge` only. What is kept and believed is as of `topomerge bridge`.
"""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan, PointCloud2
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from topomerge.fusion.bridge import EVENTS_TOPIC, TRANSFORMS_TOPIC, Bridge, parse_robot
from topomerge.fusion.live import LiveMerger
from topomerge.io.bag_file import Message

TYPES = {"scan": LaserScan, "cloud": PointCloud2, "grid": OccupancyGrid}
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class TopomergeNode(Node):
    """Parameters: `robots` (["a=/a/scan,/a/odom", ...]), `kind` (scan, cloud or grid), `folder` (of the state)."""

    def __init__(self) -> None:
        super().__init__("topomerge")
        robots = [parse_robot(text) for text in self.declare_parameter("robots", ["a=/a/scan,/a/odom"]).value]
        kind = TYPES[self.declare_parameter("kind", "scan").value]
        folder = self.declare_parameter("folder", "topomerge_live").value
        self.inbox: queue.Queue[Message | None] = queue.Queue(maxsize=500)
        self.bridge = Bridge(LiveMerger(Path(folder)), robots, self.tell)
        self.events = self.create_publisher(String, EVENTS_TOPIC, 10)
        self.transforms = self.create_publisher(TFMessage, TRANSFORMS_TOPIC, LATCHED)
        for robot in robots:
            self.bridge.merger.get_robot(robot.name)
            self.listen(robot.scans, kind, LATCHED if kind is OccupancyGrid else qos_profile_sensor_data)
        for topic in {topic for robot in robots for topic in robot.poses}:
            is_transform = topic.rpartition("/")[2] in ("tf", "tf_static")
            profile = LATCHED if topic.endswith("tf_static") else qos_profile_sensor_data
            self.listen(topic, TFMessage if is_transform else Odometry, profile)
        self.worker = threading.Thread(target=self.bridge.run, args=(self.receive(),))
        self.worker.start()

    def listen(self, topic: str, kind: type, profile: Any) -> None:
        """Put the messages of a topic into the inbox; the newest ones wait where it is full."""

        def put(content: Any) -> None:
            if self.inbox.full():
                self.inbox.get_nowait()
            self.inbox.put_nowait(Message(topic, 0, self.get_clock().now().nanoseconds * 1e-9, content))

        self.create_subscription(kind, topic, put, profile)

    def receive(self) -> Iterator[Message | None]:
        """Yield what comes, until the node ends; the transforms that have gathered are published between messages."""
        while rclpy.ok():
            for operation in self.bridge.take_outbox():
                if operation["op"] == "publish" and operation["topic"] == TRANSFORMS_TOPIC:
                    self.transforms.publish(TFMessage(transforms=[self.convert(t) for t in operation["msg"]["transforms"]]))
            try:
                yield self.inbox.get(timeout=0.2)
            except queue.Empty:
                yield None

    def convert(self, listed: dict[str, Any]) -> TransformStamped:
        """Convert a transform, stamped now."""
        out = TransformStamped()
        out.header.stamp, out.header.frame_id = self.get_clock().now().to_msg(), listed["header"]["frame_id"]
        out.child_frame_id = listed["child_frame_id"]
        for part in ("translation", "rotation"):
            for axis, value in listed["transform"][part].items():
                setattr(getattr(out.transform, part), axis, float(value))
        return out

    def tell(self, event: Any) -> None:
        """Publish an event as JSON."""
        self.events.publish(String(data=json.dumps(dict(event))))
        self.get_logger().info(json.dumps(dict(event)))


def main() -> None:
    """Run until a shutdown; the state is written then."""
    rclpy.init()
    node = TopomergeNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
        node.worker.join()
        node.destroy_node()


if __name__ == "__main__":
    main()
