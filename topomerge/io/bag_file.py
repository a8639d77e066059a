"""ROS bags, version 1 and 2: files, compressed images, messages."""

from __future__ import annotations

import bz2
import logging
import math
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.grid import Plan
from topomerge.io.piece import PIXELS, build_damage_error, is_outside_link
from topomerge.types import Array

log = logging.getLogger(__name__)
MODEST_CHUNK, CHUNK_RATIO = 64 << 20, 200  # bytes that any chunk may have, and times that a larger one may have shrunk
LARGEST_CHUNK = 1 << 30  # bytes
MODEST_BAG, BAG_RATIO = 64 << 20, 1000  # likewise of all chunks together, each time that the bag is gone through
PART = 1 << 20  # bytes that are unpacked at a time


class UnpackingError(ValueError):
    """A chunk has more bytes than a recording of its size."""


class UnpackingBudget:
    """The number of bytes that may still be unpacked of a bag of a size; `reset` when it is gone through once more."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.reset()

    def reset(self) -> None:
        """Reset the budget, before the chunks are unpacked once more."""
        self.left = MODEST_BAG + BAG_RATIO * self.size

    def unpack(self, start: Callable[[], Any], data: bytes) -> bytes:
        """Unpack the bytes of a chunk.

        Args:
            start: makes a decompressor with `decompress(data, max_length)`, `eof` and `unused_data`.
            data: the packed bytes; several frames may follow each other.

        Raises:
            UnpackingError: there would be too many.
            EOFError: they end within a frame.
        """
        most = min(max(MODEST_CHUNK, CHUNK_RATIO * len(data)), LARGEST_CHUNK)
        parts: list[bytes] = []
        total = 0
        while data:
            frame = start()
            fed = data
            while not frame.eof:
                part = frame.decompress(fed, PART)
                if not part and not frame.eof and (not fed or getattr(frame, "needs_input", False)):
                    raise EOFError("a compressed chunk is cut short")
                fed = b""
                total += len(part)
                if total > min(most, self.left):
                    kept = "of all chunks" if total <= most else "of it"
                    raise UnpackingError(f"a chunk of {len(data):,} bytes unpacks to more than {total:,}: {kept}, no recording")
                parts.append(part)
            data = frame.unused_data or b""
        self.left -= total
        return b"".join(parts)


def limit_unpacking(size: int) -> UnpackingBudget:
    """Put limits on what the library unpacks in this process.

    Args:
        size: bytes of the bag.
    """
    import lz4.frame
    from rosbags.rosbag1 import reader as first
    from rosbags.rosbag2 import reader as second
    from rosbags.rosbag2 import storage_mcap

    budget = UnpackingBudget(size)
    zstd: Any = storage_mcap.zstd

    def zstd_unpack(data: bytes) -> bytes:
        return budget.unpack(zstd.ZstdDecompressor, data)

    def lz4_unpack(data: bytes) -> bytes:
        return budget.unpack(lz4.frame.LZ4FrameDecompressor, data)

    def bz2_unpack(data: bytes) -> bytes:
        return budget.unpack(bz2.BZ2Decompressor, data)

    def zstd_file(stream: IO[bytes], mode: str = "rb") -> _LimitedFile:
        return _LimitedFile(zstd.open(stream, mode), MODEST_BAG + BAG_RATIO * size)

    storage_mcap.DECOMPRESSORS.update(
        lz4=lambda data, promised: lz4_unpack(_check_chunk_size(data, promised)),
        zstd=lambda data, promised: zstd_unpack(_check_chunk_size(data, promised)),
    )
    first.decompressors.update(bz2=bz2_unpack, lz4=lz4_unpack)
    vars(second)["zstd"] = SimpleNamespace(decompress=zstd_unpack, open=zstd_file)
    return budget


def measure_bag_size(files: list[Path]) -> int:
    """Measure bytes of the files of a recording, and of those in the folders among them."""
    return sum(p.stat().st_size for file in files for p in (file.rglob("*") if file.is_dir() else [file]) if p.is_file())


def _check_chunk_size(data: bytes, promised: int) -> bytes:
    """Return the data of a chunk whose header promises no more bytes than it may have."""
    if promised > min(max(MODEST_CHUNK, CHUNK_RATIO * len(data)), LARGEST_CHUNK):
        raise UnpackingError(f"a chunk of {len(data):,} bytes promises {promised:,}")
    return data


class _LimitedFile:
    """An unpacked stream that ends with an error after so many bytes."""

    def __init__(self, stream: Any, most: int) -> None:
        self.stream, self.left = stream, most

    def __enter__(self) -> _LimitedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.stream.close()

    def read(self, count: int = -1) -> bytes:
        """Read at most so many bytes."""
        data: bytes = self.stream.read(min(count, PART) if count >= 0 else PART)
        self.left -= len(data)
        if self.left < 0:
            raise UnpackingError("a packed file has more bytes than a recording of its size")
        return data


BAG_SUFFIXES = (".bag", ".db3", ".mcap")
BAG_KIND = "a ROS bag"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
SAME_LAYOUT = {"tf/msg/tfMessage": TRANSFORMS}  # of ROS 1, before tf2
BAG_STARTS = {".bag": b"#ROSBAG V2.0", ".mcap": b"\x89MCAP", ".db3": b"SQLite format 3"}
BAG_TOOLS = {".bag": "rosbag reindex", ".mcap": "mcap recover"}  # that make a new index
MOST_LISTED = 12  # topics in a message
LONGEST_DEFINITION = 1 << 16  # letters of the definition of a type


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, the type of its messages and their number."""

    name: str
    type: str  # such as sensor_msgs/msg/PointCloud2
    count: int

    @property
    def kind(self) -> str:
        """The type without its package."""
        return self.type.rsplit("/", 1)[-1]


