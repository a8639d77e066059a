"""Messages of robots while they come: MCAP over a stream, and the websockets of rosbridge and Foxglove.

Whatever comes is of strangers: messages, chunks and lines are limited, and what can't be read is counted and left out.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import logging
import struct
import time
import zlib
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import IO, Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.bag_file import LASER_SCAN, OCCUPANCY_GRID, POINT_CLOUD, TRANSFORMS, Message

log = logging.getLogger(__name__)
LARGEST_MESSAGE = 64 << 20  # bytes of a record, a chunk or a websocket message
LONGEST_ARRAY = 8_000_000  # numbers of an array of a message
ODOMETRY, POSE, UNSURE_POSE = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
)
READ_LIVE = (LASER_SCAN, POINT_CLOUD, OCCUPANCY_GRID, TRANSFORMS, ODOMETRY, POSE, UNSURE_POSE)
MCAP_MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK = 3, 4, 5, 6  # kinds of records
FOXGLOVE = ("foxglove.sdk.v1", "foxglove.websocket.v1")  # since foxglove_bridge 3, and before: they differ in name only
MOST_CHANNELS = 1000  # that are read at a time
WAIT = 0.2  # s that a source waits for a message before it yields None
OPENING = 10.0  # s that a server may take to answer
PAUSES = (0.5, 30.0)  # s before the first try to connect again, and at most: each pause is twice as long as the one before
LASTING = 5.0  # s after which a connection counts as one that works
PATIENCE = 600.0  # s of tries after which it is over
ASK_AGAIN = 5.0  # s after which a topic is asked for again from which nothing came: rosbridge refuses one that is not there yet
MESSAGE_ERRORS = (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError, struct.error)
Received = Iterator[Message | None]  # None: nothing came for a while


@dataclass
class StreamCounts:
    """Counts of a stream's messages: those that were read, and those that could not be."""

    read: int = 0
    broken: int = 0


def normalise_type(name: str) -> str:
    """Return the name of a type as ROS 2 writes it: ``sensor_msgs/msg/LaserScan``."""
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


class Connection:
    """A websocket that is opened again when it is lost.

    Args:
        address: ``ws://host:9090``.
        protocols: names of those that are offered.
        outbox: operations that are sent between messages; what can't be sent stays in it.
        greet: gives the operations that are sent first over every new connection.

    Raises:
        InputError: nobody answers there.
    """

    def __init__(
        self,
        address: str,
        protocols: Sequence[str] = (),
        outbox: deque[Mapping[str, Any]] | None = None,
        greet: Callable[[], Sequence[Mapping[str, Any]]] = tuple,
    ) -> None:
        self.address, self.protocols, self.greet = address, protocols, greet
        self.outbox = deque() if outbox is None else outbox
        self._pause, self._until = PAUSES[0], 0.0
        self._open()

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, *_: object) -> None:
        """Send what is left, and close."""
        if self._link is not None:
            try:
                self._send_all()
            except OSError as error:
                log.warning("%s: the last %d operations were not sent (%s)", self.address, len(self.outbox), error)
            self._link.close()

    def receive(self) -> Iterator[str | bytes | None]:
        """Yield what comes, and None where nothing came for a while, until the connection is lost for good."""
        while self._link is not None:
            try:
                self._send_all()
                received = self._receive_one()
            except OSError as error:
                yield from self._open_again(error)
                continue
            yield received

    def request(self, operation: Mapping[str, Any]) -> None:
        """Send an operation that a new connection makes void, before those of the outbox."""
        self._requests.append(operation)

    def _open(self) -> None:
        self._link = _connect(self.address, self.protocols)
        self.opened = time.monotonic()
        self._requests = deque(self.greet())

    def _open_again(self, error: Exception) -> Iterator[None]:
        """Yield None until the connection is open again; after `PATIENCE` it is given up."""
        if self._until == 0.0 or time.monotonic() - self.opened > LASTING:
            self._pause, self._until = PAUSES[0], time.monotonic() + PATIENCE
            log.warning("%s: the connection is lost (%s); trying again for %.0f s", self.address, error, PATIENCE)
        self._link = None
        while self._link is None and time.monotonic() < self._until:
            after = time.monotonic() + self._pause
            self._pause = min(2 * self._pause, PAUSES[1])
            while time.monotonic() < after:
                time.sleep(min(WAIT, self._pause))
                yield None
            try:
                self._open()
            except InputError as refusal:
                log.info("%s", refusal)
        if self._link is None:
            log.warning("%s: is given up; start again with the same folder to go on", self.address)

    def _send_all(self) -> None:
        """Send what waits.

        Raises:
            OSError: the connection is lost.
        """
        for waiting in (self._requests, self.outbox):
            while waiting:
                with _name_loss():
                    self._link.send(json.dumps(waiting[0]))
                waiting.popleft()

    def _receive_one(self) -> str | bytes | None:
        with _name_loss():
            try:
                received: str | bytes = self._link.recv(timeout=WAIT)
            except TimeoutError:
                return None
            return received


