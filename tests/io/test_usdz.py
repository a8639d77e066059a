"""USDZ of iPhones: RoomPlan's parts as what they are, meshes of scanners as surfaces; nothing outside is followed."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from topomerge.errors import InputError
from topomerge.io import read_points

pxr = pytest.importorskip("pxr")

HEAD = '#usda 1.0\n(\n    defaultPrim = "Room"\n    metersPerUnit = {unit}\n    upAxis = "{up}"\n)\n'
ROOM = [  # name, category, group, middle (x, y up, z), size
    ("Wall0", "Wall", "Arch_grp", (0, 1.25, -1.5), (4.0, 2.5, 0.1)),
    ("Wall1", "Wall", "Arch_grp", (0, 1.25, 1.5), (4.0, 2.5, 0.1)),
    ("Wall2", "Wall", "Arch_grp", (-2, 1.25, 0), (0.1, 2.5, 3.0)),
    ("Wall3", "Wall", "Arch_grp", (2, 1.25, 0), (0.1, 2.5, 3.0)),
    ("Door0", "Door", "Arch_grp", (0.5, 1.0, -1.5), (0.9, 2.0, 0.02)),
    ("Opening0", "Opening", "Arch_grp", (2, 1.0, 0), (0.02, 2.0, 1.2)),
    ("Window0", "Window", "Arch_grp", (0, 1.5, 1.5), (1.2, 1.0, 0.12)),
    ("Floor0", "Floor", "Arch_grp", (0, 0, 0), (4.0, 0.01, 3.0)),
    ("Chair0", "Chair", "Object_grp", (1, 0.4, 0.5), (0.5, 0.8, 0.5)),
    ("WasherDryer1", "WasherDryer", "Object_grp", (-1, 0.4, 0.5), (0.6, 0.8, 0.6)),
]


def cube(name: str, category: str, middle: Any, size: Any) -> str:
    rows = [(size[0], 0, 0, 0), (0, size[1], 0, 0), (0, 0, size[2], 0), (*middle, 1)]
    text = ", ".join("(" + ", ".join(map(str, row)) + ")" for row in rows)
    custom = f' (\n customData = {{ string Category = "{category}" }}\n)' if category else ""
    points = ", ".join(f"({x}, {y}, {z})" for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5))
    return f"""def Xform "{name}"{custom}
{{
    def Mesh "{name}"
    {{
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [0,1,3,2, 4,6,7,5, 0,4,5,1, 2,3,7,6, 0,2,6,4, 1,5,7,3]
        point3f[] points = [{points}]
        matrix4d xformOp:transform = ({text})
        uniform token[] xformOpOrder = ["xformOp:transform"]
    }}
}}
"""


def package(path: Path, layers: dict[str, str], packed: bool = False) -> Path:
    """A zip archive whose files begin at multiples of 64 bytes, as the specification wants it."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED) as archive:
        for name, text in layers.items():
            info = zipfile.ZipInfo(name)
            if not packed:
                lack = -(archive.fp.tell() + 30 + len(name)) % 64  # type: ignore[union-attr]
                info.extra = b"\x86\x19" + (lack - 4).to_bytes(2, "little") + bytes(lack - 4) if lack >= 4 else b""
                if 0 < lack < 4:
                    info.extra = b"\x86\x19" + (lack + 60).to_bytes(2, "little") + bytes(lack + 60)
            info.compress_type = zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED
            archive.writestr(info, text)
    return path


