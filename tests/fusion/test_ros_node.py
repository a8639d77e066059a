"""The node for ROS 2, run over a small graph of the tests: ROS itself is not installed here."""

from __future__ import annotations

import ast
import runpy
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.fusion.fake_ros import Durability, Graph, Profile, Reliability, build_modules
from tests.fusion.live_robots import stamp
from topomerge.errors import InputError
from topomerge.fusion.bridge import Bridge
from topomerge.fusion.live import LiveLink, LiveMerger
from topomerge.io.streams import convert_message
from topomerge.types import Sim3

ROS = Path(__file__).parents[2] / "ros"
LATCHED = Profile(1, Reliability.RELIABLE, Durability.TRANSIENT_LOCAL)
LOSSY = Profile(5, Reliability.BEST_EFFORT, Durability.VOLATILE)
ORIGIN = {"x": 0.0, "y": 0.0, "z": 0.0}


def run_node(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> int:
    for name, module in build_modules(graph).items():
        monkeypatch.setitem(sys.modules, name, module)
    status: int = runpy.run_path(str(ROS / "topomerge_node.py"))["main"]()
    return status


def build_scan(time: float) -> Any:
    """A small cloud in the frame `laser`."""
    points = np.random.default_rng(int(10 * time)).uniform(-4, 4, (60, 3)).astype("<f4")
    fields = [{"name": axis, "offset": 4 * k, "datatype": 7, "count": 1} for k, axis in enumerate("xyz")]
    shape = {"height": 1, "width": 60, "point_step": 12, "row_step": 720, "is_bigendian": False, "is_dense": True}
    content = convert_message({"header": {"stamp": stamp(time), "frame_id": "laser"}, "fields": fields, **shape})
    content.data = points.tobytes()
    return content


def build_pose(kind: str, time: float) -> Any:
    """A pose of one of the three types."""
    where = {"position": {"x": 2 * time, "y": 0.0, "z": 0.0}, "orientation": {**ORIGIN, "w": 1.0}}
    head = {"stamp": stamp(time), "frame_id": "odom"}
    parts: dict[str, Any] = (
        {"pose": where} if kind.endswith("PoseStamped") else {"pose": {"pose": where, "covariance": [0.0] * 36}}
    )
    if kind.endswith("Odometry"):
        parts["child_frame_id"] = "base"
    return convert_message({"header": head, **parts})


def wait(until: Callable[[], bool]) -> Iterator[None]:
    for _ in range(2000):
        if until():
            return
        yield
    raise AssertionError("it did not come")


KINDS = {
    "a": "geometry_msgs/msg/PoseStamped",
    "b": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "c": "nav_msgs/msg/Odometry",
}


def test_poses_of_each_type_arrive_and_static_transforms_are_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    static = Profile(1, Reliability.RELIABLE, Durability.TRANSIENT_LOCAL)

    def drive(graph: Graph) -> Iterator[None]:
        bridge: Bridge = graph.node.bridge
        yield from wait(lambda: "/a/pose" in graph.subscribed)
        assert "/c/pose" not in graph.subscribed
        graph.offered["/c/pose"] = KINDS["c"], Profile()  # a robot that starts later
        graph.offered["/d/pose"] = "std_msgs/msg/String", Profile()
        yield from wait(lambda: "/c/pose" in graph.subscribed)
        for k in range(4):
            for name, kind in KINDS.items():
                graph.send(f"/{name}/scan", build_scan(float(k)))
                graph.send(f"/{name}/pose", build_pose(kind, float(k)))
        yield from wait(lambda: bridge.counts["taken"] == 12)

    graph = Graph({"robots": [f"{n}=/{n}/scan,/{n}/pose" for n in "abcd"], "folder": str(tmp_path / "live")}, drive)
    for name in KINDS:
        graph.offered[f"/{name}/scan"] = "sensor_msgs/msg/PointCloud2", LOSSY
    graph.offered |= {f"/{name}/pose": (KINDS[name], Profile()) for name in "ab"}
    graph.offered |= {"/tf": ("tf2_msgs/msg/TFMessage", Profile(100)), "/tf_static": ("tf2_msgs/msg/TFMessage", static)}
    assert run_node(graph, monkeypatch) == 0
    kinds = {topic: kind for topic, (kind, _, _) in graph.subscribed.items()}
    assert [kinds[f"/{name}/pose"] for name in "abc"] == ["PoseStamped", "PoseWithCovarianceStamped", "Odometry"]
    assert graph.subscribed["/tf_static"][2] == Profile(100, Reliability.RELIABLE, Durability.TRANSIENT_LOCAL)
    assert graph.subscribed["/a/scan"][2].reliability == Reliability.BEST_EFFORT
    assert any("/d/pose: std_msgs/msg/String is not read" in line for line in graph.logged)
    kept = LiveMerger(tmp_path / "live").robots
    for name in KINDS:
        assert kept[name].frame == "odom" and np.allclose(kept[name].poses[:, 0], [0, 2, 4, 6])


def test_transforms_that_hold_are_published_at_the_start_and_latched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    merger = LiveMerger(tmp_path / "live")
    for name in "ab":
        merger.get_robot(name, "map").add_scan(np.random.default_rng(0).uniform(-3, 3, (50, 3)), np.eye(4))
    merger.links["a", "b"] = LiveLink(("a", "b"), Sim3(0.0, (1.0, 2.0, 0.0)), 0.97)
    merger.save()

    def watch(graph: Graph) -> Iterator[None]:
        yield from wait(lambda: bool(graph.published))

    graph = Graph({"robots": ["a=/a/scan", "b=/b/scan"], "folder": str(tmp_path / "live")}, watch)
    assert run_node(graph, monkeypatch) == 0
    ((topic, message),) = graph.published
    assert topic == "/topomerge/transforms" and graph.profiles[topic] == LATCHED
    (edge,) = message.transforms
    assert (edge.header.frame_id, edge.child_frame_id) == ("a/map", "b/map") and edge.transform.translation.y == 2.0


@pytest.mark.parametrize("error", [RuntimeError("a fault"), InputError("no space left")])
def test_the_node_ends_when_its_worker_dies(
    error: Exception, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(self: Bridge, source: Any) -> None:
        raise error

    def idle(graph: Graph) -> Iterator[None]:
        yield from wait(lambda: False)

    monkeypatch.setattr(Bridge, "run", fail)
    monkeypatch.setattr(threading, "excepthook", lambda args: None)
    assert run_node(Graph({"folder": str(tmp_path)}, idle), monkeypatch) == 1
    assert capsys.readouterr().err == f"topomerge: {error}\n"


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"robots": ["a"]}, "robot a: must be NAME=SCANS"),
        ({"robots": ["a=/s", "b=/s"]}, "two have one topic of scans"),
        ({"robots": "a=/s"}, "of another type"),
        ({"folder": __file__}, "is a file"),
    ],
)
def test_wrong_parameters_are_told_in_a_line(
    parameters: dict[str, Any], reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_node(Graph({"folder": str(tmp_path), **parameters}), monkeypatch) == 1
    told = capsys.readouterr().err
    assert reason in told and told.count("\n") == 1 and "Traceback" not in told


def test_the_inbox_keeps_the_newest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = threading.Event()

    def hold(self: Bridge, source: Any) -> None:
        gate.wait(20)

    def flood(graph: Graph) -> Iterator[None]:
        put = graph.node.build_listener("/a/scan")
        for k in range(510):
            put(SimpleNamespace(number=k))
        assert graph.node.inbox.get_nowait().content.number == 10 and graph.node.bridge.counts["dropped"] == 10
        gate.set()
        yield

    monkeypatch.setattr(Bridge, "run", hold)
    assert run_node(Graph({"folder": str(tmp_path)}, flood), monkeypatch) == 0


def test_the_launch_file_declares_what_the_node_takes() -> None:
    launch, node = ((ROS / name).read_text() for name in ("topomerge.launch.py", "topomerge_node.py"))
    (given,) = (
        ast.literal_eval(n.value)
        for n in ast.parse(launch).body
        if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "DEFAULTS"
    )
    calls = (n for n in ast.walk(ast.parse(node)) if isinstance(n, ast.Call) and ast.unparse(n.func) == "self.declare_parameter")
    assert {ast.literal_eval(call.args[0]) for call in calls} == set(given)