@dataclass(frozen=True, eq=False)
class Message:
    """A decoded message: of which topic, the how many-th of it (from 1), when it was recorded (s)."""

    topic: str
    number: int
    recorded: float
    content: Any

    def build_error(self, path: Path, what: str, advice: str = "record the bag again, or cut that part out of it") -> InputError:
        """Build the error for a faulty message."""
        return InputError(f"{path}: message {self.number} of {self.topic} {what}; {advice}")


class Bag:
    """One recording: a file, the folder of a ROS 2 bag, or a folder with the parts of a recording. To be used in a `with`.

    Args:
        path: of the file or folder.
        unpacking: counts what is unpacked each time that the messages are gone through.
    """

    def __init__(self, path: Path, unpacking: UnpackingBudget) -> None:
        self.path = path
        self.unpacking = unpacking
        self._stack = ExitStack()
        self.topics: dict[str, Topic] = {}

    def __enter__(self) -> Bag:
        try:
            self.readers = []
            for file, reader in zip(list_bag_files(self.path), _open_readers(self.path), strict=True):
                with _convert_index_errors(file):
                    self.readers.append(self._stack.enter_context(reader))
        except BaseException:
            self._stack.close()
            raise
        self._store = _build_typestore(self.readers)
        for connection in (c for reader in self.readers for c in reader.connections):
            before = self.topics.get(connection.topic)
            count = connection.msgcount + (before.count if before else 0)
            self.topics[connection.topic] = Topic(connection.topic, connection.msgtype, count)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def find_topics(self, *types: str) -> list[Topic]:
        """Find the topics of these types that hold messages, by name."""
        return sorted((t for t in self.topics.values() if t.type in types and t.count), key=lambda t: t.name)

    def find_topic(self, name: str) -> Topic | None:
        """Find the topic of that name, with or without its slash."""
        return next((t for t in self.topics.values() if t.name.strip("/") == name.strip("/")), None)

    def get_definition(self, topic: Topic) -> str:
        """Return the definition of a topic's type that the bag holds; "": none."""
        for connection in (c for reader in self.readers for c in reader.connections if c.topic == topic.name):
            text = str(connection.msgdef.data)
            if text and len(text) <= LONGEST_DEFINITION:
                return text
        return ""

    def is_known(self, topic: Topic) -> bool:
        """Return whether messages of a topic can be decoded without its definition."""
        return topic.type in self._store.fielddefs

    def learn_type(self, topic: Topic, usual: str = "") -> bool:
        """Learn to decode a topic by the definition of its type; False: there is none, or it can't be used.

        Args:
            topic: of it.
            usual: the definition to go by where the bag holds none.
        """
        from rosbags.typesys import get_types_from_idl, get_types_from_msg

        text = self.get_definition(topic) or usual
        if self.is_known(topic) or not text:
            return self.is_known(topic)
        try:
            idl = re.search(r"(?m)^\s*module\s", text) is not None
            types = get_types_from_idl(text) if idl else get_types_from_msg(text, topic.type)
            self._store.register({name: fields for name, fields in types.items() if name not in self._store.fielddefs})
        except Exception as error:  # the library's parser raises kinds of its own
            log.debug("the definition of %s can't be used: %s", topic.type, error)
        return self.is_known(topic)

    def format_topics(self) -> str:
        """Format the topics of the bag in one line."""
        topics = sorted(self.topics.values(), key=lambda t: t.name)
        shown = [f"{t.name} ({t.count:,} {t.kind})" for t in topics[:MOST_LISTED]]
        more = [f"{len(topics) - MOST_LISTED} more"] if len(topics) > MOST_LISTED else []
        return ", ".join([*shown, *more]) or "nothing"

    def iter_messages(self, topics: Iterable[Topic]) -> Iterator[Message]:
        """Yield the messages of some topics in the order in which they were recorded.

        Raises:
            InputError: one can't be decoded.
        """
        numbers = {t.name: 0 for t in topics}
        self.unpacking.reset()
        streams = []
        for reader in self.readers:
            chosen = [c for c in reader.connections if c.topic in numbers]
            streams += [reader.messages(connections=chosen)] if chosen else []
        for connection, nanoseconds, data in self._iter_recorded(streams):
            numbers[connection.topic] += 1
            message = Message(connection.topic, numbers[connection.topic], nanoseconds * 1e-9, None)
            try:
                content = self._decode(data, SAME_LAYOUT.get(connection.msgtype, connection.msgtype))
            except Exception as error:
                raise message.build_error(self.path, f"can't be decoded ({type(error).__name__})") from error
            yield Message(message.topic, message.number, message.recorded, content)

    def _iter_recorded(self, streams: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield connection, time (ns) and bytes of the messages of some streams, in the order of their times."""
        merged = merge(*streams, key=lambda m: m[1])
        while True:
            with _convert_index_errors(self.path):
                message = next(merged, None)
            if message is None:
                return
            yield message

    def _decode(self, data: bytes, kind: str) -> Any:
        first = type(self.readers[0]).__module__.startswith("rosbags.rosbag1")
        return self._store.deserialize_ros1(data, kind) if first else self._store.deserialize_cdr(data, kind)


def _format_reason(path: Path, error: Exception) -> str:
    """Format the reason that the library gives, unless it may quote the target of a link out of the bag's folder."""
    about = path / "metadata.yaml"
    if is_outside_link(path) or (path.is_dir() and about.exists() and is_outside_link(about)):
        return type(error).__name__
    return " ".join(str(error).split())[:160] or type(error).__name__


@contextmanager
def _convert_index_errors(path: Path) -> Iterator[None]:
    """Turn what the library says of a bag whose index it can't follow into an error that says what helps."""
    try:
        yield
    except (InputError, OSError, MemoryError):
        raise
    except Exception as error:
        reason = _format_reason(path, error)
        file = path if path.is_file() else next(iter(list_bag_files(path)), path)
        if file.is_file() and not _start(file).startswith(BAG_STARTS.get(file.suffix, b"")):
            raise build_damage_error(path, BAG_KIND, reason) from error
        tool = BAG_TOOLS.get(file.suffix, "ros2 bag reindex")
        wrong = f"its index does not fit its records, or it is cut short ({reason})"
        raise InputError(f"{path}: {wrong}; copy it again, or run `{tool}` on a copy") from error


def list_bag_files(path: Path) -> list[Path]:
    """List the files of a recording: itself, the folder that is a ROS 2 bag, or the bags in a folder."""
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return [path]
    return sorted(p for p in path.iterdir() if p.suffix in BAG_SUFFIXES and not p.name.startswith("."))


def _open_readers(path: Path) -> list[Any]:
    files = list_bag_files(path)
    if not files:
        raise InputError(f"{path}: holds no bag (metadata.yaml is no regular file); copy the folder again")
    if len({p.suffix == ".bag" for p in files}) > 1:
        raise InputError(f"{path}: holds bags of ROS 1 and of ROS 2; give one of them")
    if files[0].suffix == ".bag":
        from rosbags.rosbag1 import Reader as Reader1

        for file in files:
            _refuse_old_format(file)
        return [Reader1(file) for file in files]
    from rosbags.rosbag2 import Reader as Reader2

    try:
        return [Reader2(file) for file in files]
    except Exception as error:
        raise build_damage_error(path, BAG_KIND, _format_reason(path, error)) from error


def _start(file: Path) -> bytes:
    """Return the first bytes, which name the format."""
    with file.open("rb") as stream:
        return stream.read(32)


def _refuse_old_format(file: Path) -> None:
    """Refuse a bag of ROS before 2010, which the library does not read."""
    match = re.match(rb"#ROSBAG V(\d{1,3}\.\d{1,3})\s", _start(file))
    if match and match[1] != b"2.0":
        version = match[1].decode()
        raise InputError(f"{file}: is a bag of format {version}, not 2.0; convert it with `rosbag fix old.bag new.bag` of ROS 1")


def _build_typestore(readers: list[Any]) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not type(readers[0]).__module__.startswith("rosbags.rosbag1"):
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", TRANSFORMS))
    return store


IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINT_CLOUD, LASER_SCAN = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/LaserScan"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
LONGEST_POINT = 1 << 16  # bytes of a point


def get_time(message: Message) -> float:
    """Return the time of the measurement, s: that of the header, or of the recording where the header has none."""
    time = message.content.header.stamp
    return message.recorded if time.sec == 0 and time.nanosec == 0 else time.sec + time.nanosec * 1e-9


def decode_point_cloud(path: Path, message: Message) -> tuple[Array, Array | None]:
    """Decode (n, 3) points and (n, 3) uint8 colours, or None, of a PointCloud2.

    Raises:
        InputError: it has no coordinates, or fewer bytes than it promises.
    """
    cloud = message.content
    order = ">" if cloud.is_bigendian else "<"
    offsets = {f.name: (int(f.offset), FIELD_TYPES.get(int(f.datatype))) for f in cloud.fields}
    step, row, width, height = int(cloud.point_step), int(cloud.row_step), int(cloud.width), int(cloud.height)
    if not {"x", "y", "z"} <= {name for name, (_, kind) in offsets.items() if kind in ("f4", "f8")}:
        raise message.build_error(path, f"has the fields {' '.join(offsets)[:80]} but not x y z", "give --topic with another one")
    data = np.frombuffer(cloud.data, np.uint8)
    row = row if height > 1 else width * step
    if not 0 < step <= LONGEST_POINT or row < width * step or len(data) < height * row:
        raise message.build_error(path, f"promises {height} x {width} points of {step} bytes and has {len(data):,} bytes")
    names = [n for n in ("x", "y", "z", "rgb", "rgba") if n in offsets and offsets[n][1] is not None]
    kinds = [order + str(offsets[n][1]) for n in names]
    if any(offsets[n][0] + np.dtype(k).itemsize > step for n, k in zip(names, kinds, strict=True)):
        raise message.build_error(path, f"has fields beyond its {step} bytes a point")
    layout = np.dtype({"names": names, "formats": kinds, "offsets": [offsets[n][0] for n in names], "itemsize": step})
    rows = data[: height * row].reshape(height, row)[:, : width * step].reshape(height * width, step)
    points = np.ascontiguousarray(rows).view(layout)[:, 0] if len(rows) else np.empty(0, layout)
    with np.errstate(invalid="ignore"):  # a damaged number may be a nan that warns
        xyz = np.stack([points[n].astype(np.float64) for n in "xyz"], axis=1)
    name = next((n for n in ("rgb", "rgba") if n in names and layout[n].itemsize == 4), None)
    if name is None:
        return xyz, None
    packed = np.ascontiguousarray(points[name]).astype(layout[name].newbyteorder("=")).view(np.uint32)
    return xyz, np.stack([(packed >> s) & 255 for s in (16, 8, 0)], axis=1).astype(np.uint8)


def decode_laser_scan(path: Path, message: Message) -> tuple[Array, Array | None]:
    """Decode (n, 3) points of a LaserScan, in its plane; None for colours.

    Raises:
        InputError: an angle is not finite.
    """
    scan = message.content
    ranges = np.asarray(scan.ranges, np.float64)
    if not (math.isfinite(scan.angle_min) and math.isfinite(scan.angle_increment)):
        raise message.build_error(path, "has angles that are not finite")
    angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges))
    met = (ranges >= scan.range_min) & (ranges <= scan.range_max) & np.isfinite(ranges)  # false for nan
    ranges, angles = ranges[met], angles[met]
    return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(len(ranges))]), None