def roomplan(path: Path, *, referenced: bool = True, categories: bool = True, unit: float = 1.0) -> Path:
    """A room as RoomPlan writes it: each part in a layer of its own."""
    layers, groups = {}, {"Arch_grp": "", "Object_grp": ""}
    for name, category, group, middle, size in ROOM:
        middle, size = (tuple(v / unit for v in values) for values in (middle, size))
        part = cube(name, category if categories else "", middle, size)
        if referenced:
            layers[f"assets/{name}.usda"] = HEAD.format(unit=unit, up="Y").replace('"Room"', f'"{name}"') + part
            part = f'def "{name}_grp" (prepend references = @./assets/{name}.usda@)\n{{\n}}\n'
        groups[group] += part
    inner = "".join(f'def Xform "{group}"\n{{\n{text}}}\n' for group, text in groups.items())
    root = f'def Xform "Room"\n{{\ndef Xform "Parametric_grp"\n{{\n{inner}}}\n}}\n'
    return package(path, {"Room.usda": HEAD.format(unit=unit, up="Y") + root, **layers})


@pytest.mark.parametrize(
    "layout",
    [
        {},
        *(
            pytest.param(more, marks=pytest.mark.longer)
            for more in ({"referenced": False}, {"categories": False}, {"unit": 0.01})
        ),
    ],
)
def test_a_room_of_roomplan(tmp_path: Path, layout: dict[str, Any]) -> None:
    cloud = read_points(roomplan(tmp_path / "a.usdz", **layout))
    points = cloud.points + cloud.shift
    np.testing.assert_allclose(np.ptp(points, axis=0), (4.1, 3.1, 2.5), atol=0.02)
    wall = points[np.abs(points[:, 1] - 1.5) < 0.1]  # z of the file becomes -y: the wall with the door
    assert len(wall) > 1000
    in_door = (np.abs(wall[:, 0] - 0.5) < 0.44) & (wall[:, 2] > 0.02) & (wall[:, 2] < 1.98)
    assert not in_door.any()
    opening = (np.abs(points[:, 0] - 2) < 0.1) & (np.abs(points[:, 1]) < 0.59) & (points[:, 2] > 0.02) & (points[:, 2] < 1.98)
    assert not opening.any()
    window = (np.abs(points[:, 1] + 1.5) < 0.1) & (np.abs(points[:, 0]) < 0.5) & (np.abs(points[:, 2] - 1.5) < 0.4)
    assert window.sum() > 100
    assert cloud.landmarks is not None
    named = [cloud.landmarks.values[k] for k in cloud.landmarks.table["value"]]
    assert [name.replace(" ", "") for name in named] == ["chair", "washerdryer"]
    np.testing.assert_allclose(cloud.landmarks.table["position"], [(1, -0.5, 0.4), (-1, -0.5, 0.4)], atol=1e-4)


def test_doors_are_kept_when_asked_for(tmp_path: Path) -> None:
    cloud = read_points(roomplan(tmp_path / "a.usdz"), doors=True)
    points = cloud.points + cloud.shift
    assert (
        (np.abs(points[:, 1] - 1.5) < 0.02) & (np.abs(points[:, 0] - 0.5) < 0.4) & (np.abs(points[:, 2] - 1) < 0.9)
    ).sum() > 100


def test_a_mesh_of_a_scanner(tmp_path: Path) -> None:
    """One mesh without names, of polygons, z up, of the library's own writer; a box of the library beside it."""
    from pxr import Usd, UsdGeom, UsdUtils

    stage = Usd.Stage.CreateNew(str(tmp_path / "scan.usdc"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    mesh = UsdGeom.Mesh.Define(stage, "/scan")
    mesh.CreatePointsAttr([(0, 0, 0), (4, 0, 0), (4, 3, 0), (0, 3, 0), (2, 5, 0)])
    mesh.CreateFaceVertexCountsAttr([5])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 4, 3])
    box = UsdGeom.Cube.Define(stage, "/box")
    box.CreateSizeAttr(1.0)
    UsdGeom.XformCommonAPI(box).SetTranslate((2, 1, 0.5))
    hidden = UsdGeom.Cube.Define(stage, "/hidden")
    UsdGeom.XformCommonAPI(hidden).SetTranslate((50, 0, 0))
    hidden.CreateVisibilityAttr(UsdGeom.Tokens.invisible)
    stage.SetDefaultPrim(stage.GetPrimAtPath("/scan"))
    stage.Save()
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "scan.usdc"), str(tmp_path / "scan.usdz"))
    cloud = read_points(tmp_path / "scan.usdz")
    points = cloud.points + cloud.shift
    np.testing.assert_allclose(points.max(axis=0), (4, 5, 1), atol=1e-5)
    assert len(points) == pytest.approx((16 + 6) / 0.05**2, rel=0.02)
    assert cloud.landmarks is None or not len(cloud.landmarks)


