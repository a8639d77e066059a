"""Binary archives of Boost.Serialization, read and written by a description of their classes.

The members of an object stand in their order, without names. Where a class comes first, it is told whether its objects are
counted, and in which version. An object behind a pointer has the number of its class, and is written where it is first met. So
all that comes before a thing has to be known to read it. Source: `basic_oarchive.cpp` of Boost.Serialization (tried: 1.74).
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from topomerge.types import Array

SIGNATURE = (22).to_bytes(8, "little") + b"serialization::archive"
LIBRARY = (12, 20)  # versions of the archive that are written alike
SIZES = bytes([4, 8, 4, 8, 1, 0, 0, 0])  # of int, long, float and double, and the order of bytes
MOST_ITEMS = 1 << 23  # of a list of objects
END = "end"  # as size: an array to the end of the file
NUMBERS = {"bool": "?", "u1": "B", "i4": "<i4", "u4": "<u4", "f8": "<f8"}
Members = dict[str, Any]
Passing = Generator[Any, Any, Any]


@dataclass(frozen=True, eq=False)
class ArchiveLayout:
    """The layout that an archive is read by.

    Args:
        classes: members in their order, `name:type`; without a name: a base.
        abstract: only what derives from them is behind a pointer.
        aliases: names of classes that are one; `dropped`: parts of names that tell nothing.
        kept: classes whose objects are gathered.
    """

    classes: Mapping[str, str]
    abstract: tuple[str, ...] = ()
    aliases: Mapping[str, str] = field(default_factory=dict)
    dropped: tuple[str, ...] = (" ",)
    kept: tuple[str, ...] = ()


@cache
def _split(text: str) -> tuple[str, ...]:
    """Return the arguments of a template."""
    parts, depth, start = [], 0, 0
    for k, letter in enumerate(text):
        depth += (letter == "<") - (letter == ">")
        if letter == "," and depth == 0:
            parts.append(text[start:k])
            start = k + 1
    return (*parts, text[start:])


class BinaryArchive:
    """A binary archive of Boost that is read or written from its start: what it says of classes, and its objects.

    One description of the classes serves both ways, as Boost's `archive & member` does: what is written is passed in as `value`.

    Args:
        data: of the file.
        layout: its classes.
        like: writes, in place of reading: descriptions of classes are those of these archives, the head is that of the first.
    """

    def __init__(self, data: bytes, layout: ArchiveLayout, like: Sequence[BinaryArchive] = ()) -> None:
        self.data, self.at, self.out = data, len(SIGNATURE), bytearray()
        self.layout, self.like = layout, like
        self.numbers: dict[str, int] = {}  # of classes, in the order in which they were met
        self.counted: dict[str, bool] = {}  # of those that were described: are its objects counted?
        self.names: dict[str, str] = {}  # of classes, as the archive writes them
        self.objects: list[Any] = []
        self.entered: dict[tuple[int, str], int] = {}  # numbers of objects that were written
        self.found: dict[str, list[Members]] = {kind: [] for kind in layout.kept}

    def read(self, kind: str) -> Members:
        """Read the object with which the archive begins.

        Raises:
            ValueError: it is damaged, of another layout, or another kind of archive.
        """
        library = self._move_number("<u2")
        if not LIBRARY[0] <= library <= LIBRARY[1]:
            raise ValueError(f"an archive of version {library} of Boost")
        if self._take(len(SIZES)) != SIZES:
            raise ValueError("an archive of another kind of machine")
        return self._run(kind)

    def _run(self, kind: str, value: Members | None = None) -> Members:
        """Go through an object; graphs are deeper than Python's stack."""
        stack = [self._move_object(kind, value)]
        value = None
        while stack:
            try:
                stack.append(stack[-1].send(value))
                value = None
            except StopIteration as done:
                stack.pop()
                value = done.value
        assert isinstance(value, dict)
        return value

    def _take(self, count: int) -> bytes:
        if count < 0 or self.at + count > len(self.data):
            raise ValueError("it is cut short, or of another layout")
        self.at += count
        return self.data[self.at - count : self.at]

    def _move_block(self, form: str, count: int, values: Any = None) -> Array:
        """Move numbers that lie behind each other."""
        kind = np.dtype(form)
        if self.like:
            self.out += np.asarray(values, kind).tobytes()
            return np.asarray(values)
        return np.frombuffer(self._take(count * kind.itemsize), kind)

    def _move_number(self, form: str, value: Any = None) -> Any:
        return self._move_block(form, 1, value if value is None else [value])[0].item()

    def _move_count(self, value: int, most: int = MOST_ITEMS) -> int:
        count = int(self._move_number("<u8", value))
        if not self.like and count > min(most, len(self.data) - self.at):
            raise ValueError(f"a list of {count:,} entries")
        return count

    def _move_text(self, value: str | None) -> str:
        data = (value or "").encode(errors="surrogateescape")
        count = self._move_count(len(data), 1 << 20)
        if self.like:
            self.out += data
            return value or ""
        return self._take(count).decode(errors="surrogateescape")

    def _register(self, kind: str) -> None:
        self.numbers.setdefault(kind, len(self.numbers))

    def _describe(self, kind: str) -> bool:
        """Say of a class, where it comes first, whether its objects are counted."""
        if kind not in self.counted:
            known = next((archive.counted[kind] for archive in self.like if kind in archive.counted), False)
            counted, version = self._move_number("u1", known), self._move_number("<u4", 0)
            if counted > 1 or version:
                raise ValueError(f"version {version} of {kind}")
            self.counted[kind] = bool(counted)
        return self.counted[kind]

    def _enter(self, kind: str, value: Any) -> tuple[int, bool]:
        """Return the number of an object, and whether it is new."""
        held = len(self.objects)
        number = int(self._move_number("<u4", self.entered.get((id(value), kind), held)))
        if number > held:
            raise ValueError(f"object {number:,} before its time")
        if number == held:
            self.objects.append(value)
            self.entered[id(value), kind] = held
        return number, number == held

    def _move(self, kind: str, value: Any) -> Passing:
        """Move a member of any type."""
        if kind in NUMBERS:
            return self._move_number(NUMBERS[kind], value)
        if kind == "str":
            return self._move_text(value)
        if kind.endswith("*"):
            return (yield self._move_pointer(kind[:-1], value))
        return (yield self._move_object(kind, value))

    def _move_class(self, value: Members | None) -> str | None:
        """Return the class of what is behind a pointer."""
        kind = "" if value is None else value["class"]
        number = self._move_number("<i2", self.numbers.get(kind, len(self.numbers)) if value is not None else -1)
        if number == -1:
            return None
        if number != len(self.numbers):
            if not 0 <= number < len(self.numbers):
                raise ValueError(f"an object of class {number}")
            return list(self.numbers)[number]
        text = self._move_text(next((archive.names[kind] for archive in self.like if kind in archive.names), None))
        name = text
        for part in self.layout.dropped:
            name = name.replace(part, "")
        kind = self.layout.aliases.get(name, name)
        if kind not in self.layout.classes or kind in self.numbers:
            raise ValueError(f"an object of class {name[:60]!r}")
        self.names[kind] = text
        self._register(kind)
        return kind

    def _move_pointer(self, static: str, value: Members | None) -> Passing:
        if static not in self.layout.abstract:
            self._register(static)
        kind, number = self._move_class(value), None
        if kind is None:
            return None
        if self._describe(kind):
            number, new = self._enter(kind, value)
            if not new:
                return self.objects[number]
        return (yield self._fill(kind, number, value))

    def _move_object(self, kind: str, value: Any) -> Passing:
        self._register(kind)
        if kind == "vector<f8>":  # lists of numbers are not described
            return self._move_block("<f8", self._move_count(0 if value is None else len(value)), value)
        number = None
        if self._describe(kind):
            number, new = self._enter(kind, value)
            if not new:
                raise ValueError(f"{kind} twice")
        return (yield self._fill(kind, number, value))

    def _fill(self, kind: str, number: int | None, value: Any) -> Passing:
        """Fill in the content of an object, a pair or a list."""
        head, _, rest = kind.partition("<")
        inner = _split(rest[:-1]) if head in ("vector", "map", "pair") else ()
        if head == "vector":
            return (yield self._move_list(inner[0], value))
        if head == "map":
            return (yield self._move_list(f"pair<{inner[0]},{inner[1]}>", value))
        if head == "pair":
            first = yield self._move(inner[0], value and value[0])
            return first, (yield self._move(inner[1], value and value[1]))
        members: Members = value if self.like else {"class": kind}
        if number is not None:
            self.objects[number] = members
        for member in self.layout.classes[kind].split():
            name, _, of = member.rpartition(":")
            at = self.at
            if not name:
                base = yield self._move(of, value)
                members |= {} if self.like else {k: v for k, v in base.items() if k != "class"}
            elif of.endswith("]"):
                members[name] = yield self._move_array(of, members, members.get(name))
            else:
                members[name] = yield self._move(of, members.get(name))
                members[f"@{name}"] = at, self.at
        if kind in self.found:
            self.found[kind].append(members)
        return members

    def _move_list(self, kind: str, values: Any) -> Passing:
        count = self._move_count(0 if values is None else len(values))
        if self._move_number("<u4", 0):
            raise ValueError(f"another version of {kind}")
        if kind != "Vector2<double>" or not count:
            return (yield self._move_all(kind, count, values))
        self._register(kind)
        if self._describe(kind):
            raise ValueError(f"{kind} is counted")
        return self._move_block("<f8", 2 * count, values).reshape(-1, 2)

    def _move_all(self, kind: str, count: int, values: Any) -> Passing:
        out = []
        for k in range(count):
            out.append((yield self._move(kind, None if values is None else values[k])))
        return out

    def _move_array(self, kind: str, members: Members, values: Any) -> Passing:
        """Move an array, whose length other members tell, or the end of the file."""
        of, *sizes = kind.replace("]", "").split("[")
        if of == "f8" and sizes == ["3", "3"]:
            rows = range(self._move_count(3, 3))
            return np.array(
                [self._move_block("<f8", self._move_count(3, 3), values if values is None else values[k]) for k in rows]
            )
        if sizes == [END]:
            out: list[Any] = []
            while self.at < len(self.data) if values is None else len(out) < len(values):
                out.append((yield self._move(of, None if values is None else values[len(out)])))
            return out
        count = 1
        for size in sizes[0].split("*"):
            count *= len(members[size]) if hasattr(members[size], "__len__") else int(members[size])
        if of in NUMBERS:
            return self._move_block(NUMBERS[of], count, values)
        if not 0 <= count <= MOST_ITEMS:
            raise ValueError(f"an array of {count:,} entries")
        return (yield self._move_all(of, count, values))


def write_archive(value: Members, like: Sequence[BinaryArchive]) -> bytes:
    """Write an object as an archive, whose classes are described as in others, of one layout.

    Raises:
        ValueError: these describe a class in two ways.
    """
    for archive in like[1:]:
        if any(like[0].counted.get(kind, counted) != counted for kind, counted in archive.counted.items()):
            raise ValueError("they were written by different builds of a program")
    writer = BinaryArchive(b"", like[0].layout, like)
    writer._run(value["class"], value)
    return like[0].data[: len(SIGNATURE) + 2 + len(SIZES)] + bytes(writer.out)
