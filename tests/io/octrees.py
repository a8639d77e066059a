"""Writers of a small cloud as an octree: COPC, Entwine point tiles, and Potree 1.x."""

from __future__ import annotations

import io
import json
import struct
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from tests.io.walks import room_walk

Key = tuple[int, int, int, int]  # level, x, y, z
LOW, EDGE = np.array([-2.0, -2.0, -2.0]), 8.0
SCALE = 0.001  # m, to which coordinates are rounded
LEVELS = 3
SPACING = 1.0  # m, of the root's points


@dataclass(frozen=True, eq=False)
class Tree:
    """Points (n, 3) in whole millimetres, their colours (n, 3), and the rows of each node."""

    points: np.ndarray
    colors: np.ndarray
    nodes: dict[Key, np.ndarray]

    def rows(self, deepest: int = LEVELS) -> np.ndarray:
        """All rows down to a level, coarse ones first."""
        return np.concatenate([rows for key, rows in self.nodes.items() if key[0] <= deepest])


@cache
def room_tree() -> Tree:
    """A room in which every node has every eighth of the points that lie in it, the deepest ones the rest."""
    points = np.rint(np.concatenate(room_walk().world) / SCALE) * SCALE
    colors = np.random.default_rng(1).integers(0, 256, (len(points), 3)).astype(np.uint8)
    nodes: dict[Key, np.ndarray] = {}
    todo: list[tuple[Key, np.ndarray]] = [((0, 0, 0, 0), np.arange(len(points)))]
    while todo:
        key, rows = todo.pop(0)
        own = rows if key[0] == LEVELS else rows[::8]
        nodes[key] = own
        rest = np.setdiff1d(rows, own)
        cells = np.floor((points[rest] - LOW) / (EDGE / 2 ** (key[0] + 1))).astype(int)
        for cell in np.unique(cells, axis=0):
            todo.append(((key[0] + 1, *(int(c) for c in cell)), rest[(cells == cell).all(axis=1)]))
    return Tree(points, colors, nodes)


def las_bytes(points: np.ndarray, colors: np.ndarray, packed: bool) -> bytes:
    """A LAS or LAZ file."""
    stream = io.BytesIO()
    _las(points, colors).write(stream, do_compress=packed)
    return stream.getvalue()


def _las(points: np.ndarray, colors: np.ndarray):
    import laspy

    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, SCALE), np.zeros(3)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.red, cloud.green, cloud.blue = colors.T.astype(np.uint16) * 257
    return cloud


def write_copc(path: Path, tree: Tree) -> Path:
    """A LAZ 1.4 file with a chunk for each node, and where each lies: COPC 1.0. Nodes of the finest level have own pages."""
    import lazrs

    cloud = _las(tree.points, tree.colors)
    raw = np.frombuffer(cloud.points.array.tobytes(), np.uint8).reshape(len(tree.points), -1)
    vlr = lazrs.LazVlr.new_for_compression(7, 0, True)
    laszip = vlr.record_data()
    start = 375 + 54 + 160 + 54 + len(laszip)
    stream = io.BytesIO(bytes(start))
    stream.seek(start)
    packer = lazrs.LasZipCompressor(stream, vlr)
    packer.reserve_offset_to_chunk_table()
    entries, finest, before = {}, {}, start + 8
    for key, rows in tree.nodes.items():
        packer.compress_many(raw[rows].tobytes())
        packer.finish_current_chunk()
        entry = struct.pack("<4iQ2i", *key, before, stream.tell() - before, len(rows))
        (finest if key[0] == LEVELS else entries)[key] = entry
        before = stream.tell()
    packer.done()
    hierarchy = stream.seek(0, io.SEEK_END)
    first = 32 * len(tree.nodes)  # bytes of the root's page; behind it lie the others
    for number, key in enumerate(finest):
        entries[key] = struct.pack("<4iQ2i", *key, hierarchy + 60 + first + 32 * number, 32, -1)
    pages = b"".join([*entries.values(), *finest.values()])
    evlr = struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(pages), b"") + pages
    info = struct.pack("<5d2Q2d", *(LOW + EDGE / 2), EDGE / 2, SPACING, hierarchy + 60, first, 0, 1) + bytes(88)
    records = struct.pack("<H16sHH32s", 0, b"copc", 1, 160, b"") + info
    records += struct.pack("<H16sHH32s", 0, b"laszip encoded", 22204, len(laszip), b"") + laszip
    head = bytearray(las_bytes(tree.points, tree.colors, True)[:375])
    head[96:105] = struct.pack("<2IB", start, 2, 7 | 0x80)
    head[235:247] = struct.pack("<QI", hierarchy, 1)
    data = bytes(head) + records + stream.getvalue()[start:] + evlr
    path.write_bytes(data)
    return path


