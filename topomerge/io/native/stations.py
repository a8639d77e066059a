"""E57: scans and pictures written moved. Only the poses in the header change; points, pictures and names stay to the byte.

The header is XML behind the binary sections, in pages of 1,024 bytes with a checksum each. It is written again behind what is
left, with other numbers of poses. Source: ASTM E2807.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from topomerge.errors import InputError
from topomerge.io.e57 import check_pages
from topomerge.io.native import Doubt, Motion, Source, Tally
from topomerge.io.pcd import build_pose_matrix, normalize_quaternion
from topomerge.io.piece import build_damage_error
from topomerge.kernels.codecs import compute_crc32c

KIND = "an E57 file"
PAGE, INNER = 1024, 1020  # bytes of a page, and those before its checksum
HEAD = struct.Struct("<8sII4Q")  # magic, versions, length, XML's place and length, page size
LARGEST_XML = 1 << 27  # bytes
MOST_ENTRIES = 1 << 20
LISTS = ("data3D", "images2D")
NUMBERS = (("rotation", "wxyz"), ("translation", "xyz"))


@dataclass
class _Entry:
    """A scan or a picture in the XML: where its content begins, where its pose stands (bytes), and the numbers of that."""

    kind: str
    start: int
    pose: tuple[int, int] | None = None
    values: dict[str, float] = field(default_factory=dict)


def join(sources: Sequence[Source], target: Path, doubt: Doubt) -> Tally:
    """Write one file with its scans and pictures moved.

    Raises:
        InputError: it is damaged, or its map is bent.
    """
    del doubt
    (source,) = sources
    check_pages(source.path)
    with source.path.open("rb") as stream:
        _, major, minor, _, place, size, page = HEAD.unpack(stream.read(HEAD.size))
        if size > LARGEST_XML:
            raise build_damage_error(source.path, KIND, f"a header of {size:,} bytes")
        xml = _read_inner(stream, place, size)
        entries = find_entries(source.path, xml)
        end = _find_binary_end(place, size, source.path.stat().st_size)
        fresh = _write_poses(xml, entries, source.motion)
        with target.open("wb") as out:
            _write_file(stream, out, end, fresh, (major, minor, page))
    scans = sum(entry.kind == "data3D" for entry in entries)
    pictures = len(entries) - scans
    counts = {"scans": (scans, scans), "pictures": (pictures, pictures)}
    bent = source.motion.warp is not None
    text = f"{source.path}: its map is bent; each scan is moved as a whole, as the map is moved at its scanner"
    return Tally(counts, (text,) if bent else ())


def _read_inner(stream: IO[bytes], place: int, size: int) -> bytes:
    """Return the bytes of a section, without the checksums between them."""
    stream.seek(place - place % PAGE)
    inside = place % PAGE
    pages = -(-(inside + size + 4) // INNER) + 1
    data = stream.read(pages * PAGE)
    inner = b"".join(data[k : k + INNER] for k in range(0, len(data), PAGE))
    return inner[inside : inside + size]


def _find_binary_end(place: int, size: int, whole: int) -> int:
    """Return where, counted without checksums, the new header is to begin: in the old one's place if that is the last section."""
    inner = place // PAGE * INNER + place % PAGE
    last = inner + size + INNER >= whole // PAGE * INNER
    return inner if last else whole // PAGE * INNER


