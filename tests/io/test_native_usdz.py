"""USDZ written placed and joined: points where the placement says, all else as it was."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tests.io.test_native import BENT, TILTED, YAW, move
from tests.io.test_usdz import HEAD, cube, package, roomplan
from topomerge.errors import InputError
from topomerge.io import read_points
from topomerge.io.native import NATIVE, Motion, Source, plan_outputs, save_joined
from topomerge.types import Array, Sim3, transform_points

pxr = pytest.importorskip("pxr")

LARGER = Motion(Sim3(0.7, (3.0, -2.0, 0.5), 1.25).matrix)
RESET = 'uniform token[] xformOpOrder = ["!resetXformStack!"]\n'
FLOAT = 2e-6  # m, of points that are read as floats at 15 m


def places(path: Path) -> Array:
    cloud = read_points(path)
    return cloud.points.astype(np.float64) + cloud.shift


def vertices(path: Path) -> Array:
    """(n, 3) m, z up, of all meshes, as usd-core places them."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    found = []
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Mesh):
            matrix = np.array(UsdGeom.Imageable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
            points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(), float) @ matrix[:3, :3] + matrix[3, :3]
            found.append(points * UsdGeom.GetStageMetersPerUnit(stage))
    x, y, z = np.concatenate(found).T
    return np.stack([x, -z, y] if UsdGeom.GetStageUpAxis(stage) == "Y" else [x, y, z], axis=1)


def scan(path: Path) -> Path:
    """A scanner's mesh in centimetres, z up: two root prims more, one with its material, one in layers of its own, named by their
    places in the package; one mesh that stands apart from what is around it."""
    head = HEAD.format(unit=0.01, up="Z")
    mesh = cube("mesh", "", (100, 0, 50), (100, 200, 30))
    mesh = mesh.replace('def Mesh "mesh"\n    {', 'def Mesh "mesh"\n    {\nrel material:binding = </Looks>')
    apart = cube("apart", "", (500, 0, 50), (100, 200, 30)).replace('Xform "apart"\n{', f'Xform "apart"\n{{\n{RESET}')
    order = 'double3 xformOp:translate = (10, 20, 30)\nuniform token[] xformOpOrder = ["xformOp:translate"]\n'
    looks = 'def Material "Looks"\n{\ndef Shader "wood"\n{\nasset inputs:file = @textures/wood.png@\n}\n}\n'
    other = 'def "other" (prepend references = @parts/one.usda@)\n{\n}\n'
    layers = {
        "scan.usda": head.replace('"Room"', '"scan"') + f'def Xform "scan"\n{{\n{order}{mesh}{apart}}}\n{looks}{other}',
        "textures/wood.png": "a picture",
        "parts/one.usda": head.replace("Room", "one") + 'def Xform "one" (prepend references = @shared/two.usda@)\n{\n}\n',
        "shared/two.usda": head.replace("Room", "two") + cube("two", "", (0, 900, 50), (100, 200, 30)),
    }
    return package(path, layers)


def check_alignment(path: Path) -> None:
    data = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            name, extra = struct.unpack_from("<2H", data, entry.header_offset + 26)
            assert (entry.header_offset + 30 + name + extra) % 64 == 0 and entry.compress_type == zipfile.ZIP_STORED


@pytest.mark.parametrize("make", [roomplan, scan])
def test_one_file_is_placed_and_else_as_it_was(tmp_path: Path, make) -> None:
    source, target = make(tmp_path / "a.usdz"), tmp_path / "out.usdz"
    tally = move(source, target, TILTED)
    assert tally.counts["meshes"] == ((10, 10) if make is roomplan else (3, 3)) and not tally.warnings
    np.testing.assert_allclose(vertices(target), transform_points(TILTED.matrix, vertices(source)), rtol=0, atol=1e-6)
    if make is scan:  # of walls with doors, points on the rim of a door may come or go
        np.testing.assert_allclose(places(target), transform_points(TILTED.matrix, places(source)), rtol=0, atol=FLOAT)
    check_alignment(target)
    with zipfile.ZipFile(source) as before, zipfile.ZipFile(target) as after:
        assert before.namelist() == after.namelist()
        assert all(before.read(name) == after.read(name) for name in before.namelist()[1:])


def test_what_was_placed_is_placed_again(tmp_path: Path) -> None:
    """One transform stands in front, not two."""
    source = roomplan(tmp_path / "a.usdz")
    move(source, tmp_path / "b.usdz", YAW)
    move(tmp_path / "b.usdz", tmp_path / "c.usdz", TILTED)
    expected = transform_points(TILTED.matrix @ YAW.matrix, vertices(source))
    np.testing.assert_allclose(vertices(tmp_path / "c.usdz"), expected, rtol=0, atol=1e-6)
    with zipfile.ZipFile(tmp_path / "c.usdz") as archive:
        assert archive.read("Room.usda").count(b"matrix4d xformOp:transform:topomerge") == 1