@contextmanager
def _name_loss() -> Iterator[None]:
    """Raise an OSError where a connection is lost."""
    from websockets.exceptions import ConnectionClosed

    try:
        yield
    except ConnectionClosed as error:
        raise OSError(_shorten(error)) from error


def _shorten(error: Exception) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__


def read_rosbridge(connection: Connection, topics: Collection[str], counts: StreamCounts) -> Received:
    """Receive messages of a rosbridge server."""
    opened, silent, ask = 0.0, set(topics), 0.0
    for text in connection.receive():
        if connection.opened != opened:
            opened, silent, ask = connection.opened, set(topics), 0.0
        if silent and time.monotonic() >= ask:
            ask = time.monotonic() + ASK_AGAIN
            for topic in sorted(silent):
                connection.request({"op": "subscribe", "topic": topic})
        if text is None:
            yield None
            continue
        try:
            decoded = json.loads(text)
            if decoded.get("op") != "publish" or decoded.get("topic") not in topics:
                continue
            silent.discard(decoded["topic"])
            message = build_message(decoded["topic"], decoded["msg"], counts.read + 1)
        except MESSAGE_ERRORS:
            counts.broken += 1
            continue
        counts.read += 1
        yield message


def read_foxglove(connection: Connection, topics: Collection[str], counts: StreamCounts) -> Received:
    """Receive messages of a Foxglove websocket server, whose channels are CDR."""
    opened, last = 0.0, 0
    requested: dict[int, tuple[int, str, str]] = {}  # channel, topic and type, by the number of the subscription
    for received in connection.receive():
        if connection.opened != opened:
            opened, requested = connection.opened, {}
        if received is None:
            yield None
            continue
        try:
            if isinstance(received, str):
                decoded = json.loads(received)
                if decoded.get("op") == "unadvertise":
                    gone = set(decoded["channelIds"])
                    requested = {number: of for number, of in requested.items() if of[0] not in gone}
                elif decoded.get("op") == "advertise":
                    for channel in decoded["channels"]:
                        if channel["topic"] in topics and channel.get("encoding") == "cdr" and len(requested) < MOST_CHANNELS:
                            last += 1
                            requested[last] = int(channel["id"]), channel["topic"], normalise_type(channel["schemaName"])
                            subscription = {"id": last, "channelId": requested[last][0]}
                            connection.request({"op": "subscribe", "subscriptions": [subscription]})
                continue
            code, number, nanoseconds = struct.unpack_from("<BIQ", received)
            if code != 1 or number not in requested:
                continue
            _, topic, kind = requested[number]
            message = Message(topic, counts.read + 1, nanoseconds * 1e-9, deserialise(bytes(received[13:]), kind))
        except MESSAGE_ERRORS:
            counts.broken += 1
            continue
        counts.read += 1
        yield message


def _connect(address: str, protocols: Sequence[str]) -> Any:
    try:
        from websockets.exceptions import InvalidStatus, WebSocketException
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol
    except ImportError as error:
        raise InputError("a websocket needs websockets: pip install 'topomerge[bridge]'") from error
    if not address.startswith(("ws://", "wss://")):
        raise InputError(f"{address}: is no websocket; give its address, as ws://localhost:9090")
    wish = f"one that speaks {' or '.join(protocols)}" if protocols else "rosbridge"
    try:
        chosen = [Subprotocol(name) for name in protocols] or None
        opening = connect(address, subprotocols=chosen, max_size=LARGEST_MESSAGE, open_timeout=OPENING, close_timeout=1)
        link = opening.__enter__()  # without it since websockets 17.1: a warning; `Connection` closes it
    except InvalidStatus as error:
        raise InputError(f"{address}: the server refuses ({_shorten(error)}); is it {wish}?") from error
    except (OSError, WebSocketException, ValueError, TimeoutError) as error:
        raise InputError(f"{address}: no websocket server answers there ({_shorten(error)}); is it running?") from error
    if protocols and link.subprotocol is None:
        link.close()
        raise InputError(f"{address}: the server took none of the subprotocols that were offered; is it {wish}?")
    return link


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
    """Return the records of a chunk.

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
