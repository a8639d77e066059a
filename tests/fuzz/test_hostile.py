"""Files that somebody made to do harm: a few bytes that would become gigabytes, endless work, or a look into other folders."""

from __future__ import annotations

import io
import json
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests import samples
from tests.fuzz.drive import Worker, started

HUGE = 10**12


# The worker reads one valid file of each format that is tried here first: libraries are loaded before memory is limited.
WARM = ("array.npz", "ascii.pcd", "little.ply", "mesh.ply", "plan.yaml", "image.png", "mesh.gltf")
WARM += ("model.ifc", "tree.bt", "cloud.e57", "map.tmap")


@pytest.fixture(scope="module")
def worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Worker]:
    with started(tmp_path_factory.mktemp("hostile") / "a", WARM) as (worker, _):
        yield worker


def refused(worker: Worker, path: Path, data: bytes | str) -> str:
    """The message with which a file is refused; it was read within the limits."""
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    state, message = worker.ask(str(path))
    assert state == "refused", f"{path.name}: {state}: {message}"
    return message


def read(worker: Worker, path: Path, data: bytes | str) -> str:
    """What is told about a file that is harmless; it was read within the limits."""
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    state, message = worker.ask(str(path))
    assert state == "read", f"{path.name}: {state}: {message}"
    return message


def harmless(worker: Worker, path: Path, data: bytes | str | None = None) -> None:
    """A file is read or refused, within the limits."""
    if data is not None:
        path.write_bytes(data.encode() if isinstance(data, str) else data)
    state, message = worker.ask(str(path))
    assert state in ("read", "refused"), f"{path.name}: {message}"


