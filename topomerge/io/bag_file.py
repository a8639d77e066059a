"""ROS 1 and ROS 2 bags as streams of messages, read by rosbags, which needs no ROS.

Only messages of common types are decoded, by their definitions of ROS itself: those in a bag are never turned into code.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from heapq import merge
from pathlib import Path
from typing import Any

from topomerge.errors import InputError
from topomerge.io.bag_unpacking import Unpacking
from topomerge.io.piece import damaged, leads_outside

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
BAG_KIND = "a ROS bag"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
SAME_LAYOUT = {"tf/msg/tfMessage": TRANSFORMS}  # of ROS 1, before tf2
BAG_STARTS = {".bag": b"#ROSBAG V2.0", ".mcap": b"\x89MCAP", ".db3": b"SQLite format 3"}
BAG_TOOLS = {".bag": "rosbag reindex", ".mcap": "mcap recover"}  # that make a new index
MOST_LISTED = 12  # topics in a message


@dataclass(frozen=True)
class Topic:
    """What a bag holds under a name."""

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

    def fault(self, path: Path, what: str, advice: str = "record the bag again, or cut that part out of it") -> InputError:
        """The error for what is wrong with it."""
        return InputError(f"{path}: message {self.number} of {self.topic} {what}; {advice}")


class Bag:
    """One recording: a file, the folder of a ROS 2 bag, or a folder with the parts of a recording. To be used in a `with`.

    Args:
        path: of the file or folder.
        unpacking: counts what is unpacked each time that the messages are gone through.
    """

    def __init__(self, path: Path, unpacking: Unpacking) -> None:
        self.path = path
        self.unpacking = unpacking
        self._stack = ExitStack()
        self.topics: dict[str, Topic] = {}

    def __enter__(self) -> Bag:
        try:
            self.readers = []
            for file, reader in zip(bag_files(self.path), _readers(self.path), strict=True):
                with _index_faults(file):
                    self.readers.append(self._stack.enter_context(reader))
        except BaseException:
            self._stack.close()
            raise
        self._store = _typestore(self.readers)
        for connection in (c for reader in self.readers for c in reader.connections):
            before = self.topics.get(connection.topic)
            count = connection.msgcount + (before.count if before else 0)
            self.topics[connection.topic] = Topic(connection.topic, connection.msgtype, count)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def of_type(self, *types: str) -> list[Topic]:
        """The topics of these types that hold messages, by name."""
        return sorted((t for t in self.topics.values() if t.type in types and t.count), key=lambda t: t.name)

    def named(self, name: str) -> Topic | None:
        """The topic of that name, with or without its slash."""
        return next((t for t in self.topics.values() if t.name.strip("/") == name.strip("/")), None)

    def listing(self) -> str:
        """What the bag holds, in one line."""
        topics = sorted(self.topics.values(), key=lambda t: t.name)
        shown = [f"{t.name} ({t.count:,} {t.kind})" for t in topics[:MOST_LISTED]]
        more = [f"{len(topics) - MOST_LISTED} more"] if len(topics) > MOST_LISTED else []
        return ", ".join([*shown, *more]) or "nothing"

    def messages(self, topics: Iterable[Topic]) -> Iterator[Message]:
        """The messages of some topics in the order in which they were recorded.

        Raises:
            InputError: one can't be decoded.
        """
        numbers = {t.name: 0 for t in topics}
        self.unpacking.restart()
        streams = []
        for reader in self.readers:
            chosen = [c for c in reader.connections if c.topic in numbers]
            streams += [reader.messages(connections=chosen)] if chosen else []
        for connection, nanoseconds, data in self._recorded(streams):
            numbers[connection.topic] += 1
            message = Message(connection.topic, numbers[connection.topic], nanoseconds * 1e-9, None)
            try:
                content = self._decode(data, SAME_LAYOUT.get(connection.msgtype, connection.msgtype))
            except Exception as error:
                raise message.fault(self.path, f"can't be decoded ({type(error).__name__})") from error
            yield Message(message.topic, message.number, message.recorded, content)

    def _recorded(self, streams: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Connection, time (ns) and bytes of the messages of some streams, in the order of their times."""
        merged = merge(*streams, key=lambda m: m[1])
        while True:
            with _index_faults(self.path):
                message = next(merged, None)
            if message is None:
                return
            yield message

    def _decode(self, data: bytes, kind: str) -> Any:
        first = type(self.readers[0]).__module__.startswith("rosbags.rosbag1")
        return self._store.deserialize_ros1(data, kind) if first else self._store.deserialize_cdr(data, kind)


def _reason(path: Path, error: Exception) -> str:
    """What the library says, unless it may quote what a link out of the bag's folder points to."""
    about = path / "metadata.yaml"
    if leads_outside(path) or (path.is_dir() and about.exists() and leads_outside(about)):
        return type(error).__name__
    return " ".join(str(error).split())[:160] or type(error).__name__


@contextmanager
def _index_faults(path: Path) -> Iterator[None]:
    """Turns what the library says of a bag whose index it can't follow into an error that says what helps."""
    try:
        yield
    except (InputError, OSError, MemoryError):
        raise
    except Exception as error:
        reason = _reason(path, error)
        file = path if path.is_file() else next(iter(bag_files(path)), path)
        if file.is_file() and not _start(file).startswith(BAG_STARTS.get(file.suffix, b"")):
            raise damaged(path, BAG_KIND, reason) from error
        tool = BAG_TOOLS.get(file.suffix, "ros2 bag reindex")
        wrong = f"its index does not fit its records, or it is cut short ({reason})"
        raise InputError(f"{path}: {wrong}; copy it again, or run `{tool}` on a copy") from error


def bag_files(path: Path) -> list[Path]:
    """The files of a recording: itself, the folder that is a ROS 2 bag, or the bags in a folder."""
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return [path]
    return sorted(p for p in path.iterdir() if p.suffix in BAG_SUFFIXES and not p.name.startswith("."))


def _readers(path: Path) -> list[Any]:
    files = bag_files(path)
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
        raise damaged(path, BAG_KIND, _reason(path, error)) from error


def _start(file: Path) -> bytes:
    """The first bytes, which name the format."""
    with file.open("rb") as stream:
        return stream.read(32)


def _refuse_old_format(file: Path) -> None:
    """Refuse a bag of ROS before 2010, which the library does not read."""
    match = re.match(rb"#ROSBAG V(\d{1,3}\.\d{1,3})\s", _start(file))
    if match and match[1] != b"2.0":
        version = match[1].decode()
        raise InputError(f"{file}: is a bag of format {version}, not 2.0; convert it with `rosbag fix old.bag new.bag` of ROS 1")


def _typestore(readers: list[Any]) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not type(readers[0]).__module__.startswith("rosbags.rosbag1"):
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", TRANSFORMS))
    return store