def test_two_files_of_other_units_and_axes_become_one(tmp_path: Path) -> None:
    from pxr import Usd

    a, b, target = roomplan(tmp_path / "Kitchen2.usdz"), scan(tmp_path / "scan.usdz"), tmp_path / "joined.usdz"
    tally = save_joined(NATIVE["usdz"], [Source(a), Source(b, LARGER)], target)
    assert tally.counts == {"meshes": (13, 13), "objects": (2, 2)}
    expected = np.concatenate([vertices(a), transform_points(LARGER.matrix, vertices(b))])
    np.testing.assert_allclose(vertices(target), expected, rtol=0, atol=1e-6)
    check_alignment(target)
    stage = Usd.Stage.Open(str(target))
    group = stage.GetPrimAtPath("/Joined/scan_of_scan")
    (material,) = stage.GetPrimAtPath("/Joined/scan_of_scan/scan/mesh/mesh").GetRelationship("material:binding").GetTargets()
    assert material == group.GetPath().AppendChild("Looks")
    picture = stage.GetPrimAtPath(material.AppendChild("wood")).GetAttribute("inputs:file").Get()
    assert picture.resolvedPath.endswith("[scan_of_scan/textures/wood.png]")
    cloud = read_points(target)
    assert cloud.landmarks is not None and [v.replace(" ", "") for v in cloud.landmarks.values] == ["chair", "washerdryer"]


def test_a_joined_file_is_joined_with_a_third_of_the_same_name(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    a, b = roomplan(tmp_path / "a.usdz"), roomplan(tmp_path / "x" / "a.usdz", unit=0.01)
    save_joined(NATIVE["usdz"], [Source(a), Source(b, YAW)], tmp_path / "ab.usdz")
    save_joined(NATIVE["usdz"], [Source(tmp_path / "ab.usdz", TILTED), Source(a)], tmp_path / "aba.usdz")
    one = vertices(a)
    expected = [transform_points(m, one) for m in (TILTED.matrix, TILTED.matrix @ YAW.matrix, np.eye(4))]
    np.testing.assert_allclose(vertices(tmp_path / "aba.usdz"), np.concatenate(expected), rtol=0, atol=1e-6)


def test_a_bent_map_is_placed_as_a_whole(tmp_path: Path) -> None:
    source = roomplan(tmp_path / "a.usdz")
    tally = move(source, tmp_path / "b.usdz", BENT)
    assert "its map is bent; it is placed as a whole, up to" in tally.warnings[0]
    before, after = vertices(source), vertices(tmp_path / "b.usdz")
    apart = [np.linalg.norm(p[:, None] - p[None], axis=2) for p in (before, after)]
    np.testing.assert_allclose(apart[0], apart[1], atol=1e-5)
    assert np.linalg.norm(after - BENT.move_points(before), axis=1).max() < 0.5


def test_refusals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wall = cube("W", "", (0, 0, 0), (1, 1, 1))
    outside = 'def "Room" (prepend references = @../secret.usda@)\n{\n}\n'
    apart = wall.replace('def Xform "W"\n{', f'def Xform "W"\n{{\ndef Xform "in"\n{{\n{RESET}}}\n')
    head = HEAD.format(unit=1, up="Y")
    made = {
        "is not in it and is not followed": {"Room.usda": head + outside},
        "in an instance": {
            "Room.usda": head + 'def "Room" (instanceable = true\nprepend references = @W.usda@</W>)\n{\n}\n',
            "W.usda": head + apart,
        },
        "a unit of": {"Room.usda": head.replace("Unit = 1", "Unit = 0") + wall},
        "two files of one name": {"Room.usda": head + wall, "a.png": "", "A.png": ""},
    }
    for told, layers in made.items():
        with pytest.raises(InputError, match=told) as caught:
            move(package(tmp_path / "a.usdz", layers), tmp_path / "out.usdz", YAW)
        assert "\n" not in str(caught.value) and not (tmp_path / "out.usdz").exists()
    monkeypatch.setattr("topomerge.io.native.usdz.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"a\.usdz: writing a USDZ file needs usd-core: pip install topomerge\[usd\]"):
        move(roomplan(tmp_path / "a.usdz"), tmp_path / "out.usdz", YAW)


def test_meshes_scale_and_poses_do_not(tmp_path: Path) -> None:
    """The plan refuses what can't be scaled before anything is written."""
    source = Source(roomplan(tmp_path / "a.usdz"), LARGER)
    ((path, form, _),) = plan_outputs([source], tmp_path)
    assert path.name == "a_moved.usdz" and form is NATIVE["usdz"]
    (tmp_path / "a.g2o").write_text("VERTEX_SE2 0 0 0 0\n")
    with pytest.raises(InputError, match=r"a\.g2o: is 1\.25 times as large in the joined frame, and poses can't scale"):
        plan_outputs([Source(tmp_path / "a.g2o", LARGER)], tmp_path)
