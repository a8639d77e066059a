"""Robots live: against a rosbridge server, a Foxglove server and an MCAP stream; hostile messages; stopped and gone on."""

from __future__ import annotations

import io
import json
import struct
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.fusion.atlas.atlas_scenes import office_map, stranger
from tests.fusion.live_robots import FRAMES, iter_messages, list_scans
from topomerge.cli.main import main as cli
from topomerge.errors import InputError
from topomerge.fusion.bridge import Bridge, PoseBook, RobotTopics, find_pose, parse_robot
from topomerge.fusion.live import LIVE, GrowingMap, LiveLink, LiveMerger, describe_event
from topomerge.io import streams
from topomerge.io.bag_file import Message
from topomerge.io.streams import FOXGLOVE, Connection, StreamCounts, build_message, read_foxglove, read_mcap, read_rosbridge
from topomerge.registration.prepared import prepare
from topomerge.types import Sim3

TOPICS = [RobotTopics(name, f"/{name}/points", (f"/{name}/odom",)) for name in FRAMES]
PARTS = {"a": 0, "b": 2}  # of the analytic office
TRUE = FRAMES["a"] @ FRAMES["b"].inverse()  # of b's frame in a's


def make_bridge(folder: Path, **words: Any) -> tuple[Bridge, list[Mapping[str, Any]]]:
    told: list[Mapping[str, Any]] = []
    return Bridge(LiveMerger(folder), TOPICS, told.append, **{"every": 1e9, **words}), told


def check_joined(bridge: Bridge) -> None:
    """Is b joined with a where it is?"""
    ((parent, child, pose),) = bridge.merger.list_transforms()
    assert (parent, child) == ("a/odom", "b/odom")
    middle = bridge.merger.prepared["b"].middle[None]
    assert np.allclose(pose.apply(middle), TRUE.apply(middle), atol=0.2) and abs(pose.yaw - TRUE.yaw) % (2 * np.pi) < 0.03


@contextmanager
def serve(handle: Any, **words: Any) -> Iterator[str]:
    """A websocket server on a port of its own."""
    from websockets.sync.server import serve as start

    with start(handle, "127.0.0.1", 0, **words) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join(10)


