"""As much of ROS 2 as `ros/topomerge_node.py` uses: a graph of topics in one process, whose messages a test sends."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from types import ModuleType, SimpleNamespace
from typing import Any


class Reliability(Enum):
    RELIABLE = 1
    BEST_EFFORT = 2


class Durability(Enum):
    TRANSIENT_LOCAL = 1
    VOLATILE = 2


@dataclass(frozen=True)
class Profile:
    depth: int = 10
    reliability: Reliability = Reliability.RELIABLE
    durability: Durability = Durability.VOLATILE


class Record(SimpleNamespace):
    """A message; parts that were not given are made as they are used."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        setattr(self, name, Record())
        return self.__dict__[name]


class ParameterException(Exception):
    """Of rclpy.exceptions."""


class ExternalShutdownException(Exception):
    """Of rclpy.executors."""


@dataclass
class Graph:
    """What the node sees of others, and they of it."""

    parameters: dict[str, Any]
    script: Callable[[Graph], Iterator[None]] = lambda graph: iter(())
    offered: dict[str, tuple[str, Profile]] = field(default_factory=dict)
    subscribed: dict[str, tuple[str, Callable[[Any], None], Profile]] = field(default_factory=dict)
    published: list[tuple[str, Any]] = field(default_factory=list)
    profiles: dict[str, Profile] = field(default_factory=dict)
    logged: list[str] = field(default_factory=list)
    running: bool = False
    node: Any = None

    def send(self, topic: str, content: Any) -> None:
        self.subscribed[topic][1](content)

    def start(self) -> None:
        self.running = True

    def stop(self) -> None:
        self.running = False

    def spin(self, node: Any) -> None:
        self.node, steps = node, self.script(self)
        while self.running:
            for timer in node.timers:
                timer()
            if next(steps, "ended") == "ended":
                break
            time.sleep(0.005)
        self.running = False
        raise ExternalShutdownException


class FakeNode:
    """Of rclpy.node."""

    graph: Graph

    def __init__(self, name: str) -> None:
        self.timers: list[Callable[[], None]] = []

    def declare_parameter(self, name: str, default: Any) -> Any:
        value = self.graph.parameters.get(name, default)
        if type(value) is not type(default):
            raise ParameterException(f"Trying to set parameter '{name}' to '{value}' of another type")
        return SimpleNamespace(value=value)

    def create_timer(self, period: float, call: Callable[[], None]) -> None:
        self.timers.append(call)

    def create_publisher(self, kind: type, topic: str, profile: Any) -> Any:
        self.graph.profiles[topic] = profile
        return SimpleNamespace(publish=lambda message: self.graph.published.append((topic, message)))

    def create_subscription(self, kind: type, topic: str, call: Callable[[Any], None], profile: Profile) -> None:
        self.graph.subscribed[topic] = kind.__name__, call, profile

    def get_publishers_info_by_topic(self, topic: str) -> list[Any]:
        found = [self.graph.offered[topic]] if topic in self.graph.offered else []
        return [SimpleNamespace(topic_type=kind, qos_profile=profile) for kind, profile in found]

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=time.time_ns(), to_msg=Record))

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.graph.logged.append, error=self.graph.logged.append)

    def destroy_node(self) -> None:
        pass


def build_modules(graph: Graph) -> dict[str, ModuleType]:
    """Build the modules that the node imports, by name."""
    node = type("Node", (FakeNode,), {"graph": graph})
    contents: dict[str, dict[str, Any]] = {
        "rclpy": {
            "init": graph.start,
            "ok": lambda: graph.running,
            "try_shutdown": graph.stop,
            "spin": graph.spin,
        },
        "rclpy.node": {"Node": node},
        "rclpy.exceptions": {"ParameterException": ParameterException},
        "rclpy.executors": {"ExternalShutdownException": ExternalShutdownException},
        "rclpy.qos": {"QoSProfile": Profile, "ReliabilityPolicy": Reliability, "DurabilityPolicy": Durability},
    }
    kinds = {
        "geometry_msgs": ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped"),
        "nav_msgs": ("OccupancyGrid", "Odometry"),
        "sensor_msgs": ("LaserScan", "PointCloud2"),
        "std_msgs": ("String",),
        "tf2_msgs": ("TFMessage",),
    }
    for package, names in kinds.items():
        contents[package] = {}
        contents[f"{package}.msg"] = {name: type(name, (Record,), {}) for name in names}
    modules = {}
    for name, values in contents.items():
        modules[name] = ModuleType(name)
        vars(modules[name]).update(values)
    return modules