def packed(members: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return out.getvalue()


def npy(shape: tuple[int, ...], kind: str = "<f8", data: bytes = b"") -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": kind, "fortran_order": False, "shape": shape})
    return stream.getvalue() + data


@pytest.mark.longer
def test_arrays_that_unpack_to_gigabytes(worker: Worker, tmp_path: Path) -> None:
    zeros = bytes(300 << 20)
    big = packed({"points.npy": npy((len(zeros) // 24, 3), data=zeros[: len(zeros) // 24 * 24])})
    assert len(big) < 1 << 20
    assert "refused" in refused(worker, tmp_path / "a.npz", big)
    member = npy((len(zeros) // 4,), "<u4", zeros)
    text = refused(worker, tmp_path / "a.tmap", packed({"format.npy": npy((), "<i4", b"\2\0\0\0"), "grid_cells.npy": member}))
    assert "claims" in text


def test_names_without_end_are_not_said_again(worker: Worker, tmp_path: Path) -> None:
    refused(worker, tmp_path / "a.npz", packed({f"{k}{'x' * 5000}.npy": npy((4,), data=bytes(32)) for k in range(3)}))
    refused(worker, tmp_path / "a.pcd", f"VERSION .7\nFIELDS {'field ' * 900}\nDATA ascii\n")
    refused(worker, tmp_path / "a.ply", f"ply\nformat {'word ' * 900}\nend_header\n")
    refused(worker, tmp_path / "a.yaml", f"image: a.png\nresolution: {'word ' * 900}\n")


def test_an_archive_that_lies_about_its_sizes(worker: Worker, tmp_path: Path) -> None:
    data = packed({"points.npy": npy((1000, 3), data=bytes(24_000))})
    for at in (data.find(b"PK\1\2") + 24, 22):  # unpacked size in the directory and beside the member
        for size in (0, 10, 2**32 - 2):
            broken = bytearray(data)
            broken[at : at + 4] = struct.pack("<I", size)
            harmless(worker, tmp_path / "a.npz", bytes(broken))


def test_names_in_archives_lead_nowhere(worker: Worker, tmp_path: Path) -> None:
    points = npy((8, 3), data=samples.box_points(8).astype(float).tobytes())
    assert read(worker, tmp_path / "a.npz", packed({"points.npy": points, "../../evil.npy": points, "/tmp/evil.npy": points}))
    refused(worker, tmp_path / "a.tmap", packed({"../format.npy": npy((), "<i4", b"\2\0\0\0"), "../../x.npy": points}))
    assert not list(tmp_path.parent.rglob("evil*"))


def png(width: int, height: int, rows: bytes) -> bytes:
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)), (b"IDAT", rows), (b"IEND", b""))
    body = b"".join(struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + body


def test_pictures_of_a_billion_pixels(worker: Worker, tmp_path: Path) -> None:
    for side in (2**31 - 1, 100_000, 15_000):
        assert "pixels" in refused(worker, tmp_path / "a.png", png(side, side, zlib.compress(bytes(1 << 20))))


@pytest.mark.longer
def test_a_large_picture_of_nothing(worker: Worker, tmp_path: Path) -> None:
    """The largest picture that is taken stays within the memory that a reader may use."""
    side = 5000
    packer = zlib.compressobj()
    rows = b"".join(packer.compress(bytes(1 + 3 * side)) for _ in range(side)) + packer.flush()
    assert len(rows) < 1 << 20
    harmless(worker, tmp_path / "a.png", png(side, side, rows))


def test_an_octree_of_huge_leaves(worker: Worker, tmp_path: Path) -> None:
    down = samples.octomap_node([3, 0, 0, 0, 0, 0, 0, 0])
    for depth in (0, 5, 7, 8):
        for state in (1, 2):
            leaf = samples.octomap_node([state] * 8)
            path = tmp_path / "a.bt"
            samples.write_octomap(path, down * depth + leaf, depth + 9)
            harmless(worker, path)


def gltf(folder: Path) -> dict:
    import trimesh

    scene = trimesh.Scene(trimesh.creation.box((4, 3, 2.5)))
    made = trimesh.exchange.gltf.export_gltf(scene, embed_buffers=True)
    return json.loads(next(data for name, data in made.items() if name.endswith(".gltf")))


def test_scenes_that_promise_more_than_they_hold(worker: Worker, tmp_path: Path) -> None:
    path = tmp_path / "a.gltf"
    tree = gltf(tmp_path)
    del tree["accessors"][0]["bufferView"]
    tree["accessors"][0]["count"] = 90_000_000
    assert "promised" in refused(worker, path, json.dumps(tree))
    tree = gltf(tmp_path)
    tree["buffers"].append({"uri": "data:;base64," + "A" * (4 << 20), "byteLength": 3 << 20})
    tree["bufferViews"] += [{"buffer": len(tree["buffers"]) - 1, "byteLength": 3 << 20}] * 1000
    assert "promised" in refused(worker, path, json.dumps(tree))


def test_one_part_standing_in_a_scene_a_thousand_times(worker: Worker, tmp_path: Path) -> None:
    tree = gltf(tmp_path)
    tree["nodes"] = [{"mesh": 0, "scale": [1e4] * 3, "name": str(i)} for i in range(2000)]
    tree["scenes"] = [{"nodes": list(range(2000))}]
    harmless(worker, tmp_path / "a.gltf", json.dumps(tree))


def test_nodes_that_are_their_own_children(worker: Worker, tmp_path: Path) -> None:
    path = tmp_path / "a.gltf"
    for nodes in (
        [{"children": [0], "mesh": 0}],
        [{"children": [1]}, {"children": [0], "mesh": 0}],
        [*({"children": [i + 1, i + 1]} for i in range(40)), {"mesh": 0}],
        [*({"children": [i + 1]} for i in range(3000)), {"mesh": 0}],
    ):
        tree = gltf(tmp_path)
        tree["nodes"], tree["scenes"] = nodes, [{"nodes": [0]}]
        harmless(worker, path, json.dumps(tree))


@pytest.mark.parametrize("uri", ["../secret.bin", "/etc/passwd", "/dev/zero", "../../../../../../dev/zero", "x/../../s", "."])
def test_scenes_see_only_their_own_folder(worker: Worker, tmp_path: Path, uri: str) -> None:
    tree = gltf(tmp_path)
    tree["buffers"][0]["uri"] = uri
    assert "which is no" in refused(worker, tmp_path / "a.gltf", json.dumps(tree))


def test_yaml_that_would_be_endless(worker: Worker, tmp_path: Path) -> None:
    names = "abcdefghijklmnopqrst"
    bomb = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    bomb += "".join(f"{n}: &{n} [{', '.join([f'*{m}'] * 9)}]\n" for m, n in pairwise(names))
    for key in ("image", "mode", "origin", "negate", "resolution"):
        plain = {"image": "plan.pgm", "resolution": "0.1", "origin": "[0, 0, 0]", "mode": "trinary", "negate": "0"}
        text = bomb + "".join(f"{k}: {'*t' if k == key else v}\n" for k, v in plain.items())
        (tmp_path / "plan.pgm").write_bytes(b"P5\n2 2\n255\n" + bytes(4))
        refused(worker, tmp_path / "a.yaml", text)
    for tag in ("!!python/object/apply:os.system ['touch evil']", "!!python/name:os.system"):
        refused(worker, tmp_path / "a.yaml", f"image: {tag}\nresolution: 0.1\n")


def relaid(data: bytes, change: list[tuple[str, str]]) -> bytes:
    """An E57 file with another XML part (regular expressions and what replaces them), its lengths and checksums made to fit."""
    from topomerge.kernels.codecs import compute_crc32c

    body = bytearray(np.frombuffer(data, np.uint8).reshape(-1, 1024)[:, :1020].tobytes())
    at = bytes(body).find(b"<?xml")
    _, _, length = struct.unpack("<QQQ", body[16:40])
    xml = bytes(body[at : at + length])
    for old, new in change:
        xml, found = re.subn(old.encode(), new.encode(), xml, flags=re.DOTALL)
        assert found, old
    body = body[:at] + xml
    body += b"\0" * (-len(body) % 1020)
    body[16:24], body[32:40] = struct.pack("<Q", len(body) // 1020 * 1024), struct.pack("<Q", len(xml))
    pages = np.frombuffer(bytes(body), np.uint8).reshape(-1, 1020)
    return np.hstack([pages, compute_crc32c(np.ascontiguousarray(pages)).astype(">u4")[:, None].view(np.uint8)]).tobytes()


def test_e57_with_points_that_take_no_bytes(worker: Worker, tmp_path: Path) -> None:
    scan = samples.box_points(), np.array([1.0, 0, 0, 0]), np.zeros(3)
    samples.write_e57(tmp_path / "good.e57", [scan], samples.box_colors())
    data = (tmp_path / "good.e57").read_bytes()
    assert read(worker, tmp_path / "same.e57", relaid(data, [])) == "600"
    many = ('recordCount="600"', f'recordCount="{HUGE}"')
    assert "promise" in refused(worker, tmp_path / "a.e57", relaid(data, [many]))
    whole = 'type="Integer" minimum="5" maximum="5">5<'
    fixed = [(f"<cartesian{a} .*?</cartesian{a}>", f"<cartesian{a} {whole}/cartesian{a}>") for a in "XYZ"]
    assert "more than it has bits" in refused(worker, tmp_path / "b.e57", relaid(data, [*fixed, many]))


def test_pipes_and_devices_are_not_waited_for(worker: Worker, tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "a.ply")
    harmless(worker, tmp_path / "a.ply")


STRAY_PLACES = ["../precious.txt", "{elsewhere}/precious.txt", "maps/../../precious.txt", "link/precious.txt", 5]


@pytest.fixture(scope="module")
def sound_atlas(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An atlas of one map, to be copied."""
    from tests.scenes_map import building
    from topomerge.fusion.atlas.store import add

    folder = tmp_path_factory.mktemp("sound") / "atlas"
    add(folder, [("house", building(2, 2))], lambda *_, **__: "")
    return folder


@pytest.mark.parametrize("name", STRAY_PLACES)
def test_an_atlas_of_a_stranger_deletes_and_writes_nothing_elsewhere(sound_atlas: Path, tmp_path: Path, name: object) -> None:
    """What looks like a change that was interrupted names files of other folders."""
    from topomerge.errors import InputError
    from topomerge.fusion.atlas.folder import GONE, NEXT
    from topomerge.fusion.atlas.store import read_atlas

    folder = tmp_path / "atlas"
    shutil.copytree(sound_atlas, folder)
    (tmp_path / "precious.txt").write_text("mine")
    (folder / "link").symlink_to(tmp_path)
    (folder / NEXT).mkdir()
    (folder / NEXT / GONE).write_text(json.dumps([str(name).format(elsewhere=tmp_path) if isinstance(name, str) else name]))
    with pytest.raises(InputError, match="can't be finished"):
        read_atlas(folder)
    assert (tmp_path / "precious.txt").read_text() == "mine"
    (folder / NEXT / GONE).unlink()
    (folder / NEXT / "link").mkdir()
    (folder / NEXT / "link" / "precious.txt").write_text("theirs")
    with pytest.raises(InputError, match="can't be finished"):
        read_atlas(folder)
    assert (tmp_path / "precious.txt").read_text() == "mine"


def model_with(folder: Path, pattern: str, other: str) -> str:
    """A building model of which the first statement of a kind (a regular expression for its name) is replaced."""
    pytest.importorskip("ifcopenshell")
    samples.write_ifc(folder / "good.ifc")
    good, statement = (folder / "good.ifc").read_text(), rf"#(\d+)={pattern}\(.*?\);"
    text, found = re.subn(statement, lambda m: other.replace("#N", f"#{m[1]}"), good, count=1)
    assert found
    return text


@pytest.mark.parametrize(
    ("pattern", "other"),
    [
        ("IFCPOLYLINE", "#N=IFCPOLYLINE(());"),
        pytest.param("IFCPOLYLINE", "#N=IFCPOLYLINE((#9001,#9002));", marks=pytest.mark.longer),
        pytest.param("IFCEXTRUDEDAREASOLID", "#N=IFCBOOLEANRESULT(.UNION.,#N,#N);", marks=pytest.mark.longer),
        pytest.param(
            "IFCEXTRUDEDAREASOLID",
            "#N=IFCBOOLEANRESULT(.UNION.,#9001,#9001);\n#9001=IFCBOOLEANRESULT(.UNION.,#N,#N);",
            marks=pytest.mark.longer,
        ),
        pytest.param("IFCLOCALPLACEMENT", "#N=IFCLOCALPLACEMENT(#N,#3);", marks=pytest.mark.longer),
    ],
)
def test_models_that_end_the_library(worker: Worker, tmp_path: Path, pattern: str, other: str) -> None:
    assert "damaged" in refused(worker, tmp_path / "a.ifc", model_with(tmp_path, pattern, other))


@pytest.mark.longer  # a chain that leads to itself is refused above
def test_models_that_are_nested_too_deep(worker: Worker, tmp_path: Path) -> None:
    for depth, state in ((100, "read"), (100_000, "refused")):
        chain = "".join(f"#{9000 + i}=IFCLOCALPLACEMENT(#{9001 + i},#3);\n" for i in range(depth))
        text = model_with(tmp_path, "IFCLOCALPLACEMENT", f"#N=IFCLOCALPLACEMENT(#9000,#3);\n{chain}")
        (tmp_path / "a.ifc").write_text(text)
        assert worker.ask(str(tmp_path / "a.ifc"))[0] == state, depth


@pytest.mark.longer
def test_names_in_a_model_are_no_references(worker: Worker, tmp_path: Path) -> None:
    text = model_with(tmp_path, "IFCWALL", "#N=IFCWALL('0sf3ISLQz5hRzC9sJf$1AN',$,'wall #N; it''s #N',$,$,$,#72,$,$);")
    read(worker, tmp_path / "a.ifc", text)