def find_entries(path: Path, xml: bytes) -> list[_Entry]:
    """Find the scans and pictures in the XML of an E57 file.

    Raises:
        InputError: it is no XML, or declares entities.
    """
    entries: list[_Entry] = []
    names: list[str] = []
    parser = expat.ParserCreate()
    text: list[str] = []

    def refuse(*_: Any) -> None:
        raise InputError(f"{path}: declares entities in its header, which E57 never does; export it again")

    def begin(name: str, _: Any) -> None:
        names.append(name)
        at = parser.CurrentByteIndex
        if len(names) == 3 and names[1] in LISTS:
            if len(entries) >= MOST_ENTRIES:
                raise build_damage_error(path, KIND, "too many scans")
            entries.append(_Entry(names[1], xml.index(b">", at) + 1))
        elif len(names) == 4 and names[1] in LISTS and name == "pose":
            entries[-1].pose = (at, at)
        text.clear()

    def end(name: str) -> None:
        if len(names) == 4 and names[1] in LISTS and name == "pose" and entries:
            entries[-1].pose = (entries[-1].pose[0], xml.index(b">", parser.CurrentByteIndex) + 1) if entries[-1].pose else None
        elif len(names) == 6 and names[3] == "pose" and names[1] in LISTS:
            description = "".join(text).strip()
            entries[-1].values[f"{names[4]}.{name}"] = float(description) if description else 0.0
        names.pop()

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.CharacterDataHandler, parser.EntityDeclHandler = text.append, refuse
    try:
        parser.Parse(xml.rstrip(b"\0"), True)
    except (expat.ExpatError, ValueError) as error:
        raise build_damage_error(path, KIND, error) from error
    return entries


def _write_poses(xml: bytes, entries: Sequence[_Entry], motion: Motion) -> bytes:
    parts, at = [], 0
    for entry in entries:
        text = _format_pose(entry, motion).encode()
        first, last = entry.pose or (entry.start, entry.start)
        parts += [xml[at:first], text]
        at = last
    return b"".join([*parts, xml[at:]])


def _format_pose(entry: _Entry, motion: Motion) -> str:
    values = entry.values
    quaternion = np.array([values.get(f"rotation.{axis}", 0.0) for axis in "wxyz"])
    turn = normalize_quaternion(quaternion) if quaternion.any() else np.array([1.0, 0, 0, 0])
    pose = build_pose_matrix(turn, np.array([values.get(f"translation.{axis}", 0.0) for axis in "xyz"]))
    moved = motion.move_poses(pose[None])[0]
    x, y, z, w = Rotation.from_matrix(moved[:3, :3]).as_quat()
    numbers = {"rotation": (w, x, y, z), "translation": tuple(moved[:3, 3])}
    parts = []
    for name, axes in NUMBERS:
        listed = zip(axes, numbers[name], strict=True)
        inside = "".join(f'<{axis} type="Float">{float(value)!r}</{axis}>' for axis, value in listed)
        parts.append(f'<{name} type="Structure">{inside}</{name}>')
    return f'<pose type="Structure">{"".join(parts)}</pose>'


def _write_file(stream: IO[bytes], out: IO[bytes], end: int, xml: bytes, about: tuple[int, int, int]) -> None:
    """Copy the binary sections page by page, then the header; all pages with their checksums."""
    total = -(-(end + len(xml)) // INNER)
    place = end // INNER * PAGE + end % INNER
    major, minor, page = about
    head = HEAD.pack(b"ASTM-E57", major, minor, total * PAGE, place, len(xml), page)
    rest = bytearray()
    for inner in _iter_inner(stream, end):
        rest += inner
        if out.tell() == 0 and len(rest) >= HEAD.size:
            rest[: HEAD.size] = head
        _write_pages(out, rest)
    rest += xml
    rest += bytes(-(len(rest)) % INNER)
    _write_pages(out, rest)


def _iter_inner(stream: IO[bytes], end: int) -> Iterator[bytes]:
    stream.seek(0)
    left = end
    while left > 0:
        data = stream.read(PAGE * 1024)
        inner = b"".join(data[k : k + INNER] for k in range(0, len(data), PAGE))[:left]
        left -= len(inner)
        yield inner


def _write_pages(out: IO[bytes], rest: bytearray) -> None:
    """Write all whole pages and take them away."""
    count = len(rest) // INNER
    if not count:
        return
    inner = np.frombuffer(bytes(rest[: count * INNER]), np.uint8).reshape(count, INNER)
    sums = np.asarray(compute_crc32c(inner)).astype(">u4").view(np.uint8).reshape(count, 4)
    out.write(np.concatenate([inner, sums], axis=1).tobytes())
    del rest[: count * INNER]
