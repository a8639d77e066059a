"""COPC, Entwine point tiles and Potree 1.x: all points once, coarser levels on demand, and what can be wrong."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest

pytest.importorskip("laspy")

from tests.cases import list_longer
from tests.io.octrees import LEVELS, SPACING, Tree, las_bytes, room_tree, write_copc, write_ept, write_potree
from tests.io.test_read_folders import refusal_of, refused
from topomerge.io import read_chunks, read_points
from topomerge.types import PointCloud

FORMS: dict[str, Callable[[Path], Path]] = {
    "ept laszip": lambda folder: write_ept(folder, room_tree()),
    "ept binary": lambda folder: write_ept(folder, room_tree(), "binary"),
    "ept zstandard": lambda folder: write_ept(folder, room_tree(), "zstandard"),
    "potree bin": lambda folder: write_potree(folder, room_tree()),
    "potree las": lambda folder: write_potree(folder, room_tree(), "las"),
    "potree laz": lambda folder: write_potree(folder, room_tree(), "laz"),
    "potree 1.4": lambda folder: write_potree(folder, room_tree(), version="1.4"),
    "potree 1.8": lambda folder: write_potree(folder, room_tree(), version="1.8", step=5),
}
SOME_FORMS = ["ept zstandard", "potree bin", "potree 1.8"]
SOME_FORMS += list_longer(*(name for name in FORMS if name not in SOME_FORMS))


@pytest.fixture(scope="module")
def octrees(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The room in every form. Tests copy what they change."""
    pytest.importorskip("backports.zstd")
    folder = tmp_path_factory.mktemp("octrees")
    return {name: write(folder / name) for name, write in FORMS.items()}


def in_order(points: np.ndarray, colors: np.ndarray | None) -> np.ndarray:
    """(n, 6) points (mm) and colours as sorted rows."""
    assert colors is not None
    rows = np.column_stack([np.rint(points.astype(float) * 1000).astype(int), colors])
    return rows[np.lexsort(rows.T)]


def assert_same_points(cloud: PointCloud, tree: Tree, deepest: int = LEVELS) -> None:
    rows = tree.rows(deepest)
    np.testing.assert_array_equal(in_order(cloud.points, cloud.colors), in_order(tree.points[rows], tree.colors[rows]))


@pytest.mark.parametrize("name", SOME_FORMS)
def test_all_points_once(octrees: dict[str, Path], name: str) -> None:
    assert_same_points(read_points(octrees[name]), room_tree())
    first = next(p for p in octrees[name].iterdir() if p.name in ("ept.json", "cloud.js"))
    assert_same_points(read_points(first), room_tree())


@pytest.mark.parametrize("name", SOME_FORMS)
def test_coarser_levels(octrees: dict[str, Path], name: str) -> None:
    """Levels down to the one whose points are as close as was asked for."""
    for deepest in range(3):
        assert_same_points(read_points(octrees[name], spacing=SPACING / 2**deepest), room_tree(), deepest)
    assert_same_points(read_points(octrees[name], spacing=SPACING * 0.4), room_tree(), 2)
    assert_same_points(read_points(octrees[name], spacing=SPACING * 5), room_tree(), 0)
    assert_same_points(read_points(octrees[name], spacing=SPACING / 1000), room_tree())


@pytest.mark.longer
def test_chunks_are_the_cloud(octrees: dict[str, Path]) -> None:
    for path in octrees.values():
        joined = np.concatenate([c.points for c in read_chunks(path, chunk=700)])
        np.testing.assert_array_equal(joined, read_points(path).points)