@pytest.fixture(autouse=True)
def hasten(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server that is gone is given up at once."""
    monkeypatch.setattr(streams, "PAUSES", (0.01, 0.02))
    monkeypatch.setattr(streams, "PATIENCE", 0.0)


def run_with_rosbridge(bridge: Bridge, address: str) -> StreamCounts:
    counts = StreamCounts()
    with Connection(address, (), bridge.outbox, bridge.greet) as connection:
        bridge.run(read_rosbridge(connection, bridge.list_topics(), counts))
    return counts


def read_subscriptions(link: Any, count: int) -> list[dict[str, Any]]:
    """The next subscriptions; what is advertised comes before them."""
    asked: list[dict[str, Any]] = []
    while len(asked) < count:
        operation = json.loads(link.recv(timeout=20))
        asked += [operation] if operation["op"] == "subscribe" else []
    return asked


@pytest.mark.longer
def test_two_robots_are_joined_over_rosbridge(tmp_path: Path) -> None:
    def handle(link: Any) -> None:
        asked = read_subscriptions(link, 4)
        assert {a["topic"] for a in asked} == {"/a/points", "/a/odom", "/b/points", "/b/odom"}
        for topic, content in iter_messages():
            link.send(json.dumps({"op": "publish", "topic": topic, "msg": content}))

    bridge, told = make_bridge(tmp_path / "live")  # one update at the beginning, one at the end
    with serve(handle) as address:
        counts = run_with_rosbridge(bridge, address)
    assert next(e["event"] for e in told if e["event"] != "settle") == "joined" and "a and b: joined" in describe_event(told[-1])
    check_joined(bridge)
    assert make_bridge(tmp_path / "live")[0].merger.links.keys() == bridge.merger.links.keys()
    assert counts.broken == 0 and bridge.counts["taken"] > 20 and not bridge.counts["broken"]
    edge = bridge.greet()[-1]["msg"]["transforms"][0]  # what a server is sent, as `test_bridge_kept.py` tries
    assert edge["header"]["frame_id"] == "a/odom" and edge["child_frame_id"] == "b/odom"


def take_all(bridge: Bridge, messages: list[tuple[str, dict[str, Any]]]) -> None:
    for n, (topic, content) in enumerate(messages):
        bridge.take(build_message(topic, content, n))


def test_a_start_after_a_stop_goes_on(tmp_path: Path) -> None:
    messages = list(iter_messages(12))
    bridge, _ = make_bridge(tmp_path)
    take_all(bridge, messages[:24])
    bridge.merger.links["a", "b"] = LiveLink(("a", "b"), TRUE, 0.97)
    bridge.merger.save()
    again, _ = make_bridge(tmp_path)
    assert again.merger.robots["a"].frame == "a/odom" and again.merger.links["a", "b"].probability == 0.97
    assert len(again.merger.robots["a"].points) == len(bridge.merger.robots["a"].points) > 1000
    check_pose = again.merger.links["a", "b"].pose
    assert np.allclose(check_pose.matrix, TRUE.matrix)
    take_all(again, messages[24:])
    whole, _ = make_bridge(tmp_path / "whole")
    take_all(whole, messages)
    for name in FRAMES:
        assert np.array_equal(again.merger.robots[name].keys, whole.merger.robots[name].keys)
    assert set(again.merger.take_changed()) == {"a", "b"}


@pytest.mark.longer
def test_a_join_is_taken_back_when_evidence_turns(tmp_path: Path) -> None:
    merger = LiveMerger(tmp_path)
    for name, k in PARTS.items():
        merger.get_robot(name)
        merger.maps[name], merger.prepared[name] = office_map(k), prepare(office_map(k))
    (event,) = merger._register("a", "b")
    assert event["event"] == "joined" and np.array(event["matrix"]).shape == (4, 4)
    assert merger._register("a", "b") == []
    merger.prepared["b"] = prepare(stranger())
    (event,) = merger._register("a", "b")
    assert event["event"] == "parted" and not merger.links and merger.list_transforms() == []


@pytest.mark.longer
def test_an_open_join_names_what_would_settle_it_once(tmp_path: Path) -> None:
    merger = LiveMerger(tmp_path, replace(LIVE, join=1.01, open=0.0))
    for name, k in PARTS.items():
        merger.get_robot(name)
        merger.maps[name], merger.prepared[name] = office_map(k), prepare(office_map(k))
    (event,) = merger._register("a", "b")
    assert event["event"] == "settle" and event["next"]["robot"] in PARTS and event["next"]["action"] in ("visit", "read both")
    assert "may belong together" in describe_event(event) and merger._register("a", "b") == []


def test_frames_hang_in_one_tree_by_the_surest_links(tmp_path: Path) -> None:
    merger = LiveMerger(tmp_path)
    for name in "abcd":
        merger.get_robot(name, f"{name}/odom")
    ab, bc = Sim3(0.5, (1.0, 2.0, 0.0)), Sim3(-1.0, (0.0, 3.0, 0.1))
    for pair, pose, p in ((("a", "b"), ab, 0.99), (("b", "c"), bc, 0.95), (("a", "c"), Sim3(), 0.91)):
        merger.links[pair] = LiveLink(pair, pose, p)
    assert merger.list_transforms() == [("a/odom", "b/odom", ab), ("b/odom", "c/odom", bc)]


def test_memory_is_bounded_and_standing_scans_are_left_out() -> None:
    robot = GrowingMap("odom", replace(LIVE, most_points=300))
    rng, pose = np.random.default_rng(0), np.eye(4)
    assert robot.add_scan(rng.uniform(-5, 5, (200, 3)), pose) and not robot.add_scan(rng.uniform(-5, 5, (200, 3)), pose)
    assert (np.diff(robot.keys) > 0).all() and len(robot.points) == len(robot.pose_of) == len(robot.keys)
    for k in range(20):
        pose[0, 3] = k + 1.0
        robot.add_scan(np.vstack([rng.uniform(-5, 5, (200, 3)), [[np.nan, 0, 0], [np.inf, 0, 0], [1e9, 0, 0]]]), pose)
    assert len(robot.points) == 300 and robot.left_out > 3000 and len(robot.poses) <= 3 and np.isfinite(robot.points).all()
    book = PoseBook(held=50)
    turn = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    for k in range(1000):
        assert book.add("odom", "base", 0.1 * k, SimpleNamespace(x=float(k), y=0.0, z=0.0), turn)
    assert len(book._edges["base"][1]) <= 51
    place = SimpleNamespace(x=0.0, y=0.0, z=0.0)
    assert sum(book.add("odom", f"frame {k}", 0.0, place, turn) for k in range(2 * book.FRAMES)) == book.FRAMES - 1


def test_poses_are_interpolated_chained_and_old_ones_refused() -> None:
    book, turn = PoseBook(), SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    for k in range(5):
        book.add("odom", "base", 0.2 * k, SimpleNamespace(x=float(k), y=0.0, z=0.0), turn)
    assert book.add("base", "laser", 0.0, SimpleNamespace(x=0.0, y=0.0, z=0.5), turn, static=True)
    found = find_pose([book], "laser", 0.3)
    assert found is not None and found.frame == "odom" and np.allclose(found.pose[:3, 3], [1.5, 0, 0.5])
    assert find_pose([book], "laser", 3.0) is None and find_pose([book], "nothing", 0.3) is None
    nan = SimpleNamespace(x=np.nan, y=0.0, z=0.0)
    assert not book.add("odom", "base", 9.0, nan, turn) and not book.add("base", "base", 9.0, nan, turn)


HOSTILE: list[Any] = [
    {"op": "publish", "topic": "/a/points"},
    {"op": "publish", "topic": "/a/points", "msg": None},
    {"op": "publish", "topic": "/a/points", "msg": {"ranges": "x", "angle_min": 0}},
    {"op": "publish", "topic": "/a/points", "msg": {"fields": [], "point_step": 0, "data": "!!", "header": {}}},
    {"op": "publish", "topic": "/a/odom", "msg": {"pose": {"pose": {"position": {}, "orientation": {}}}, "child_frame_id": ""}},
    {"op": "publish", "topic": "/a/odom", "msg": {"transforms": [None] * 5}},
    {"op": "publish", "topic": ["deep"], "msg": {}},
    ["no object"],
    "text",
]


def test_hostile_messages_are_counted_and_the_stream_goes_on(tmp_path: Path) -> None:
    deep = "[" * 400 + "]" * 400
    texts = [json.dumps(h) for h in HOSTILE] + [
        "no json",
        f'{{"op": "publish", "topic": "/a/points", "msg": {deep}}}',
        "{}",
    ]

    def handle(link: Any) -> None:
        read_subscriptions(link, 4)
        for text in texts:
            link.send(text)
        link.send(b"\x00\xff\xfe")
        for topic, content in iter_messages(2):
            link.send(json.dumps({"op": "publish", "topic": topic, "msg": content}))

    bridge, _ = make_bridge(tmp_path)
    with serve(handle) as address:
        counts = run_with_rosbridge(bridge, address)
    assert counts.broken >= 7 and bridge.counts["taken"] == 4, bridge.counts and not bridge.merger.links


def test_a_message_that_is_too_large_ends_the_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "LARGEST_MESSAGE", 1000)

    def handle(link: Any) -> None:
        read_subscriptions(link, 4)
        link.send("x" * 5000)

    bridge, told = make_bridge(tmp_path)
    with serve(handle) as address:
        run_with_rosbridge(bridge, address)
    assert told == []


@pytest.mark.parametrize("protocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
def test_foxglove_channels_are_read(protocol: str) -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    time = types["builtin_interfaces/msg/Time"](sec=3, nanosec=0)
    head = types["std_msgs/msg/Header"](stamp=time, frame_id="laser")
    scan = types["sensor_msgs/msg/LaserScan"](head, 0.0, 1.0, 0.5, 0.0, 0.1, 0.1, 9.0, np.ones(3, "f4"), np.zeros(0, "f4"))
    data = bytes(store.serialize_cdr(scan, scan.__msgtype__))

    def handle(link: Any) -> None:
        offered = {"id": 7, "topic": "/scan", "encoding": "cdr", "schemaName": "sensor_msgs/msg/LaserScan", "schema": ""}
        link.send(json.dumps({"op": "advertise", "channels": [offered, {"id": 8, "topic": "/other", "encoding": "cdr"}]}))
        (asked,) = read_subscriptions(link, 1)
        assert asked["subscriptions"] == [{"id": 1, "channelId": 7}]
        link.send(struct.pack("<BIQ", 1, 1, 4_000_000_000) + data)
        link.send(struct.pack("<BIQ", 1, 1, 4_000_000_000) + data[:9])
        link.send(b"\x01")

    with serve(handle, subprotocols=[protocol]) as address, Connection(address, FOXGLOVE) as connection:
        counts = StreamCounts()
        (message,) = [m for m in read_foxglove(connection, ["/scan"], counts) if m is not None]
    assert message.topic == "/scan" and np.allclose(message.content.ranges, 1.0) and message.recorded == 4.0
    assert counts == StreamCounts(1, 2)


def build_recording(path: Path) -> bytes:
    """A recording of a laser by the library itself."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=store)
        for k in range(5):
            time = types["builtin_interfaces/msg/Time"](sec=k + 1, nanosec=0)
            head = types["std_msgs/msg/Header"](stamp=time, frame_id="laser")
            scan = types["sensor_msgs/msg/LaserScan"](
                head, 0.0, 1.0, 0.5, 0.0, 0.1, 0.1, 9.0, np.full(3, k, "f4"), np.zeros(0, "f4")
            )
            writer.write(connection, (k + 1) * 10**9, store.serialize_cdr(scan, scan.__msgtype__))
    return next(path.glob("*.mcap")).read_bytes()


def test_mcap_is_read_as_a_stream_and_may_end_anywhere(tmp_path: Path) -> None:
    data = build_recording(tmp_path / "bag")
    counts = StreamCounts()
    messages: list[Message] = [m for m in read_mcap(io.BytesIO(data), ["/scan"], counts) if m is not None]
    assert [float(m.content.ranges[0]) for m in messages] == [0, 1, 2, 3, 4] and counts == StreamCounts(5, 0)
    assert list(read_mcap(io.BytesIO(data), ["/other"], counts)) == []
    rng = np.random.default_rng(0)
    for length in rng.integers(8, len(data), 20).tolist():
        list(read_mcap(io.BytesIO(data[:length]), ["/scan"], StreamCounts()))
    for _ in range(40):
        broken = bytearray(data)
        for at in rng.integers(8, len(data), 3).tolist():
            broken[at] = int(rng.integers(256))
        with suppress(InputError):  # a record that claims too much
            list(read_mcap(io.BytesIO(bytes(broken)), ["/scan"], StreamCounts()))
    with pytest.raises(InputError, match="is no MCAP"):
        list(read_mcap(io.BytesIO(b"#ROSBAG V2.0"), ["/scan"], StreamCounts()))


def test_grids_of_robots_take_the_place_of_those_before(tmp_path: Path) -> None:
    cells = np.full((60, 80), -1)
    cells[5:55, 5:75] = 0
    cells[[5, 54], 5:75] = cells[5:55, [5]] = cells[5:55, [74]] = 100
    origin = {"position": {"x": 1.0, "y": 2.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    info = {"resolution": 0.05, "width": 80, "height": 60, "origin": origin}
    content = {"header": {"stamp": stamp(), "frame_id": "a/map"}, "info": info, "data": cells.ravel().tolist()}
    bridge = Bridge(LiveMerger(tmp_path), [RobotTopics("a", "/a/map")], lambda event: None)
    for k in range(2):
        bridge.take(build_message("/a/map", content, k))
    assert bridge.counts["taken"] == 2 and bridge.merger.robots["a"].frame == "a/map"
    grid = bridge.merger.robots["a"].grid
    assert grid is not None and grid.points[:, 0].min() == pytest.approx(1.275, abs=0.05)


def stamp() -> dict[str, int]:
    return {"sec": 1, "nanosec": 0}


def test_a_damaged_state_is_told(tmp_path: Path) -> None:
    bridge, _ = make_bridge(tmp_path)
    take_all(bridge, list(iter_messages(3)))
    bridge.merger.save()
    state = (tmp_path / "bridge.json").read_text()
    for text in ("{", state.replace('"format": 1', '"format": 9'), state.replace('"a"', '"../a"'), "[]"):
        (tmp_path / "bridge.json").write_text(text)
        with pytest.raises(InputError, match=r"bridge\.json: damaged|another version|a name may have"):
            LiveMerger(tmp_path)
    (tmp_path / "bridge.json").write_text(state)
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(InputError, match=r"a\.npz: damaged"):
        LiveMerger(tmp_path)


def test_words_of_the_command_are_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert parse_robot("a=/scan,/odom").poses == ("/odom", "/tf", "/tf_static")
    for text in ("a", "=x", "a=", "a=/s,"):
        with pytest.raises(InputError, match="must be NAME=SCANS"):
            parse_robot(text)
    assert cli(["bridge", "-o", str(tmp_path / "x"), "--robot", "a=/s"]) == 1
    assert cli(["bridge", "-o", str(tmp_path / "x"), "--mcap"]) == 1
    assert cli(["bridge", "-o", str(tmp_path / "x"), "--robot", "a=/s", "--rosbridge", "http://x"]) == 1
    assert cli(["bridge", "-o", str(tmp_path / "x"), "--robot", "a=/s", "--robot", "a=/t", "--mcap"]) == 1
    assert cli(["bridge", "-o", str(tmp_path / "x"), "--robot", "a=/s", "--rosbridge", "ws://127.0.0.1:1"]) == 1
    told = capsys.readouterr().err
    assert (
        "one of --rosbridge" in told
        and "is no websocket" in told
        and "two have one name" in told
        and "no websocket server" in told
    )


def test_too_many_robots_are_refused(tmp_path: Path) -> None:
    merger = LiveMerger(tmp_path, replace(LIVE, most_robots=1))
    merger.get_robot("a")
    for name in ("b", "../a", "", "x" * 99):
        with pytest.raises(InputError, match=r"one too many|a name may have"):
            merger.get_robot(name)


def test_scans_of_the_robots_are_their_sensors() -> None:
    time, pose, points = list_scans("a")[0]
    assert time == 0.0 and pose.shape == (4, 4) and len(points) > 100
