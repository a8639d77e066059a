"""Messages of robots while they come: MCAP over a stream, and the websockets of rosbridge and Foxglove.

Whatever comes is of strangers: messages, chunks and lines are limited, and what can't be read is counted and left out.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import IO, Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.bag_file import LASER_SCAN, OCCUPANCY_GRID, POINT_CLOUD, TRANSFORMS, Message

LARGEST_MESSAGE = 64 << 20  # bytes of a record, a chunk or a websocket message
LONGEST_ARRAY = 8_000_000  # numbers of an array of a message
ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
READ_LIVE = (LASER_SCAN, POINT_CLOUD, OCCUPANCY_GRID, TRANSFORMS, ODOMETRY, POSE)
MCAP_MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK = 3, 4, 5, 6  # kinds of records
FOXGLOVE = "foxglove.websocket.v1"
MOST_TRANSFORMS = 1000  # of a message
WAIT = 0.2  # s that a source waits for a message before it yields None
OPENING = 10.0  # s that a server may take to answer
MESSAGE_ERRORS = (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError, struct.error)
Received = Iterator[Message | None]  # None: nothing came for a while


@dataclass
class StreamCounts:
    """What a stream brought: messages that were read, and those that could not be."""

    read: int = 0
    broken: int = 0


def normalise_type(name: str) -> str:
    """Name of a type as ROS 2 writes it: ``sensor_msgs/msg/LaserScan``."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[-1]}"


SHAPES = (
    (LASER_SCAN, ("ranges", "angle_min")),
    (POINT_CLOUD, ("fields", "point_step", "data")),
    (OCCUPANCY_GRID, ("info", "data")),
    (TRANSFORMS, ("transforms",)),
    (ODOMETRY, ("pose", "child_frame_id")),
    (POSE, ("pose",)),
)


def infer_kind(content: Any) -> str:
    """Infer which of `READ_LIVE` a message is of by its fields: rosbridge does not tell.

    Raises:
        ValueError: of none.
    """
    for kind, names in SHAPES:
        if all(hasattr(content, name) for name in names):
            return kind
    raise ValueError("a message of another type")


def convert_message(value: Any, depth: int = 0) -> Any:
    """Convert the JSON of rosbridge to what decoders take: objects with attributes, arrays of numbers, bytes.

    Raises:
        ValueError: nested too deeply, or an array that is too long.
    """
    if depth > 12:
        raise ValueError("nested too deeply")
    if isinstance(value, dict):
        fields = {str(k): convert_message(v, depth + 1) for k, v in value.items()}
        if "secs" in fields or "nsecs" in fields:  # of ROS 1
            fields |= {"sec": fields.get("secs", 0), "nanosec": fields.get("nsecs", 0)}
        return SimpleNamespace(**fields)
    if isinstance(value, list):
        if len(value) > LONGEST_ARRAY:
            raise ValueError("an array is too long")
        if value and all(isinstance(v, int | float) or v is None for v in value):
            return np.array([np.nan if v is None else v for v in value], float)
        return [convert_message(v, depth + 1) for v in value]
    return value


def build_message(topic: str, content: Any, number: int) -> Message:
    """Build a message of converted JSON; data of a cloud comes as base64."""
    converted = convert_message(content)
    kind = infer_kind(converted)
    if kind == POINT_CLOUD and isinstance(converted.data, str):
        try:
            converted.data = base64.b64decode(converted.data, validate=True)
        except binascii.Error as error:
            raise ValueError("data is no base64") from error
    elif kind == POINT_CLOUD:
        converted.data = bytes(np.asarray(converted.data).astype(np.uint8))
    return Message(topic, number, 0.0, converted)


def read_rosbridge(
    address: str, topics: Collection[str], counts: StreamCounts, outbox: Callable[[], Sequence[Mapping[str, Any]]]
) -> Received:
    """Receive messages of a rosbridge server.

    Args:
        address: ``ws://host:9090``.
        topics: their names.
        outbox: operations to send, such as ``publish``, asked for between messages.

    Raises:
        InputError: nobody answers there.
    """
    with _connect(address, ()) as link:
        for topic in topics:
            link.send(json.dumps({"op": "subscribe", "topic": topic}))
        for text in _iter_received(link):
            for operation in outbox():
                link.send(json.dumps(operation))
            if text is None:
                yield None
                continue
            try:
                decoded = json.loads(text)
                if decoded.get("op") != "publish" or decoded.get("topic") not in topics:
                    continue
                message = build_message(decoded["topic"], decoded["msg"], counts.read + 1)
            except MESSAGE_ERRORS:
                counts.broken += 1
                continue
            counts.read += 1
            yield message


