"""Robots live, over hours: connections that are lost, state that is kept, folders of others, frames of one name, full maps."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.fusion.test_bridge import build_recording, serve, stamp
from topomerge.cli.main import main as cli
from topomerge.errors import InputError
from topomerge.fusion.bridge import Bridge, MixedPosesError, parse_robot, parse_robots
from topomerge.fusion.live import LIVE, LiveLink, LiveMerger, describe_event
from topomerge.io import streams
from topomerge.io.bag_file import Message
from topomerge.io.streams import FOXGLOVE, Connection, StreamCounts, build_message, read_foxglove, read_rosbridge
from topomerge.types import PointCloud, Sim3

EVENT = {"event": "joined", "robots": ["a", "b"], "probability": 0.97, "matrix": np.eye(4).tolist()}


@pytest.fixture(autouse=True)
def hasten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "PAUSES", (0.01, 0.04))
    monkeypatch.setattr(streams, "PATIENCE", 20.0)
    monkeypatch.setattr(streams, "WAIT", 0.02)


def make_bridge(folder: Path, *robots: str, **words: Any) -> tuple[Bridge, list[Mapping[str, Any]]]:
    told: list[Mapping[str, Any]] = []
    return Bridge(LiveMerger(folder), parse_robots(robots or ("a=/a/scan", "b=/b/scan")), told.append, **words), told


def build_scan(frame: str, time: float = 0.0) -> dict[str, Any]:
    """A scan of a laser in a place of its own, so that it is new at every place."""
    head = {"stamp": {"sec": 1, "nanosec": round(time * 1e9)}, "frame_id": frame}
    limits = {"angle_min": 0.0, "angle_max": 6.2, "angle_increment": 0.1, "range_min": 0.1, "range_max": 9.0}
    return {"header": head, **limits, "time_increment": 0.0, "scan_time": 0.0, "ranges": [3.0] * 62, "intensities": []}


def build_transforms(*edges: tuple[str, str], x: float = 0.0) -> dict[str, Any]:
    turn = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    where = {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": turn}
    return {
        "transforms": [{"header": {"stamp": stamp(), "frame_id": p}, "child_frame_id": c, "transform": where} for p, c in edges]
    }


def send_scan(link: Any, topic: str) -> None:
    link.send(json.dumps({"op": "publish", "topic": topic, "msg": build_scan("laser")}))


def test_a_lost_connection_is_opened_again_and_told_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The server closes while the topics are asked for, twice; then it is there again, and topics are asked for again."""
    times: list[int] = []

    def handle(link: Any) -> None:
        times.append(len(times))
        if len(times) < 3:
            return
        while json.loads(link.recv(timeout=20)) != {"op": "subscribe", "topic": "/a/scan"}:
            pass
        for _ in range(3):
            send_scan(link, "/a/scan")
        link.recv(timeout=20)

    with serve(handle) as address, Connection(address) as connection:
        messages = (m for m in read_rosbridge(connection, ["/a/scan", "/tf"], StreamCounts()) if m is not None)
        assert [next(messages).topic for _ in range(3)] == ["/a/scan"] * 3 and len(times) == 3
    assert [r.levelname for r in caplog.records if "is lost" in r.message] == ["WARNING"]


def test_a_connection_is_given_up_after_a_while(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(streams, "PATIENCE", 0.2)
    with serve(lambda link: None) as address:
        connection = Connection(address)
    with connection:
        assert set(connection.receive()) == {None}
    assert [r.message.split(": ")[-1] for r in caplog.records][-1] == "is given up; start again with the same folder to go on"


def test_topics_that_are_not_there_yet_are_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "ASK_AGAIN", 0.05)
    asked: list[str] = []

    def handle(link: Any) -> None:
        while asked.count("/b/scan") < 3:
            asked.append(json.loads(link.recv(timeout=20))["topic"])
            if asked == ["/a/scan", "/b/scan"]:
                send_scan(link, "/a/scan")
        send_scan(link, "/b/scan")
        link.recv(timeout=20)

    with serve(handle) as address, Connection(address) as connection:
        messages = (m for m in read_rosbridge(connection, ["/a/scan", "/b/scan"], StreamCounts()) if m is not None)
        assert [next(messages).topic for _ in range(2)] == ["/a/scan", "/b/scan"]
    assert asked.count("/a/scan") <= 2


