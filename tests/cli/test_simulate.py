"""`topomerge simulate`: files that agree with each other, the same from the same seed, whole or absent."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from topomerge.datasets.buildings.layouts import BUILDING_KINDS

import topomerge
from topomerge.cli.main import KINDS_OF_BUILDINGS
from topomerge.cli.main import main as cli
from topomerge.io.landmarks import read_landmark_file

SMALL_BUILDING = ("--building", "house", "--seed", "3", "--rooms", "4", "--quiet")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One small pair, for all tests that only look at it."""
    path = tmp_path_factory.mktemp("simulate") / "pair"
    assert cli(["simulate", *SMALL_BUILDING, "--sensors", "tls,depth", "--overlap", "0.5", "-o", str(path)]) == 0
    return path


def truth(folder: Path) -> Any:
    return json.loads((folder / "truth.json").read_text())


@pytest.mark.parametrize("place", ["file", "file/x", "/proc/x", ""])
def test_a_folder_that_cannot_be_is_found_first(tmp_path: Path, monkeypatch: Any, capsys: Any, place: str) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("topomerge.datasets.pairs.simulate.simulate_maps", lambda *_, **__: pytest.fail("simulated for nothing"))
    Path("file").touch()
    assert cli(["simulate", "--building", "house", "-o", place]) == 1
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "; give " in err
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_what_cannot_be_simulated_leaves_no_folder(tmp_path: Path, capsys: Any) -> None:
    for words in (("--rooms", "0"), ("--rooms", "0", "--sensors", "tls"), ("--sensors", "eyes"), ("--storeys", "0")):
        assert cli(["simulate", "--building", "house", *words, "-o", str(tmp_path / "a" / "b")]) == 1
        assert capsys.readouterr().err.count("\n") == 1 and not list(tmp_path.iterdir())


def test_kinds_of_buildings_are_those_that_are_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert KINDS_OF_BUILDINGS == BUILDING_KINDS
    assert cli(["simulate", "--building", "castle", "-o", str(tmp_path / "pair")]) == 1
    assert "--building: invalid choice: 'castle' (choose from" in capsys.readouterr().err


def test_files(folder: Path) -> None:
    assert sorted(p.name for p in folder.iterdir()) == ["a.ply", "b.ply", "plan.png", "truth.json"]
    facts = truth(folder)
    assert facts["format"] == 1 and facts["seed"] == 3 and facts["kind"] == "overlap"
    assert [m["sensor"] for m in facts["maps"]] == ["tls", "depth"]
    for entry in facts["maps"]:
        cloud = topomerge.read_points(folder / entry["file"])
        assert len(cloud) == entry["points"] > 1000
        assert (folder / entry["file"]).read_bytes()[:40].startswith(b"ply\nformat binary")
    assert set(facts["shared"]) == set(facts["maps"][0]["visited"]) & set(facts["maps"][1]["visited"])


def test_the_transform_takes_b_to_a(folder: Path) -> None:
    facts = truth(folder)
    matrix = np.array(facts["T_ab"])
    assert not np.allclose(matrix, np.eye(4), atol=0.01)
    assert np.isclose(np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0])), facts["yaw_deg"])
    for a, b in zip(*(m["rooms"] for m in facts["maps"]), strict=True):
        corners = np.column_stack([b["polygon"], np.full(len(b["polygon"]), b["floor"])])
        moved = corners @ matrix[:3, :3].T + matrix[:3, 3]
        assert np.allclose(moved[:, :2], a["polygon"], atol=0.01) and np.allclose(moved[:, 2], a["floor"], atol=0.01)
    for a, b in zip(*(m["doors"] for m in facts["maps"]), strict=True):
        assert np.allclose(matrix[:3, :3] @ b["centre"] + matrix[:3, 3], a["centre"], atol=0.01)


def test_points_lie_in_their_rooms(folder: Path) -> None:
    for entry in truth(folder)["maps"]:
        cloud = topomerge.read_points(folder / entry["file"])
        room = entry["rooms"][entry["visited"][0]]
        outline = shapely.Polygon(room["polygon"]).buffer(0.2)
        inside = shapely.contains_xy(outline, cloud.points[:, :2].astype(float))
        assert inside.sum() > 200


@pytest.mark.longer
def test_the_same_seed_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    more = ("--signs", "good", "--landmarks", "signs,tags,wifi")
    for name in ("again", "third"):
        words = [*SMALL_BUILDING, "--sensors", "tls,depth", "--overlap", "0.5", *more, "-o", str(tmp_path / name)]
        assert cli(["simulate", *words]) == 0
    for path in folder.iterdir():
        if path.suffix != ".json":
            assert path.read_bytes() == (tmp_path / "again" / path.name).read_bytes(), path.name
    for path in (tmp_path / "again").iterdir():
        assert path.read_bytes() == (tmp_path / "third" / path.name).read_bytes(), path.name
    assert read_landmark_file(tmp_path / "again/b.landmarks.csv").is_kind("text").any()


