"""A plain ROS 2 node: scans, clouds or grids of robots in, the transforms between their maps out.

It needs `rclpy` and the installed package `topomerge` only. What is kept and believed is as of `topomerge bridge`.
"""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan, PointCloud2
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from topomerge.errors import InputError
from topomerge.fusion.bridge import EVENTS_TOPIC, TRANSFORMS_TOPIC, Bridge, parse_robots
from topomerge.fusion.live import LiveMerger, describe_event, hold_state
from topomerge.io.bag_file import LASER_SCAN, OCCUPANCY_GRID, POINT_CLOUD, TRANSFORMS, Message
from topomerge.io.streams import ODOMETRY, POSE, UNSURE_POSE

TYPES = {
    LASER_SCAN: LaserScan, POINT_CLOUD: PointCloud2, OCCUPANCY_GRID: OccupancyGrid, TRANSFORMS: TFMessage,
    ODOMETRY: Odometry, POSE: PoseStamped, UNSURE_POSE: PoseWithCovarianceStamped,
}  # fmt: skip
DEPTH = 100  # messages that wait for this node, as of tf2: static transforms of several publishers come at once
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class TopomergeNode(Node):
    """Parameters: `robots` (["a=/a/scan,/a/odom", ...]), `folder` (of the state).

    Raises:
        InputError: a parameter is wrong.
    """

    def __init__(self) -> None:
        super().__init__("topomerge")
        robots = parse_robots(self.declare_parameter("robots", ["a=/a/scan,/a/odom"]).value)
        folder = self.declare_parameter("folder", "topomerge_live").value
        self.inbox: queue.Queue[Message] = queue.Queue(maxsize=500)
        self.held = ExitStack()
        self.held.enter_context(hold_state(Path(folder)))
        self.bridge = Bridge(LiveMerger(Path(folder)), robots, lambda event: self.get_logger().info(describe_event(event)))
        self.failure: BaseException | None = None
        self.senders = {
            EVENTS_TOPIC: self.create_publisher(String, EVENTS_TOPIC, 10),
            TRANSFORMS_TOPIC: self.create_publisher(TFMessage, TRANSFORMS_TOPIC, LATCHED),
        }
        self.bridge.outbox.extend(self.bridge.greet())
        self.awaited = set(self.bridge.list_topics())
        self.create_timer(1.0, self.subscribe_to_new)
        self.worker = threading.Thread(target=self.work)
        self.worker.start()

    def subscribe_to_new(self) -> None:
        """Subscribe to the topics that somebody publishes by now, each by its type and as reliably as it is published."""
        for topic in sorted(self.awaited):
            found = self.get_publishers_info_by_topic(topic)
            if not found:
                continue
            self.awaited.remove(topic)
            name = found[0].topic_type
            if name in TYPES:
                self.create_subscription(TYPES[name], topic, self.build_listener(topic), match_publishers(found))
            else:
                self.get_logger().error(f"{topic}: {name} is not read; these are: {', '.join(TYPES)}")

    def build_listener(self, topic: str) -> Any:
        """Build what puts the messages of a topic into the inbox; the newest ones wait where it is full."""

        def put(content: Any) -> None:
            if self.inbox.full():
                self.inbox.get_nowait()
                self.bridge.counts["dropped"] += 1
            self.inbox.put_nowait(Message(topic, 0, self.get_clock().now().nanoseconds * 1e-9, content))

        return put

    def work(self) -> None:
        """Join maps until the node ends; where that fails, the node ends."""
        try:
            self.bridge.run(self.receive())
        except InputError as error:
            self.failure = error
        except BaseException as error:  # a fault: with its traceback
            self.failure = error
            raise
        finally:
            rclpy.try_shutdown()

    def receive(self) -> Iterator[Message | None]:
        """Yield what comes, until the node ends; what has gathered is published between messages."""
        while rclpy.ok():
            while self.bridge.outbox:
                self.publish(self.bridge.outbox.popleft())
            try:
                yield self.inbox.get(timeout=0.2)
            except queue.Empty:
                yield None

    def publish(self, operation: Mapping[str, Any]) -> None:
        """Publish what rosbridge would: an event as JSON, or transforms."""
        if operation["op"] != "publish":
            return
        content = operation["msg"]
        if operation["topic"] == EVENTS_TOPIC:
            self.senders[EVENTS_TOPIC].publish(String(data=content["data"]))
        else:
            transforms = [self.convert(listed) for listed in content["transforms"]]
            self.senders[TRANSFORMS_TOPIC].publish(TFMessage(transforms=transforms))

    def convert(self, listed: Mapping[str, Any]) -> TransformStamped:
        """Convert a transform, stamped now."""
        out = TransformStamped()
        out.header.stamp, out.header.frame_id = self.get_clock().now().to_msg(), listed["header"]["frame_id"]
        out.child_frame_id = listed["child_frame_id"]
        for part in ("translation", "rotation"):
            for axis, value in listed["transform"][part].items():
                setattr(getattr(out.transform, part), axis, float(value))
        return out


def match_publishers(found: Collection[Any]) -> QoSProfile:
    """Match what all publishers of a topic offer."""
    offers = [info.qos_profile for info in found]
    reliable = all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers)
    latched = all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers)
    return QoSProfile(
        depth=DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def main() -> int:
    """Run until a shutdown; the state is written then. Return 1 where a parameter was wrong or the work failed."""
    rclpy.init()
    try:
        node = TopomergeNode()
    except (InputError, ParameterException) as error:
        print(f"topomerge: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
        node.worker.join()
        node.held.close()
        node.destroy_node()
    counts = ", ".join(f"{n} {what}" for what, n in sorted(node.bridge.counts.items())) or "nothing came"
    print(f"topomerge: {node.failure or counts}", file=sys.stderr)
    return 1 if node.failure else 0


if __name__ == "__main__":
    sys.exit(main())
