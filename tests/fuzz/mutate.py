"""Damage: one seeded way after the other to break the bytes of a file. The same seed breaks it in the same way.

Where a format guards its bytes with a checksum or a length, the damage is done inside and the guard is made to fit again:
a hostile file has right checksums.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np

Rng = np.random.Generator
INTEGERS = (0, 1, -1, 127, 255, 32767, 65535, 2**31 - 1, -(2**31), 2**32 - 1, 2**40, 2**62, -(2**63))
REALS = (0.0, float("nan"), float("inf"), -float("inf"), 1e308, 1e30, 1e9, -1e9, 5e-324, 1e-30)
TOKENS = ("0", "-1", "1e308", "-1e308", "nan", "inf", "1e-300", "99999999999999", "4294967295", "2147483648", "1000000", "x", "")
HEADER_BYTES = 600  # bytes in which most formats keep their counts
LARGEST_MUTANT = 4 << 20  # bytes of a mutant


def _reach(data: bytes, rng: Rng) -> int:
    """How far into the file the damage may be: every other time only its header."""
    return len(data) if rng.random() < 0.5 else min(len(data), HEADER_BYTES)


def flip(data: bytes, rng: Rng) -> bytes:
    """One to eight bits turned over."""
    broken = bytearray(data)
    for at in rng.integers(0, _reach(data, rng), int(rng.integers(1, 9))):
        broken[at] ^= 1 << int(rng.integers(8))
    return bytes(broken)


def overwrite(data: bytes, rng: Rng) -> bytes:
    """A field of 1 to 8 bytes replaced by a number that programs stumble over."""
    size = int(rng.choice((1, 2, 4, 8)))
    order = "<" if rng.random() < 0.8 else ">"
    if size >= 4 and rng.random() < 0.4:
        field = np.array(rng.choice(REALS if size == 8 else REALS[:4] + REALS[5:]), f"{order}f{size}").tobytes()
    else:
        field = (int(rng.choice(np.array(INTEGERS, object))) % (1 << 8 * size)).to_bytes(
            size, "little" if order == "<" else "big"
        )
    at = int(rng.integers(0, max(_reach(data, rng) - size, 1)))
    return data[:at] + field + data[at + size :]


def truncate(data: bytes, rng: Rng) -> bytes:
    """The end cut off."""
    return data[: int(rng.integers(0, _reach(data, rng) + 1))]


def delete(data: bytes, rng: Rng) -> bytes:
    """A piece taken out."""
    start, end = sorted(rng.integers(0, _reach(data, rng) + 1, 2).tolist())
    return data[:start] + data[end:]


def repeat(data: bytes, rng: Rng) -> bytes:
    """A piece said up to a thousand times."""
    start = int(rng.integers(0, _reach(data, rng)))
    piece = data[start : start + int(rng.choice((1, 4, 30, 200)))]
    return (data[:start] + piece * int(rng.choice((2, 10, 1000))) + data[start:])[:LARGEST_MUTANT]


def noise(data: bytes, rng: Rng) -> bytes:
    """A piece replaced by random bytes."""
    start, length = int(rng.integers(0, _reach(data, rng))), int(rng.integers(1, 100))
    return data[:start] + rng.bytes(length) + data[start + length :]


def number(data: bytes, rng: Rng) -> bytes:
    """A number in a text, or in the text part of a binary file, replaced by an awkward one."""
    found = list(re.finditer(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?", data[: 1 << 16]))
    if not found:
        return flip(data, rng)
    match = found[int(rng.integers(len(found) if rng.random() < 0.5 else min(len(found), 20)))]
    return data[: match.start()] + str(rng.choice(TOKENS)).encode() + data[match.end() :]


def lines(data: bytes, rng: Rng) -> bytes:
    """Lines swapped, left out or said again."""
    parts = data.split(b"\n")
    a, b = rng.integers(0, min(len(parts), 60), 2).tolist()
    kind = int(rng.integers(3))
    if kind == 0:
        parts[a], parts[b] = parts[b], parts[a]
    elif kind == 1:
        del parts[a]
    else:
        parts[a:a] = [parts[b]] * int(rng.choice((1, 50)))
    return b"\n".join(parts)[:LARGEST_MUTANT]


def nest(data: bytes, rng: Rng) -> bytes:
    """Brackets within brackets, or a long word."""
    mark = [b"[", b"{", b"(", b'{"a":', b"A", b"-", b"#", b"&a [", b"\xff", b"\x00", b"9"][int(rng.integers(11))]
    at = int(rng.integers(0, _reach(data, rng)))
    return data[:at] + mark * int(rng.choice((50, 2000, 100_000))) + data[at:]


GENERAL: tuple[Callable[[bytes, Rng], bytes], ...] = (
    flip,
    flip,
    overwrite,
    overwrite,
    overwrite,
    truncate,
    delete,
    repeat,
    noise,
    number,
    number,
    number,
    lines,
    nest,
)


def general(data: bytes, rng: Rng) -> bytes:
    """One to three kinds of damage, one after the other."""
    for _ in range(1 + int(rng.random() < 0.3) + int(rng.random() < 0.1)):
        data = GENERAL[int(rng.integers(len(GENERAL)))](data or b"\0", rng)
    return data


def in_zip(data: bytes, rng: Rng) -> bytes:
    """Damage within one member of an archive, packed again with the right checksum; or members renamed, doubled, left out."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(i.filename, archive.read(i)) for i in archive.infolist()]
    except Exception:
        return general(data, rng)
    which = int(rng.integers(len(members)))
    name, body = members[which]
    kind = int(rng.integers(8))
    if kind == 0:
        del members[which]
    elif kind == 1:
        members.append((name, members[int(rng.integers(len(members)))][1]))
    elif kind == 2:
        members[which] = (str(rng.choice(["../../evil.npy", "/etc/evil.npy", "a\0b.npy", "x" * 60_000 + ".npy", ".npy"])), body)
    elif kind == 3:
        members[which] = (name, body + bytes(int(rng.choice((1, 1 << 16, 32 << 20)))))
    else:
        members[which] = (name, general(body, rng))
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED if rng.random() < 0.7 else zipfile.ZIP_STORED) as archive:
        for name, body in members:
            try:
                archive.writestr(zipfile.ZipInfo(name), body, zipfile.ZIP_DEFLATED)
            except ValueError:  # a name that no archive can hold
                continue
    return out.getvalue()