def read_foxglove(address: str, topics: Collection[str], counts: StreamCounts) -> Received:
    """Receive messages of a Foxglove websocket server, whose channels are CDR.

    Raises:
        InputError: nobody answers there.
    """
    requested: dict[int, tuple[str, str]] = {}
    with _connect(address, (FOXGLOVE,)) as link:
        for received in _iter_received(link):
            if received is None:
                yield None
                continue
            try:
                if isinstance(received, str):
                    decoded = json.loads(received)
                    offered = decoded.get("channels", []) if decoded.get("op") == "advertise" else []
                    new = [
                        c for c in offered if c["topic"] in topics and c.get("encoding") == "cdr" and len(requested) < len(topics)
                    ]
                    for channel in new:
                        requested[len(requested) + 1] = channel["topic"], normalise_type(channel["schemaName"])
                        subscription = {"id": len(requested), "channelId": int(channel["id"])}
                        link.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
                    continue
                code, number, nanoseconds = struct.unpack_from("<BIQ", received)
                if code != 1 or number not in requested:
                    continue
                topic, kind = requested[number]
                message = Message(topic, counts.read + 1, nanoseconds * 1e-9, deserialise(bytes(received[13:]), kind))
            except MESSAGE_ERRORS:
                counts.broken += 1
                continue
            counts.read += 1
            yield message


def _connect(address: str, protocols: Sequence[str]) -> Any:
    try:
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol
    except ImportError as error:
        raise InputError("a websocket needs websockets: pip install 'topomerge[studio]'") from error
    if not address.startswith(("ws://", "wss://")):
        raise InputError(f"{address}: is no websocket; give its address, as ws://localhost:9090")
    try:
        chosen = [Subprotocol(name) for name in protocols] or None
        return connect(address, subprotocols=chosen, max_size=LARGEST_MESSAGE, open_timeout=OPENING, close_timeout=1)
    except (OSError, WebSocketException, ValueError, TimeoutError) as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(f"{address}: no websocket server answers there ({reason}); is it running?") from error


def _iter_received(link: Any) -> Iterator[str | bytes | None]:
    from websockets.exceptions import ConnectionClosed

    while True:
        try:
            yield link.recv(timeout=WAIT)
        except TimeoutError:
            yield None
        except ConnectionClosed:
            return


@cache
def _get_typestore() -> Any:
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError("messages of ROS need rosbags: pip install 'topomerge[ros]'") from error
    return get_typestore(Stores.ROS2_HUMBLE)


def deserialise(data: bytes, kind: str) -> Any:
    """Deserialise CDR of one of `READ_LIVE`.

    Raises:
        ValueError: another type, or damaged.
    """
    if kind not in READ_LIVE:
        raise ValueError(f"{kind} is not read")
    store = _get_typestore()
    try:
        return store.deserialize_cdr(data, kind)
    except Exception as error:  # whatever the library says of damaged bytes
        raise ValueError("damaged message") from error


def read_mcap(stream: IO[bytes], topics: Collection[str], counts: StreamCounts) -> Received:
    """Receive messages of an MCAP recording that comes as a stream, such as standard input; it may end anywhere.

    Raises:
        InputError: it is no MCAP.
    """
    if stream.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
        raise InputError("standard input: is no MCAP; pipe a recording into it, such as `ros2 bag record -s mcap` writes")
    yield from _iter_records(stream, topics, counts, {}, {})


def _iter_records(
    stream: IO[bytes],
    topics: Collection[str],
    counts: StreamCounts,
    schemas: dict[int, str],
    channels: dict[int, tuple[str, str]],
) -> Received:
    while len(head := stream.read(9)) == 9:
        kind, length = struct.unpack("<BQ", head)
        if length > LARGEST_MESSAGE:
            raise InputError(f"standard input: a record of {length:,} bytes is too large (at most {LARGEST_MESSAGE:,})")
        data = stream.read(length)
        if len(data) < length:
            return
        try:
            if kind == SCHEMA:
                schemas[struct.unpack_from("<H", data)[0]] = normalise_type(_read_string(data, 2)[0])
            elif kind == CHANNEL:
                number, schema = struct.unpack_from("<HH", data)
                channels[number] = _read_string(data, 4)[0], schemas.get(schema, "")
            elif kind == CHUNK:
                yield from _iter_records(io.BytesIO(_unpack_chunk(data)), topics, counts, schemas, channels)
            elif kind == MESSAGE:
                message = _read_message(data, topics, channels, counts.read + 1)
                if message is not None:
                    counts.read += 1
                    yield message
        except MESSAGE_ERRORS:
            counts.broken += 1