def write_ept(folder: Path, tree: Tree, stored: str = "laszip") -> Path:
    """Entwine point tiles; the hierarchy below each node of level 2 lies in a file of its own."""
    for name in ("ept-hierarchy", "ept-data"):
        (folder / name).mkdir(parents=True)
    schema = [{"name": a, "type": "signed", "size": 4, "scale": SCALE, "offset": 0.0} for a in "XYZ"]
    schema += [{"name": "Intensity", "type": "unsigned", "size": 2}]
    schema += [{"name": n, "type": "unsigned", "size": 2} for n in ("Red", "Green", "Blue")]
    bounds = [*LOW.tolist(), *(LOW + EDGE).tolist()]
    values = {"bounds": bounds, "dataType": stored, "hierarchyType": "json", "points": len(tree.points), "schema": schema}
    (folder / "ept.json").write_text(json.dumps({**values, "span": round(EDGE / SPACING), "version": "1.0.0"}))
    pages: dict[Key, dict[str, int]] = {}
    layout = [(a, "<i4") for a in "xyz"] + [("i", "<u2"), ("r", "<u2"), ("g", "<u2"), ("b", "<u2")]
    for key, rows in tree.nodes.items():
        name = "-".join(map(str, key))
        page = _ancestor(key, 2) if key[0] >= 2 else (0, 0, 0, 0)
        pages.setdefault(page, {})[name] = len(rows)
        if key[0] == 2:
            pages[0, 0, 0, 0][name] = -1
        packed = np.zeros(len(rows), layout)
        for axis, column in zip("xyz", tree.points[rows].T, strict=True):
            packed[axis] = np.rint(column / SCALE)
        for color, column in zip("rgb", tree.colors[rows].T, strict=True):
            packed[color] = column.astype(np.uint16) * 257
        data = las_bytes(tree.points[rows], tree.colors[rows], True) if stored == "laszip" else packed.tobytes()
        if stored == "zstandard":
            from backports import zstd

            data = zstd.compress(data)
        suffix = {"laszip": "laz", "binary": "bin", "zstandard": "zst"}[stored]
        (folder / "ept-data" / f"{name}.{suffix}").write_bytes(data)
    for key, page in pages.items():
        (folder / "ept-hierarchy" / ("-".join(map(str, key)) + ".json")).write_text(json.dumps(page))
    return folder


def _ancestor(key: Key, level: int) -> Key:
    up = key[0] - level
    return level, key[1] >> up, key[2] >> up, key[3] >> up


def node_name(key: Key) -> str:
    """r and a figure a level: 4 for the upper half in x, 2 in y, 1 in z."""
    level, x, y, z = key
    return "r" + "".join(str((x >> k & 1) * 4 + (y >> k & 1) * 2 + (z >> k & 1)) for k in reversed(range(level)))


def write_potree(folder: Path, tree: Tree, stored: str = "bin", version: str = "1.7", step: int = 2) -> Path:
    """Potree of a version: nodes as "bin", "las" or "laz"; `step` levels in a file of the hierarchy."""
    counts = {node_name(key): len(rows) for key, rows in tree.nodes.items()}
    names: object = ["POSITION_CARTESIAN", "COLOR_PACKED", "INTENSITY"]
    if version == "1.8":
        names = [{"name": n, "size": s} for n, s in (("POSITION_CARTESIAN", 12), ("rgba", 4), ("intensity", 2))]
    box = {
        f"{end}{axis}": float(v) for end, corner in (("l", LOW), ("u", LOW + EDGE)) for axis, v in zip("xyz", corner, strict=True)
    }
    values = {"version": version, "octreeDir": "data", "points": len(tree.points), "boundingBox": box, "spacing": SPACING}
    values |= {"pointAttributes": names if stored == "bin" else stored.upper(), "scale": SCALE}
    values |= {"hierarchy": list(counts.items())} if version == "1.4" else {"hierarchyStepSize": step}
    (folder / "data").mkdir(parents=True)
    (folder / "cloud.js").write_text(json.dumps(values))
    for key, rows in tree.nodes.items():
        place = _place(folder / "data", node_name(key), 0 if version == "1.4" else step)
        place.parent.mkdir(parents=True, exist_ok=True)
        packed = np.zeros(len(rows), [("p", "<u4", 3), ("c", "u1", 4), ("i", "<u2")])
        packed["p"] = np.rint((tree.points[rows] - LOW - np.array(key[1:]) * EDGE / 2 ** key[0]) / SCALE)
        packed["c"][:, :3] = tree.colors[rows]
        data = packed.tobytes() if stored == "bin" else las_bytes(tree.points[rows], tree.colors[rows], stored == "laz")
        place.with_suffix(f".{stored}").write_bytes(data)
        if version != "1.4" and key[0] % step == 0:
            place.with_suffix(".hrc").write_bytes(_hierarchy(counts, node_name(key), step))
    return folder


def _hierarchy(counts: dict[str, int], root: str, step: int) -> bytes:
    """Five bytes a node, level by level, `step` levels below the root."""
    names = sorted((n for n in counts if n.startswith(root) and len(n) <= len(root) + step), key=lambda n: (len(n), n))
    masks = [sum(1 << k for k in range(8) if f"{n}{k}" in counts) for n in names]
    return b"".join(struct.pack("<BI", mask, counts[n]) for mask, n in zip(masks, names, strict=True))


def _place(folder: Path, name: str, step: int) -> Path:
    if not step:
        return folder / name
    whole = (len(name) - 1) // step * step
    return folder.joinpath("r", *(name[1 + k : 1 + k + step] for k in range(0, whole, step)), name)