def test_copc_is_read_as_the_laz_that_it_is(tmp_path: Path) -> None:
    """Another reader of COPC, laspy's own, sees the same points, on the same levels."""
    import laspy

    path = write_copc(tmp_path / "a.copc.laz", room_tree())
    assert_same_points(read_points(path), room_tree())
    with laspy.CopcReader.open(path) as reader:
        assert len(reader.query()) == len(room_tree().points)
        for level in range(LEVELS + 1):
            rows = reader.query(level=range(level + 1))
            assert len(rows) == len(room_tree().rows(level))
            cloud = read_points(path, spacing=SPACING / 2**level)
            assert_same_points(cloud, room_tree(), level)
            theirs, black = np.column_stack([rows.x, rows.y, rows.z]), np.zeros((len(rows), 3), int)
            np.testing.assert_array_equal(in_order(cloud.points, black), in_order(theirs, black))
    data = path.read_bytes()
    for length in (300, 600, len(data) // 2):
        path.write_bytes(data[:length])
        assert refusal_of(path).startswith(f"{path}: ") and refusal_of(path, spacing=0.5).startswith(f"{path}: ")


def test_records_behind_the_points_are_not_needed(tmp_path: Path) -> None:
    """A thousand million of them, or one of the largest number of bytes: the points are there."""
    path = write_copc(tmp_path / "a.copc.laz", room_tree())
    data = path.read_bytes()
    for at, value in ((243, 2**32 - 1), (235, 2**63)):  # their number, their place
        path.write_bytes(data[:at] + value.to_bytes(4 if at == 243 else 8, "little") + data[at + (4 if at == 243 else 8) :])
        assert_same_points(read_points(path), room_tree())


@pytest.mark.longer
def test_bad_copc(tmp_path: Path) -> None:
    path = write_copc(tmp_path / "a.copc.laz", room_tree())
    data = path.read_bytes()
    info = 375 + 54
    (page, size) = struct.unpack_from("<2Q", data, info + 40)

    def said_of(at: int, layout: str, *values: int) -> str:
        new = struct.pack(layout, *values)
        path.write_bytes(data[:at] + new + data[at + len(new) :])
        assert refused(path) is None, "all levels are the LAZ file that it is"
        said = refusal_of(path, spacing=0.01)
        assert said.startswith(f"{path}: ")
        return said

    assert "a page of 33 bytes" in said_of(info + 48, "<Q", 33)
    assert f"at {1 << 60:,} of" in said_of(info + 40, "<Q", 1 << 60)
    assert "a node of level 99" in said_of(page, "<i", 99)
    assert "a node of level 0 with -2 points" in said_of(page + 28, "<i", -2)
    assert "has a node of 2,000,000,000 points, too many for one; read it without --spacing" in said_of(
        page + 28, "<i", 2_000_000_000
    )
    assert "its octree has more points than" in said_of(page + 28, "<i", 1_000_000)
    assert "a node of level 0 with 360 points" in said_of(page + 16, "<Q", 1 << 60)
    assert f"the page at {page:,} is named twice" in said_of(page + 16, "<Q2i", page, size, -1)
    said_of(page + 24, "<i", 10)
    path.write_bytes(data)
    rng = np.random.default_rng(1)
    for _ in range(40):
        broken = bytearray(data)
        for at in rng.integers(0, 375 + 54 + 160, 3) if rng.random() < 0.5 else rng.integers(page, len(data), 3):
            broken[at] = int(rng.integers(256))
        path.write_bytes(bytes(broken))
        said = refused(path, spacing=0.1)
        assert said is None or (said.startswith(f"{path}: ") and "\n" not in said)


def test_chunks_that_promise_too_much(tmp_path: Path) -> None:
    """The decoder of LAZ 1.4 would allocate four gigabytes, and end the process where there are less."""
    tree = room_tree()
    plain = tmp_path / "a.laz"
    plain.write_bytes(las_bytes(tree.points, tree.colors, True))
    for path in (plain, write_copc(tmp_path / "a.copc.laz", tree)):
        data = bytearray(path.read_bytes())
        assert_same_points(read_points(path), tree)
        (start,) = struct.unpack_from("<I", data, 96)
        data[start + 8 + 36 + 4 : start + 8 + 36 + 8] = b"\xff" * 4
        path.write_bytes(bytes(data))
        assert "bytes promises 4,294," in refusal_of(path)
        assert "bytes promises 4,294," in refusal_of(path, spacing=5.0)


def a_copy(octrees: dict[str, Path], name: str, folder: Path) -> Path:
    return Path(copytree(octrees[name], folder / name))


def deepest(folder: Path, suffix: str) -> Path:
    """The node with the longest name."""
    return max(folder.rglob(f"*.{suffix}"), key=lambda p: (len(p.name), p.name))


@pytest.mark.parametrize("name", SOME_FORMS)
def test_bad_nodes(octrees: dict[str, Path], tmp_path: Path, name: str) -> None:
    folder = a_copy(octrees, name, tmp_path)
    suffix = {"laszip": "laz", "binary": "bin", "zstandard": "zst"}.get(name.split()[1], name.split()[1].replace("1.4", "bin"))
    node = deepest(folder, suffix.replace("1.8", "bin"))
    data = node.read_bytes()
    for damage in (b"", data[: len(data) // 2], data[:-3], b"\xff" * len(data) if suffix in ("las", "laz", "zst") else data[:5]):
        node.write_bytes(damage)
        assert refusal_of(folder).startswith(f"{node}: ")
    node.unlink()
    assert f"{node}: no such file, but the hierarchy names it" in refusal_of(folder)


def changed(file: Path, **values: object) -> None:
    """Change values of a JSON file; None leaves one out."""
    whole = json.loads(file.read_text()) | values
    file.write_text(json.dumps({k: v for k, v in whole.items() if v is not None}))


def test_bad_ept(octrees: dict[str, Path], tmp_path: Path) -> None:
    folder = a_copy(octrees, "ept binary", tmp_path)
    main, page = folder / "ept.json", folder / "ept-hierarchy" / "0-0-0-0.json"
    before, hierarchy = main.read_text(), page.read_text()
    schema = json.loads(before)["schema"]
    for change, says in (
        ({"dataType": "brotli"}, "has points as 'brotli'"),
        ({"dataType": ["laszip"]}, "ept.json"),
        ({"hierarchyType": "gzip"}, "a hierarchy as 'gzip'; only laszip, binary, zstandard and json are read"),
        ({"bounds": [0, 0, 0]}, "its bounds or schema"),
        ({"bounds": [0, 0, 0, 1, 1, float("inf")]}, "not finite"),
        ({"schema": schema[1:]}, "its bounds or schema"),
        ({"schema": None}, "its bounds or schema"),
        ({"schema": [{**schema[0], "size": 3}, *schema[1:]]}, "its bounds or schema"),
        ({"schema": [{**schema[0], "scale": "a"}, *schema[1:]]}, "its bounds or schema"),
        ({"schema": [{**schema[0], "scale": 0}, *schema[1:]]}, "scale or offset"),
    ):
        changed(main, **change)
        said = refusal_of(folder)
        assert said.startswith((f"{main}: ", f"{folder}: ")) and says in said
        main.write_text(before)
    for change, says in (
        ({"../../a": 5}, "the node '../../a' with 5 points"),
        ({"1-0-0-0": -2}, "the node '1-0-0-0' with -2 points"),
        ({"1-0-0-0": "a"}, "the node '1-0-0-0' with a points"),
        ({"0-0-0-0": -1}, "the hierarchy of 0-0-0-0 is named twice"),
        ({"99-0-0-0": 1}, "the node '99-0-0-0'"),
    ):
        changed(page, **change)
        assert refusal_of(folder).startswith(f"{page}: damaged") and says in refusal_of(folder)
        page.write_text(hierarchy)
    for text in ("", "{", "[]", "[" * 200_000):
        page.write_text(text)
        assert refusal_of(folder).startswith(f"{page}: damaged")
    page.unlink()
    assert f"{page}: no such file, and it belongs to an EPT point cloud" in refusal_of(folder)


def test_bad_potree(octrees: dict[str, Path], tmp_path: Path) -> None:
    folder = a_copy(octrees, "potree bin", tmp_path)
    main = folder / "cloud.js"
    before = main.read_text()
    box = json.loads(before)["boundingBox"]
    for change, says in (
        ({"version": "2.0"}, "is of version 2.0 of Potree, only 1.4 to 1.8 are read"),
        ({"version": "1.3"}, "is of version 1.3"),
        ({"version": None}, "is of version none"),
        ({"boundingBox": None}, "damaged, or not a Potree 1.x point cloud"),
        ({"boundingBox": {**box, "ux": box["lx"], "uy": box["ly"], "uz": box["lz"]}}, "can't be used"),
        ({"boundingBox": {**box, "ux": float("nan")}}, "can't be used"),
        ({"scale": 0}, "can't be used"),
        ({"hierarchyStepSize": 0}, "can't be used"),
        ({"octreeDir": "../.."}, "has its points outside of its folder"),
        ({"pointAttributes": ["POSITION_CARTESIAN", "SPEED"]}, "has points with 'SPEED', whose size is not known"),
        ({"pointAttributes": ["COLOR_PACKED"]}, "has points without POSITION_CARTESIAN"),
        ({"pointAttributes": "CIN"}, "has points with 'CIN'"),
        ({"pointAttributes": [5]}, "has points with '5'"),
    ):
        changed(main, **change)
        said = refusal_of(folder)
        assert said.startswith(f"{main}: ") and says in said
        main.write_text(before)
    hierarchy = folder / "data" / "r" / "r.hrc"
    data = hierarchy.read_bytes()
    hierarchy.write_bytes(data[:-7])
    assert f"{hierarchy}: ends before the node r" in refusal_of(folder)
    hierarchy.write_bytes(data)
    deeper = next(file for file in sorted(folder.rglob("*.hrc")) if len(file.stem) == 3 and file.stat().st_size > 5)
    deeper.unlink()
    assert f"{deeper}: no such file" in refusal_of(folder)
    listed = a_copy(octrees, "potree 1.4", tmp_path)
    for names in ([["../a", 1]], [["r8", 1]], [["r", -1]], [["r" * 3, 1]], [["r" + "0" * 60, 1]]):
        changed(listed / "cloud.js", hierarchy=names)
        assert "a node" in refusal_of(listed)


@pytest.mark.longer
@pytest.mark.parametrize("name", ["ept laszip", "ept binary", "potree bin", "potree 1.4"])
def test_damaged_octrees(octrees: dict[str, Path], tmp_path: Path, name: str) -> None:
    """Points or one line, whatever is flipped."""
    folder = a_copy(octrees, name, tmp_path)
    rng = np.random.default_rng(1)
    files = [p for p in sorted(folder.rglob("*")) if p.is_file() and p.suffix in (".json", ".js", ".hrc", ".laz")]
    for _ in range(30):
        file = files[int(rng.integers(min(len(files), 4)))]
        data = file.read_bytes()
        broken = bytearray(data)
        for at in rng.integers(0, len(data), 3):
            broken[at] = int(rng.integers(256))
        file.write_bytes(bytes(broken))
        said = refused(folder)
        assert said is None or (said.startswith(str(folder)) and "\n" not in said)
        file.write_bytes(data)