def decode_occupancy_grid(path: Path, message: Message) -> tuple[tuple[Array, Array], Plan]:
    """Return the brightness (h, w) in 0..1, where nothing is known (h, w), and what else a map_server file says, of an
    OccupancyGrid.

    Raises:
        InputError: a size that does not fit its cells, or numbers that are not finite.
    """
    info, cells = message.content.info, np.asarray(message.content.data, np.int8)
    height, width = int(info.height), int(info.width)
    if height * width != len(cells) or not 0 < len(cells) <= PIXELS:
        raise message.build_error(path, f"has {len(cells):,} cells for {height} x {width}")
    place, turn = info.origin.position, info.origin.orientation
    yaw = math.atan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))
    warnings: tuple[str, ...] = ()
    if math.isnan(yaw):
        yaw, warnings = (
            0.0,
            (f"{path}: the map on {message.topic} is turned by a quaternion that is no number; it was read as no turn",),
        )
    if not (info.resolution > 0 and np.isfinite((info.resolution, place.x, place.y, yaw)).all()):
        raise message.build_error(path, f"has a resolution of {info.resolution:g} m or an origin that can't be used")
    values = cells.reshape(height, width)[::-1]  # the first row of a grid is the lowest, of an image the highest
    plan = Plan(path, float(info.resolution), (float(place.x), float(place.y), yaw), warnings=warnings)
    return (1.0 - values.clip(0, 100) / np.float32(100), values < 0), plan