def _read_string(data: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", data, at)
    if at + 4 + length > len(data):
        raise ValueError("cut short")
    return data[at + 4 : at + 4 + length].decode(), at + 4 + length


def _read_message(data: bytes, topics: Collection[str], channels: Mapping[int, tuple[str, str]], number: int) -> Message | None:
    channel, _, logged, _ = struct.unpack_from("<HIQQ", data)
    topic, kind = channels.get(channel, ("", ""))
    if topic not in topics:
        return None
    return Message(topic, number, logged * 1e-9, deserialise(data[22:], kind))


def _unpack_chunk(data: bytes) -> bytes:
    """The records of a chunk.

    Raises:
        ValueError: too large, damaged, or packed in another way.
    """
    _, _, size, check = struct.unpack_from("<QQQI", data)
    packing, at = _read_string(data, 28)
    (length,) = struct.unpack_from("<Q", data, at)
    packed = data[at + 8 : at + 8 + length]
    if size > LARGEST_MESSAGE or len(packed) < length:
        raise ValueError("a chunk is too large, or cut short")
    if packing == "":
        plain = packed
    elif packing == "lz4":
        import lz4.frame

        plain = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
    elif packing == "zstd":
        from rosbags.rosbag2 import storage_mcap

        library: Any = storage_mcap.zstd
        plain = library.ZstdDecompressor().decompress(packed, size)
    else:
        raise ValueError(f"packed as {packing[:20]}")
    if len(plain) != size or (check and zlib.crc32(plain) != check):
        raise ValueError("a chunk is damaged")
    return bytes(plain)


class PoseBook:
    """Where frames stood of late; only the newest poses are held.

    Args:
        held: samples of each frame.
    """

    GAP = 0.25  # s between a scan and the nearest pose, at most
    FRAMES = 500  # frames at most: a stranger may name any number

    def __init__(self, held: int = 400) -> None:
        self.held = held
        self._edges: dict[str, tuple[str, list[tuple[float, Any]]]] = {}
        self._static: dict[str, tuple[str, Any]] = {}

    def add(self, parent: str, child: str, time: float, position: Any, turn: Any, static: bool = False) -> bool:
        """Take in where `child` stands in `parent`; False where it is no pose."""
        values = np.array([position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w], float)
        parent, child = parent.strip("/"), child.strip("/")
        known = child in self._edges or child in self._static
        if not np.isfinite(values).all() or not 0.9 < np.linalg.norm(values[3:]) < 1.1 or parent == child:
            return False
        if not known and len(self._edges) + len(self._static) >= self.FRAMES:
            return False
        matrix = _build_matrix(values)
        if static:
            self._static[child] = parent, matrix
            return True
        _, samples = self._edges.get(child, (parent, []))
        samples = [s for s in samples[-self.held :] if s[0] < time]
        self._edges[child] = parent, [*samples, (time, matrix)]
        return True

    def find_pose(self, frame: str, time: float) -> tuple[str, Any] | None:
        """Find the topmost frame and the (4, 4) pose of a frame in it; None where it is not known at that time yet."""
        from topomerge.io.trajectory import Trajectory

        name, pose, moving = frame.strip("/"), np.eye(4), False
        for _ in range(32):
            if name in self._static:
                name, matrix = self._static[name]
                pose = matrix @ pose
            elif name in self._edges:
                parent, samples = self._edges[name]
                track = Trajectory(np.array([m for _, m in samples]), np.array([t for t, _ in samples]))
                if time > samples[-1][0] or track.measure_gap(np.array([time]))[0] > self.GAP:
                    return None  # a newer one is on its way: the robot has moved since the last one
                pose, name, moving = track.interpolate(np.array([time]))[0] @ pose, parent, True
            else:
                break
        return (name, pose) if moving else None


def _build_matrix(values: Any) -> Any:
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    matrix[:3, 3] = values[:3]
    return matrix


def take_poses(book: PoseBook, message: Message, fallback: str) -> str:
    """Take the poses of a message of transforms, odometry or poses into a book.

    Args:
        fallback: frame that moves, where the message names none.

    Returns:
        The frame that moves; empty where it holds no pose that can be used.
    """
    content = message.content
    if hasattr(content, "transforms"):
        static, taken = message.topic.endswith("tf_static"), ""
        for one in content.transforms[:MOST_TRANSFORMS]:
            where, child = one.transform, str(one.child_frame_id)
            good = book.add(
                str(one.header.frame_id), child, read_time(one.header, message), where.translation, where.rotation, static
            )
            taken = child if good and not static else taken
        return taken
    pose = content.pose.pose if hasattr(content.pose, "pose") else content.pose
    child = str(getattr(content, "child_frame_id", "")) or fallback
    time = read_time(content.header, message)
    return child if book.add(str(content.header.frame_id), child, time, pose.position, pose.orientation) else ""


def read_time(header: Any, message: Message) -> float:
    """Read the time of a header, s; that of the recording where it has none."""
    stamp = header.stamp
    time = float(stamp.sec) + float(stamp.nanosec) * 1e-9
    return time if time else message.recorded