def in_pages(data: bytes, rng: Rng) -> bytes:
    """Damage within the pages of an E57 file, their checksums made to fit."""
    from topomerge.kernels.codecs import compute_crc32c

    if len(data) < 1024:
        return general(data, rng)
    pages = np.frombuffer(data[: len(data) // 1024 * 1024], np.uint8).reshape(-1, 1024)
    body = pages[:, :1020].tobytes()
    xml = body.find(b"<?xml")
    kind, start = int(rng.integers(3)), (0, 48, max(xml, 0))[int(rng.integers(3))]
    way = (number, number, overwrite, flip, noise)[int(rng.integers(5))] if kind else general
    body = body[:start] + way(body[start:], rng)
    body = body[: len(body) // 1020 * 1020 if rng.random() < 0.2 else pages.shape[0] * 1020].ljust(pages.shape[0] * 1020, b"\0")
    table = np.frombuffer(body, np.uint8).reshape(-1, 1020)
    sums = compute_crc32c(np.ascontiguousarray(table)).astype(">u4")[:, None].view(np.uint8)
    return np.hstack([table, sums]).tobytes()


def in_png(data: bytes, rng: Rng) -> bytes:
    """Damage within a chunk of a PNG, its checksum made to fit."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    if not chunks:
        return general(data, rng)
    which = int(rng.integers(len(chunks)))
    kind, body = chunks[which]
    if kind == b"IDAT" and rng.random() < 0.5:
        try:
            body = zlib.compress(general(zlib.decompress(body), rng) + bytes(int(rng.choice((0, 1 << 20)))))
        except zlib.error:
            body = general(body, rng)
    else:
        body = general(body or b"\0", rng)
    chunks[which] = (kind, body)
    packed = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    return data[:8] + b"".join(packed)


def in_json(data: bytes, rng: Rng) -> bytes:
    """A value somewhere in a JSON text (a glb's too, its lengths made to fit) replaced, removed or wrapped."""
    start = 20 if data[:4] == b"glTF" else 0
    end = 20 + int.from_bytes(data[12:16], "little") if start else len(data)
    try:
        tree = json.loads(data[start:end])
    except ValueError:
        return general(data, rng)
    holders = [tree]
    for holder in holders:
        children = holder.values() if isinstance(holder, dict) else holder
        holders += [c for c in children if isinstance(c, dict | list) and c]
    holder = holders[int(rng.integers(len(holders)))]
    keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
    key = keys[int(rng.integers(len(keys)))]
    values = (None, -1, 0, 2**31, 10**12, 1e308, "x", [], {}, True, [holder[key]], float("nan"), 5126, "SCALAR", [1e30] * 16)
    holder[key] = values[int(rng.integers(len(values)))]
    text = json.dumps(tree).encode()
    if not start:
        return text
    text += b" " * (-len(text) % 4)
    rest = data[end:]
    return data[:8] + struct.pack("<II", 20 + len(text) + len(rest), len(text)) + data[16:20] + text + rest


def in_step(data: bytes, rng: Rng) -> bytes:
    """References of a STEP file turned to other entities, or statements changed for those of another kind."""
    out = data
    for _ in range(int(rng.integers(1, 4))):
        found = list(re.finditer(rb"#\d+|IFC[A-Z0-9]+", out))
        if len(found) < 2:
            return general(data, rng)
        a, b = (found[int(i)] for i in rng.integers(0, len(found), 2))
        if a[0][:1] == b[0][:1]:
            out = out[: a.start()] + b[0] + out[a.end() :]
    return out


SPECIAL: dict[str, Callable[[bytes, Rng], bytes]] = {
    ".npz": in_zip,
    ".tmap": in_zip,
    ".e57": in_pages,
    ".png": in_png,
    ".glb": in_json,
    ".gltf": in_json,
    ".json": in_json,
    ".ifc": in_step,
}


def mutant(name: str, corpus: dict[str, bytes], seed: int) -> bytes:
    """The damaged bytes of one file of the corpus."""
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    data = corpus[name]
    special = SPECIAL.get("." + name.rpartition(".")[2])
    if special is not None and rng.random() < 0.5:
        return special(data, rng)
    if rng.random() < 0.1:  # the end of another file
        other = corpus[sorted(corpus)[int(rng.integers(len(corpus)))]]
        return data[: int(rng.integers(len(data)))] + other[int(rng.integers(len(other))) :]
    return general(data, rng)
