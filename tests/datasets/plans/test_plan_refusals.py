"""Plans that are refused, each with its reason; archives and folders of plans."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.core.building import Plan
from topomerge.datasets.plans.floorplans import Refusal, group_siblings, iter_plans, read_plans, summarise

from tests.datasets.plans import plan_files as write
from tests.datasets.plans.plan_checks import MAKERS, pack, reason
from topomerge.errors import InputError

# Refusals


def test_r2v_refusals(tmp_path: Path) -> None:
    assert reason(write.r2v(tmp_path / "a.txt", close=False)).startswith("not closed")
    assert reason(write.r2v(tmp_path / "b.txt", door=0)).startswith("zero-width doors")
    (tmp_path / "c.txt").write_text("1 2 3 x wall 1 1\n")
    assert reason(tmp_path / "c.txt").startswith("bad line: 1")
    (tmp_path / "d.txt").write_bytes(b"\x00\xff\xfe")
    assert reason(tmp_path / "d.txt").startswith("bad line")
    (tmp_path / "e.txt").write_text("")
    assert reason(tmp_path / "e.txt").startswith("no walls")
    # doors of 75 px are taken as narrow ones: the rooms come out tiny
    assert reason(write.r2v(tmp_path / "f.txt", door=75)).startswith("absurd scale")


@pytest.mark.parametrize(
    ("change", "start"),
    [
        ({"outline": [(0, 0), (150, 0)]}, "not closed"),
        ({"outline": [(0, 0), (150, 160), (150, 0), (0, 160)]}, "crosses itself"),
        ({"rooms": ((0, 0, 200, 160), (120, 0, 300, 160))}, "overlapping rooms"),
        ({"centimetres": 0}, "no scale"),
        ({"centimetres": 3}, "absurd scale"),
        ({"centimetres": 20_000}, "absurd scale"),
        ({"rooms": ((0, 0, 150, 160), (400, 0, 500, 160))}, "no doors"),
    ],
)
def test_campus_refusals(change: dict[str, object], start: str, tmp_path: Path) -> None:
    assert reason(write.campus(tmp_path / "a.xml", **change)).startswith(start)  # type: ignore[arg-type]


def test_xml_with_entities_is_not_read(tmp_path: Path) -> None:
    bomb = '<!DOCTYPE b [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><building>&b;</building>'
    for encoding in ("utf-8", "utf-16"):
        (tmp_path / "a.xml").write_bytes(f'<?xml version="1.0" encoding="{encoding}"?>{bomb}'.encode(encoding))
        assert "DOCTYPE" in reason(tmp_path / "a.xml")
    (tmp_path / "a.xml").write_text("<building><floor>")
    assert reason(tmp_path / "a.xml").startswith("damaged XML")
    (tmp_path / "a.xml").write_text("<kml/>")
    assert reason(tmp_path / "a.xml").startswith("not a campus plan")


@pytest.mark.parametrize("mark", ["[", "{", "- "])
def test_yaml_that_is_nested_without_end_does_not_end_the_process(tmp_path: Path, mark: str) -> None:
    (tmp_path / "a.building.yaml").write_text("levels:\n  " + mark * 100_000)
    assert reason(tmp_path / "a.building.yaml").startswith("damaged YAML")


def test_yaml_refusals(tmp_path: Path) -> None:
    path = tmp_path / "a.building.yaml"
    assert reason(write.rmf(path, system="wgs84")).startswith("wrong version")
    assert reason(write.rmf(path, measurements="[]")).startswith("no scale")
    assert reason(write.rmf(path, measurements="[[0, 1, {distance: [3, 1000.0]}]]")).startswith("absurd scale")
    for text, start in (
        ("levels: [", "damaged YAML"),
        ("a: 1", "not an RMF plan"),
        ("!!python/object:os.system {}", "damaged YAML"),
    ):
        path.write_text(text)
        assert reason(path).startswith(start)
    path.write_text("levels: {L1: {measurements: [[0, 1, {distance: [3, 1]}]], vertices: [[0, 0], [9, 0]], walls: [[0, 7]]}}")
    assert reason(path).startswith("bad line")


def test_mall_refusals(tmp_path: Path) -> None:
    assert reason(write.mall(tmp_path / "F1", info=False)).startswith("missing file: floor_info.json")
    assert reason(write.mall(tmp_path / "F2", width=90.0)).startswith("absurd scale")
    path = write.mall(tmp_path / "F3")
    path.write_bytes(path.read_bytes()[:200])
    assert reason(path).startswith("damaged JSON")


def test_amrl_refusals(tmp_path: Path) -> None:
    path = write.amrl(tmp_path / "a.vectormap.json", size=1000)
    assert reason(path).startswith("absurd scale")
    for text, start in (("[", "damaged JSON"), ("[]", "no walls"), ('[{"a": 1}]', "not a line map"), ("3", "not a line map")):
        path.write_text(text)
        assert reason(path).startswith(start)


def test_grid_refusals(tmp_path: Path) -> None:
    assert reason(write.bwi(tmp_path / "1", doors=False)).startswith("missing file: doors.yaml")
    assert reason(write.bwi(tmp_path / "2", resolution=7.0)).startswith("absurd scale")
    path = write.bwi(tmp_path / "3")
    (tmp_path / "3" / "3.png").write_bytes(b"not an image")
    assert reason(path).startswith("damaged image")
    (tmp_path / "3" / "3.png").unlink()
    assert reason(path).startswith("missing file")
    path = write.ipa(tmp_path)
    (tmp_path / "flat.png").unlink()
    assert reason(path) == "missing file: flat.png"


def test_ifc_refusals(tmp_path: Path) -> None:
    pytest.importorskip("ifcopenshell")
    assert reason(write.ifc(tmp_path / "a.ifc", spaces=0)).startswith("no rooms")
    assert reason(write.ifc(tmp_path / "b.ifc", spaces=1)).startswith("too few rooms")
    (tmp_path / "c.ifc").write_text("ISO-10303-21; nothing")
    assert reason(tmp_path / "c.ifc").startswith("damaged IFC")


def test_unknown_and_missing_files(tmp_path: Path) -> None:
    (tmp_path / "a.dwg").write_text("x")
    with pytest.raises(InputError, match="not a known format"):
        read_plans(tmp_path / "a.dwg")
    with pytest.raises(InputError, match="missing file"):
        read_plans(tmp_path / "gone.xml")
    with pytest.raises(InputError, match="no such file"):
        list(iter_plans(tmp_path / "gone"))
    assert list(iter_plans(tmp_path)) == []


# Archives and folders


def test_archive_is_read_in_memory_and_one_bad_member_is_one_refusal(tmp_path: Path) -> None:
    good = write.r2v(tmp_path / "good.txt").read_bytes()
    path = pack(
        tmp_path / "all.tar.xz", {"./00/a.txt": good, "../b.txt": b"x", "c.txt": b"1" * (2 << 20), "d.md": b"", "e.txt": good}
    )
    results = dict(iter_plans(path))
    assert [name for name, r in results.items() if isinstance(r, Plan)] == ["00/a", "e"]
    assert results["c"].reason.startswith("absurd size")  # type: ignore[union-attr]
    assert summarise(results.items()) == {"taken": 2, "bad line": 1, "absurd size": 1}
    assert len(read_plans(f"{path}::00/a")) == 1
    with pytest.raises(InputError, match="no plan"):
        read_plans(f"{path}::zz")
    assert sorted(p.name for p in tmp_path.parent.glob("b.txt")) == []


def test_truncated_archive_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    good = write.r2v(tmp_path / "good.txt").read_bytes()
    path = pack(tmp_path / "all.tar.xz", {f"{k}.txt": good + rng.bytes(2000).hex().encode() for k in range(50)})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    refusals = [r for _, r in iter_plans(path) if isinstance(r, Refusal) and r.reason.startswith("damaged archive")]
    assert len(refusals) == 1
    path.write_bytes(b"")
    assert reason(path).startswith("damaged archive")


def test_absurdly_large_archive_is_not_read_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("topomerge.datasets.plans.r2v.ARCHIVE_BYTES", 1 << 20)
    path = pack(tmp_path / "all.tar.xz", {"zeros.bin": bytes(2 << 20), "a.txt": write.r2v(tmp_path / "a.txt").read_bytes()})
    assert reason(path).startswith("absurd size")


def test_robots_homes_refusals(tmp_path: Path) -> None:
    path = write.valetudo(tmp_path, 1)
    assert reason(path).startswith("no doors")
    about = json.loads(path.read_text())
    path.write_text(json.dumps({**about, "layers": about["layers"][1:]}))
    assert reason(path).startswith("too few rooms: the robot tells none apart")
    path.write_text(path.read_text()[:-1])
    assert isinstance(reason(path), str)
    (tmp_path / "other.json").write_text('{"class": "of something else"}')
    assert [name for name, _ in iter_plans(tmp_path)] == ["home"]


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_damaged_bytes_never_raise(make: Callable[[Path], Path], tmp_path: Path) -> None:
    path = make(tmp_path)
    whole, rng = path.read_bytes(), np.random.default_rng(1)
    for _ in range(25):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 4):
            data[at] = rng.integers(256)
        path.write_bytes(bytes(data[: rng.integers(1, len(data) + 1)]) if rng.random() < 0.3 else bytes(data))
        assert all(isinstance(r, Plan | Refusal) for _, r in iter_plans(path))


def test_folder_names_are_unique_and_siblings_are_found(tmp_path: Path) -> None:
    for name in (
        "site/Sabadell2",
        "site/Sabadell1",
        "site/Lone",
        "site/hillgroundfloor",
        "site/hillsecondfloor",
        "other/Sabadell1",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write.campus(tmp_path / f"{name}_updated.xml")
    write.rmf(tmp_path / "two.building.yaml", levels=2)
    for floor in ("B1", "F1", "F2"):
        write.mall(tmp_path / floor)
    names = [name for name, result in iter_plans(tmp_path) if isinstance(result, Plan)]
    assert len(names) == len(set(names)) == 11 and "B1" in names and "two/L2" in names
    assert group_siblings(tmp_path) == [
        ["B1", "F1", "F2"],
        ["site/Sabadell1", "site/Sabadell2"],
        ["site/hillgroundfloor", "site/hillsecondfloor"],
        ["two/L1", "two/L2"],
    ]


def test_rooms_that_no_door_reaches_are_left_out_and_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rooms = ((0, 0, 150, 160), (150, 0, 300, 160), (400, 0, 450, 60))
    with caplog.at_level(logging.INFO, "topomerge"):
        (plan,) = read_plans(write.campus(tmp_path / "a.xml", rooms=rooms, labels=("CLASSROOM", "CORRIDOR", "CLOSET")))
    assert len(plan.rooms) == 2 and "kept 2 of 3 rooms" in caplog.text
    far = ((0, 0, 150, 160), (150, 0, 300, 160), (400, 0, 900, 160))
    refused = reason(write.campus(tmp_path / "b.xml", rooms=far, labels=("CLASSROOM", "CORRIDOR", "HALL")))
    assert refused.startswith("disconnected: the largest part")