ROOT = HEAD.format(unit=1, up="Y")


@pytest.mark.parametrize(
    ("layers", "told"),
    [
        ({"Room.usda": ROOT + 'def "Room" (prepend references = @/etc/passwd.usda@) {}'}, "is not in it and is not followed"),
        ({"Room.usda": ROOT + 'def "Room" (prepend references = @../secret.usda@) {}'}, "is not in it and is not followed"),
        ({"Room.usda": ROOT + 'def "Room" (prepend payload = @https://a.b/c.usda@) {}'}, "is not in it and is not followed"),
        ({"Room.usda": ROOT.replace("(\n", "(\n subLayers = [@other.usda@]\n", 1)}, "is not in it and is not followed"),
        ({"a.png": "x", "Room.usda": ROOT}, "does not begin with a layer"),
        ({"../Room.usda": ROOT}, "lies outside of it"),
        ({"Room.usda": ROOT}, "holds no meshes"),
        ({"Room.usda": "#usda 1.0\n(((("}, "can't be opened"),
        ({"Room.usda": ROOT + cube("Wall0", "Wall", (0, 0, 0), (1, 1, 1)).replace("0,1,3,2", "0,1,3,9")}, "does not exist"),
        ({"Room.usda": ROOT + cube("Wall0", "Wall", (0, 0, 0), (1, 1, 1)).replace("[4, 4,", "[400, 4,")}, "are listed"),
        ({"Room.usda": ROOT.replace("Unit = 1", "Unit = 0") + cube("A", "", (0, 0, 0), (1, 1, 1))}, "a unit of"),
    ],
)  # fmt: skip
def test_refusals(tmp_path: Path, layers: dict[str, str], told: str) -> None:
    (tmp_path / "secret.usda").write_text(ROOT + cube("Wall0", "Wall", (0, 0, 0), (1, 1, 1)))
    (tmp_path / "in").mkdir()
    with pytest.raises(InputError, match=told):
        read_points(package(tmp_path / "in" / "a.usdz", layers))


def test_packed_and_damaged_archives(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="packs 'Room.usda'"):
        read_points(package(tmp_path / "a.usdz", {"Room.usda": ROOT + " " * 10_000}, packed=True))
    good = roomplan(tmp_path / "b.usdz").read_bytes()
    for data, told in ((good[:-40], "damaged"), (b"PK" + good[4:], "does not start with"), (good[:2000], "damaged")):
        (tmp_path / "c.usdz").write_bytes(data)
        with pytest.raises(InputError, match=told):
            read_points(tmp_path / "c.usdz")


@pytest.mark.longer
def test_references_in_a_circle_and_by_the_million(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A layer that stands in itself, and ten that each hold the next ten times."""
    monkeypatch.setattr("topomerge.io.usdz.SECONDS", 3)
    circle = ROOT + 'def "Room" (prepend references = @Room.usda@</W>) {}\n' + cube("W", "", (0, 0, 0), (1, 1, 1))
    read_points(package(tmp_path / "a.usdz", {"Room.usda": circle}))
    layers = {}
    for k in range(10):
        inner = (
            cube("W", "", (0, 0, 0), (1, 1, 1))
            if k == 9
            else "".join(f'def "n{n}" (prepend references = @l{k + 1}.usda@) {{}}\n' for n in range(10))
        )
        layers[f"l{k}.usda"] = ROOT + f'def "Room"\n{{\n{inner}}}\n'
    with pytest.raises(InputError):
        read_points(package(tmp_path / "b.usdz", layers))