def test_one_sensor_gives_one_cloud(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli(["simulate", "--building", "house", "--sensors", "tls", "-o", str(tmp_path)]) == 0
    assert capsys.readouterr().out.startswith(f"the building house-7-1 has {len(truth(tmp_path)['maps'][0]['rooms'])} rooms -> ")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.ply", "plan.png", "truth.json"]
    assert "T_ab" not in truth(tmp_path)


@pytest.mark.longer
@pytest.mark.parametrize("hard", ["other-building", "other-storey", "twin-wing"])
def test_hard_negatives_share_nothing(tmp_path: Path, hard: str) -> None:
    words = ["--building", "office", "--rooms", "4", "--sensors", "depth,depth", "--hard", hard, "-q", "-o", str(tmp_path)]
    assert cli(["simulate", *words]) == 0
    facts = truth(tmp_path)
    assert facts["kind"] == hard and facts["shared"] == [] and facts["seen_by_both"] == [] and facts["overlap"] == 0
    assert (facts["T_ab"] is None) == (hard != "other-storey")


@pytest.mark.longer
def test_signs_lie_beside_the_clouds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["simulate", "--building", "office", "--rooms", "5", "--seed", "5", "--overlap", "0.8", "-q"]
    for folder, signs in (("x", ["good"]), ("z", ["poor", "--landmarks", "signs,tags,wifi"])):
        assert cli([*words, "--signs", *signs, "-o", str(tmp_path / folder)]) == 0
    a, b = (read_landmark_file(tmp_path / f"x/{side}.landmarks.csv") for side in "ab")
    transform = np.array(json.loads((tmp_path / "x/truth.json").read_text())["T_ab"])
    both = set(a.get_values().tolist()) & set(b.get_values().tolist())
    assert len(both) >= 3
    off = []
    for value in both:
        p, q = (of.table["position"][of.get_values() == value][0] for of in (a, b))
        off.append(np.linalg.norm((transform @ [*q, 1.0])[:3] - p))
    assert np.median(off) < 1.0
    kinds = [read_landmark_file(tmp_path / f"z/{side}.landmarks.csv") for side in "ab"]
    assert 0 < kinds[0].is_kind("text").sum() < len(a) and all(of.is_kind("radio").sum() > 20 for of in kinds)
    assert set(kinds[0].select(kinds[0].is_kind("radio")).get_values()) & set(kinds[1].get_values())
    for which in (["--signs", "good"], ["--landmarks", "wifi"]):
        assert cli(["simulate", *SMALL_BUILDING, "--hard", "other-building", *which, "-o", str(tmp_path / "w")]) == 1
        told = capsys.readouterr().err
        assert "landmarks: the doors of the other building are not known; leave --hard out, or --landmarks and --signs" in told
    assert not (tmp_path / "w").exists()


@pytest.mark.longer
def test_free_scale(tmp_path: Path) -> None:
    words = ["simulate", *SMALL_BUILDING, "--sensors", "tls,mono", "--scale", "free", "-o", str(tmp_path)]
    assert cli(words) == 0
    facts = truth(tmp_path)
    matrix = np.array(facts["T_ab"])
    assert np.isclose(matrix[2, 2], facts["scale"]) and abs(facts["scale"] - 1) > 0.01
    a, b = (np.array(m["rooms"][0]["polygon"]) for m in facts["maps"])
    assert np.isclose(np.linalg.norm(a[1] - a[0]), facts["scale"] * np.linalg.norm(b[1] - b[0]), atol=0.01)


@pytest.mark.longer
@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--building", "office", "--sensors", "tls,sonar"], "sensor 'sonar'"),
        (["--building", "office", "--sensors", "tls,depth,mono"], "not 3"),
        (["--building", "office", "--overlap", "1.5"], "overlap must be 0 to 1"),
        (["--building", "office", "--seed", "-1"], "must be a whole number"),
        (["--building", "office", "--rooms", "2"], "rooms 3 or more"),
        (["--building", "office", "--storeys", "9"], "storeys must be 1 to 8"),
        (["--building", "office", "--sensors", "tls", "--hard", "twin-wing"], "need two sensors"),
        (["--building", "house", "--overlap", "0", "--storeys", "1"], "no two connected parts"),
    ],
)
def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], reason: str) -> None:
    assert cli(["simulate", *words, "-o", str(tmp_path / "pair")]) == 1
    err = capsys.readouterr().err
    assert reason in err and err.count("\n") == 1
    assert not (tmp_path / "pair").exists()


def test_a_file_is_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "pair").write_text("mine")
    assert cli(["simulate", *SMALL_BUILDING, "-o", str(tmp_path / "pair")]) == 1
    assert "is a file" in capsys.readouterr().err and (tmp_path / "pair").read_text() == "mine"