def test_events_of_the_last_update_are_sent_before_closing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C comes while an update runs: what it finds is told, kept and sent."""
    heard: list[dict[str, Any]] = []
    begun, stopped = threading.Event(), threading.Event()

    def handle(link: Any) -> None:
        send_scan(link, "/a/scan")
        heard.extend(json.loads(text) for text in link)
        stopped.set()

    def update(self: LiveMerger, clouds: Any = None) -> list[dict[str, Any]]:
        begun.set()
        self.links["a", "b"] = LiveLink(("a", "b"), Sim3(), 0.97)
        return [EVENT]

    def interrupt() -> Any:
        for received in connection.receive():
            if begun.is_set():
                raise KeyboardInterrupt
            yield None if received is None else Message("/other", 0, 0.0, SimpleNamespace())

    bridge, told = make_bridge(tmp_path / "live")
    bridge.merger.get_robot("a", "a/map").grid = PointCloud(np.zeros((3, 3), np.float32))
    bridge.merger.robots["a"].changed = True
    monkeypatch.setattr(LiveMerger, "update", update)
    with serve(handle) as address:
        with pytest.raises(KeyboardInterrupt), Connection(address, (), bridge.outbox, bridge.greet) as connection:
            bridge.run(interrupt())
        assert stopped.wait(20)
    assert told == [EVENT] and not bridge.outbox
    assert [h["topic"] for h in heard if h["op"] == "publish"] == ["/topomerge/events", "/topomerge/transforms"]
    assert [h["latch"] for h in heard if h["op"] == "advertise"] == [False, True]


@pytest.mark.parametrize(("protocols", "offered", "reason"), [
    (FOXGLOVE, ["other.v2"], r"refuses \(.*\); is it one that speaks foxglove\.sdk\.v1 or foxglove\.websocket\.v1\?"),
    (FOXGLOVE, None, r"took none of the subprotocols .*; is it one that speaks foxglove\.sdk\.v1"),
    ((), ["foxglove.sdk.v1"], r"refuses \(.*\); is it rosbridge\?"),
])  # fmt: skip
def test_a_server_of_another_protocol_is_named(protocols: Any, offered: Any, reason: str) -> None:
    with serve(lambda link: None, subprotocols=offered) as address, pytest.raises(InputError, match=reason):
        Connection(address, protocols)


def test_foxglove_channels_that_come_again_are_read_again() -> None:
    def handle(link: Any) -> None:
        offer = {"topic": "/scan", "encoding": "cdr", "schemaName": "sensor_msgs/msg/LaserScan", "schema": ""}
        for number in (1, 2):
            link.send(json.dumps({"op": "advertise", "channels": [{**offer, "id": number}]}))
            asked.append(json.loads(link.recv(timeout=20))["subscriptions"][0])
            link.send(json.dumps({"op": "unadvertise", "channelIds": [number]}))
        done.set()

    asked: list[dict[str, int]] = []
    done = threading.Event()
    with serve(handle, subprotocols=["foxglove.sdk.v1"]) as address, Connection(address, FOXGLOVE) as connection:
        messages = read_foxglove(connection, ["/scan"], StreamCounts())
        while not done.is_set():
            next(messages)
    assert asked == [{"id": 1, "channelId": 1}, {"id": 2, "channelId": 2}]


def test_a_robot_that_drives_alone_is_kept_once_a_minute(tmp_path: Path) -> None:
    bridge, _ = make_bridge(tmp_path / "live", every=0.0)
    rng = np.random.default_rng(0)
    for k in range(3):
        pose = np.eye(4)
        pose[0, 3] = k
        bridge.merger.get_robot("a", "odom").add_scan(rng.uniform(-5, 5, (50, 3)), pose)
        bridge._since_saved._started -= 40.0
        bridge._finish([], 0.0)
        assert (tmp_path / "live" / "bridge.json").exists() == (k > 0)
    assert len(LiveMerger(tmp_path / "live").robots["a"].poses) == 2


def test_a_failed_update_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: LiveMerger, clouds: Any = None) -> Any:
        raise RuntimeError("a fault")

    bridge, _ = make_bridge(tmp_path / "live")
    bridge.merger.get_robot("a", "map").grid = PointCloud(np.ones((4, 3), np.float32))
    bridge.merger.robots["a"].changed = True
    monkeypatch.setattr(LiveMerger, "update", fail)
    with pytest.raises(RuntimeError, match="a fault"):
        bridge.run(iter([None, None]))
    assert (tmp_path / "live" / "bridge.json").exists()


def test_grids_are_kept(tmp_path: Path) -> None:
    merger = LiveMerger(tmp_path)
    points = np.random.default_rng(0).uniform(0, 5, (40, 3)).astype(np.float32)
    merger.set_grid("a", PointCloud(points, upright=True), "map")
    merger.save()
    again = LiveMerger(tmp_path)
    (cloud,) = again.take_changed().values()
    assert np.array_equal(cloud.points, points) and cloud.upright and again.robots["a"].frame == "map"
    assert "b" not in LiveMerger(tmp_path).robots


def test_only_what_is_new_is_written(tmp_path: Path) -> None:
    merger = LiveMerger(tmp_path)
    for name in "ab":
        merger.get_robot(name, name).add_scan(np.eye(3), np.eye(4))
    merger.save()
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    pose = np.eye(4)
    pose[0, 3] = 2.0
    merger.robots["b"].add_scan(np.eye(3), pose)
    merger.save()
    after = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    assert before["a.npz"] == after["a.npz"] and before["b.npz"] != after["b.npz"]
    assert len(LiveMerger(tmp_path).robots["b"].poses) == 2


def test_the_folder_is_checked_before_anything_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, house = tmp_path / "a.tmap", tmp_path / "house"
    file.write_text("map")
    house.mkdir()
    (house / "atlas.json").write_text("{}")
    words = ["--robot", "a=/s", "--rosbridge", "ws://127.0.0.1:1"]
    for folder, reason in ((file, "is a file"), (house, "holds something else"), (tmp_path / "new", "no websocket server")):
        assert cli(["bridge", "-o", str(folder), *words]) == 1
        told = capsys.readouterr().err
        assert reason in told and told.count("\n") == 1
    assert [p.name for p in house.iterdir()] == ["atlas.json"] and not (tmp_path / "new").exists()


HOLD = """
import sys
from pathlib import Path
from topomerge.fusion.live import hold_state
with hold_state(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_bridge_on_a_folder_is_refused_until_the_first_one_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The lock goes with its process, also where that is killed."""
    live, words = tmp_path / "live", ["--robot", "a=/scan", "--mcap"]
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO()))
    first = subprocess.Popen([sys.executable, "-c", HOLD, str(live)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert first.stdout is not None and first.stdout.readline() == "held\n"
    assert cli(["bridge", "-o", str(live), *words]) == 1
    told = capsys.readouterr().err
    assert "live: is kept by another bridge or ROS node that runs; end that, or give another folder" in told
    assert told.count("\n") == 1 and live.exists()
    first.kill()
    first.communicate(timeout=60)
    assert cli(["bridge", "-o", str(live), *words]) == 1 and "is no MCAP" in capsys.readouterr().err
    assert list(live.iterdir()) == []


def test_a_stream_of_nothing_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = build_recording(tmp_path / "bag")
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(data)))
    assert cli(["bridge", "-o", str(tmp_path / "live"), "--robot", "a=/other", "--mcap"]) == 2
    assert "nothing came; 0 unreadable (nothing is written)" in capsys.readouterr().err and not (tmp_path / "live").exists()


def test_frames_of_one_name_are_told_apart(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    merger = LiveMerger(tmp_path)
    for name, frame in (("a", "map"), ("b", "map"), ("c", "c/odom")):
        merger.get_robot(name, frame)
    pose = Sim3(0.5, (1.0, 2.0, 0.0))
    for pair in (("a", "b"), ("a", "c")):
        merger.links[pair] = LiveLink(pair, pose, 0.99)
    for _ in range(2):
        assert merger.list_transforms() == [("a/map", "b/map", pose), ("a/map", "c/odom", pose)]
    assert [r.message for r in caplog.records] == ["robots a, b: their frames have one name; published as a/map, b/map"]


def take(bridge: Bridge, topic: str, content: dict[str, Any]) -> None:
    bridge.take(build_message(topic, content, 1))


def test_transforms_under_one_name_are_refused_where_they_come_together(tmp_path: Path) -> None:
    bridge, _ = make_bridge(tmp_path / "live")

    def receive() -> Any:
        for topic, content in (("/tf", build_transforms(("odom", "base"), ("base", "laser"))), ("/a/scan", build_scan("laser"))):
            yield build_message(topic, content, 1)
        yield build_message("/b/scan", build_scan("laser"), 1)

    with pytest.raises(MixedPosesError, match="robots a and b: poses of both come as those of 'laser'.*name topics of their own"):
        bridge.run(receive())
    assert bridge.counts["broken"] == 0 and not (tmp_path / "live").exists()  # what was mixed is not kept


def test_transforms_of_topics_of_their_own_are_told_apart(tmp_path: Path) -> None:
    bridge, _ = make_bridge(tmp_path, "a=/a/scan,/a/tf", "b=/b/scan,/b/tf")
    assert bridge.list_topics() == ["/a/scan", "/a/tf", "/a/tf_static", "/b/scan", "/b/tf", "/b/tf_static"]
    for name, x in (("a", 1.0), ("b", 50.0)):
        take(bridge, f"/{name}/tf_static", build_transforms(("base", "laser")))
        take(bridge, f"/{name}/tf", build_transforms(("map", "base"), x=x))
    for name in "ab":
        take(bridge, f"/{name}/scan", build_scan("laser"))
    places = {name: float(robot.poses[0, 0]) for name, robot in bridge.merger.robots.items()}
    assert places == {"a": 1.0, "b": 50.0}


def test_robots_may_share_transforms_of_names_of_their_own(tmp_path: Path) -> None:
    """Also where their maps stand in one frame that moves; and their own odometry comes before shared transforms."""
    bridge, _ = make_bridge(tmp_path)
    take(bridge, "/tf", build_transforms(("earth", "map"), ("map", "a/base"), ("map", "b/base"), x=2.0))
    for name in "ab":
        take(bridge, "/tf_static", build_transforms((f"{name}/base", f"{name}/laser")))
        take(bridge, f"/{name}/scan", build_scan(f"{name}/laser"))
    assert {r.frame for r in bridge.merger.robots.values()} == {"earth"} and bridge.counts["taken"] == 2
    bridge, _ = make_bridge(tmp_path, "a=/a/scan,/a/odom", "b=/b/scan")
    take(bridge, "/tf", build_transforms(("odom", "base"), ("base", "laser"), x=9.0))
    where = {"position": {"x": 1.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    own = {"header": {"stamp": stamp(), "frame_id": "a/odom"}, "child_frame_id": "base", "pose": {"pose": where}}
    take(bridge, "/a/odom", own)
    take(bridge, "/a/scan", build_scan("base"))
    assert bridge.merger.robots["a"].poses.tolist() == [[1.0, 0.0, 0.0]]


def test_a_map_stays_in_its_frame(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """A frame above it that comes within the first scans is taken; later the map goes on in its own."""
    bridge, _ = make_bridge(tmp_path, "a=/a/scan")

    def drive(first: int, last: int, *more: tuple[str, str]) -> None:
        for k in range(first, last):
            tf = build_transforms(*more, ("odom", "laser"), x=float(k))
            for edge in tf["transforms"]:
                edge["header"]["stamp"] = {"sec": 1, "nanosec": k * 10**7}
            take(bridge, "/tf", tf)
            take(bridge, "/a/scan", build_scan("laser", 0.01 * k))

    drive(0, 2)
    assert bridge.merger.robots["a"].frame == "odom" and len(bridge.merger.robots["a"].poses) == 2
    drive(2, 6, ("map", "odom"))
    robot = bridge.merger.robots["a"]
    assert robot.frame == "map" and robot.poses[:, 0].tolist() == [4.0, 6.0, 8.0, 10.0]
    drive(6, 8, ("map", "odom"), ("earth", "map"))
    assert bridge.merger.robots["a"] is robot and robot.frame == "map" and len(robot.poses) == 6
    other, _ = make_bridge(tmp_path / "other", "a=/a/scan")
    other.merger.robots["a"] = robot
    robot.frame = "elsewhere"
    for _ in range(2):
        take(other, "/tf", build_transforms(("odom", "laser")))
        take(other, "/a/scan", build_scan("laser"))
    assert other.counts["taken"] == 0 and [r.message for r in caplog.records] == [
        "robot a: poses are in 'odom', its map in 'elsewhere'; scans wait for poses in that"
    ]


def test_a_full_map_is_told_once(tmp_path: Path) -> None:
    told: list[Mapping[str, Any]] = []
    bridge = Bridge(LiveMerger(tmp_path, replace(LIVE, most_points=70)), parse_robots(["a=/a/scan"]), told.append)
    for k in range(4):
        take(bridge, "/tf", build_transforms(("odom", "laser"), x=float(k)))
        take(bridge, "/a/scan", build_scan("laser"))
        bridge._own_books["a"][0]._edges.clear()
    assert told == [{"event": "full", "robots": ["a"], "points": 70}]
    assert describe_event(told[0]).startswith("a: its map is full (70 points)")


def test_topics_are_named_as_robots_name_them() -> None:
    robot = parse_robot("a=scan, odom/ ,/a/tf")
    assert robot.scans == "/scan" and robot.poses == ("/odom", "/a/tf", "/a/tf_static")
    for texts, reason in (((), "name them"), (("a=/s", "b=s"), "one topic of scans"), (("a=/s", "a=/t"), "one name")):
        with pytest.raises(InputError, match=reason):
            parse_robots(texts)
