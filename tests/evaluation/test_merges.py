"""What evaluations of merges count: kinds of pairs, plans that nobody can tell apart, what is right."""

from __future__ import annotations

import importlib
from types import SimpleNamespace

import numpy as np
import pytest
from topomerge.datasets.buildings.procedural import make_building

from topomerge.errors import InputError
from topomerge.evaluation.merge_report import compute_headline
from topomerge.evaluation.tasks import run_task
from topomerge.types import Sim3


@pytest.fixture
def module():
    return lambda name: importlib.import_module(f"topomerge.evaluation.{name}")


def test_kinds_and_bins_do_not_depend_on_the_order(module) -> None:
    pairs, modality = importlib.import_module("benchmarks.peers.pairs"), module("merge_report").modality
    assert modality({"sensors": ("laser2d", "lidar")}) == modality({"sensors": ("lidar", "laser2d")}) == "with a slice"
    assert modality({"sensors": ("drawing", "laser2d")}) == "with a floor plan"
    assert modality({"sensors": ("tls", "depth")}) == "3D–3D"
    assert [pairs.find_bin(m2) for m2 in (1.0, 39.9, 40.0, 80.0)] == ["<40 m²", "<40 m²", "40–80 m²", "≥80 m²"]


@pytest.mark.longer
def test_plans_that_differ_only_where_nobody_looked_are_the_same() -> None:
    drawings = importlib.import_module("topomerge.datasets.pairs.grid_drawings")
    building = make_building("office", 5, 2)
    lower = np.array([i for i, r in enumerate(building.rooms) if r.storey == 0])
    here = drawings.MapOrigin("x", "a", building, Sim3(), 0, lower)
    assert drawings.measure_differences(here, here, 0)["walls_differ"] == 0
    everywhere, two = (
        drawings.measure_differences(drawings.replace(here, visited=v), here, 1)["walls_differ"] for v in (lower, lower[:2])
    )
    assert 0 <= two <= everywhere


def test_a_slice_or_a_drawing_says_nothing_of_its_height() -> None:
    right = importlib.import_module("topomerge.training.belief_hypotheses").is_hypothesis_right
    off = [0.1, 1.0, 1.0]
    assert right(off, ("tls", "laser2d")) and right(off, ("drawing", "tls")) and not right(off, ("tls", "depth"))
    assert not right(None, ("tls", "laser2d"))


def test_a_slice_or_a_drawing_on_the_wrong_storey_is_wrong() -> None:
    right = importlib.import_module("topomerge.training.belief_hypotheses").is_hypothesis_right
    for sensors in (("tls", "laser2d"), ("drawing", "tls"), ("laser2d", "laser2d")):
        assert not right([0.05, 2.9, 0.1], sensors) and not right([0.05, -2.9, 0.1], sensors)
        assert right([0.05, 0.45, 0.1], sensors) and right([0.05, -0.45, 0.1], sensors)


def cached(**about: object) -> SimpleNamespace:
    """Of a cached pair what tells where its maps are from."""
    return SimpleNamespace(about=about)


def test_where_both_maps_are_from(module, monkeypatch) -> None:
    pairs = module("tasks")
    monkeypatch.setattr(pairs, "map_other_buildings", lambda split: {(0, 7): "school/Sabadell3"})
    one = cached(building="office-900001-2", kind="overlap", sensors=["tls", "depth"], set=0, item=3)
    assert pairs.find_buildings(one, "test") == ("office-900001-2", "office-900001-2")
    two = cached(building="school/Sabadell1", kind="other-building", sensors=["tls", "depth"], set=0, item=7)
    names = pairs.find_buildings(two, "test")
    assert names == ("school/Sabadell1", "school/Sabadell3")
    assert pairs.describe_places(names)["physical"] == pairs.describe_places(names)["physical_other"] == "campus/school/sabadell"
    drawn = cached(
        building="school/Sabadell1 + school/Sabadell2 + lab-900002-1", kind="other-building", sensors=["tls", "drawing"]
    )
    place = pairs.describe_places(pairs.find_buildings(drawn, "test_drawings"))
    assert place["physical"] == "campus/school/sabadell" and place["other_source"] == "procedural"


def test_pairs_of_the_tables_are_not_made_without_the_real_plans(monkeypatch, tmp_path) -> None:
    """Many are drawn from these; without them the same commands would measure other pairs."""
    monkeypatch.delenv("TOPOMERGE_DATA", raising=False)
    said = r"TOPOMERGE_DATA must name the folder of the real data \(it is not set\)"
    keep = [f"folder={tmp_path}", f"cache={tmp_path}"]
    for task, data in (("merges", "test"), ("merges", "real"), ("merges", "strangers"), ("joined", "test"), ("bending", "test")):
        with pytest.raises(InputError, match=said):
            run_task(task, [f"data={data}", *keep], lambda text: None)
    monkeypatch.setenv("TOPOMERGE_DATA", "nowhere")
    with pytest.raises(InputError, match="it is nowhere"):
        run_task("merges", ["data=test", *keep], lambda text: None)


def test_what_makes_a_pair_hard(module) -> None:
    hard = module("tasks").list_difficulties
    assert hard(cached(difficulty={"moved": 0.6, "gone": 0.25, "glass": 0.1})) == ["much moved furniture"]
    assert hard(cached(difficulty={"moved": 0.3, "glass": 0.5})) == ["glass walls"] and hard(cached()) == []


def test_two_maps_of_one_building_are_no_strangers(module) -> None:
    classify = module("merges").classify_strangers

    def kind(source: str, *names: str, other: str = "") -> str:
        a, b = ({"source": s, "building": name} for s, name in zip((source, other or source), names, strict=True))
        return classify(a, b)

    assert kind("campus", "school/Sabadell1", "school/Franch1") == "strangers"
    assert kind("campus", "school/Sabadell1", "school/Sabadell2") == "other-storey"
    assert kind("campus", "school/Sabadell1 + school/Sabadell2", "school/Sabadell2") == ""  # both may show storey 2
    assert kind("campus", "school/Sabadell1", "school/Sabadell1") == kind("r2v", "a/b/1", "a/b/2") == ""
    assert kind("utexas", "gdc1", "gdc3") == "other-storey"
    assert kind("carmen", "freiburg-101", "Freiburg101_scan", other="ipa") == ""


def test_what_a_row_tells_of_a_pose(module) -> None:
    truth, outcome = Sim3(0.3, (1.0, 2.0, 0.0)), module("merges").compare_pose
    pair = SimpleNamespace(truth=truth, anchor=np.zeros(3), about={"sensors": ["tls", "laser2d"], "kind": "overlap"})
    near, far = (outcome(Sim3(0.3, (1.2, 2.0, z)), pair) for z in (0.3, 3.1))
    assert (near["right"], near["fine"], near["wrong_storey"]) == (True, False, False)
    assert (far["right"], far["fine"], far["wrong_storey"]) == (False, False, True)
    assert outcome(truth, pair)["fine"] and outcome(truth, pair)["scale"] == 1
    assert outcome(None, pair) == {"err": None, "scale": None, "right": False, "fine": False, "wrong_storey": False}


def test_figures_of_the_readme_count_what_was_measured() -> None:
    def row(split: str, err: tuple[float, float, float], believed: bool, **more: object) -> dict[str, object]:
        about = {"set": split, "kind": "overlap", "common": 100.0, "sensors": ["tls", "tls"], "building": "x"}
        return {
            **about,
            "name": "halmstad/HIH_01-HIH_02",
            "source": "halmstad",
            "err": err,
            "believed": believed,
            "answered": True,
            "probability": 0.5,
            "hard": [],
            **more,
        }

    rows = [
        row("real", (0.05, 0.0, 0.1), True), row("real", (0.3, 0.0, 0.1), False), row("real", (4.0, 0.0, 0.1), True),
        row("real", (0.0, 0.0, 0.0), True, name="carmen/csail-first-last", source="carmen"),  # of one capture
        row("lookalikes", (9.0, 0.0, 0.0), True, lookalike="storeys", kind="other-building", tellable=False, physical="y"),
        row("lookalikes", (9.0, 0.0, 0.0), True, lookalike="mirror", kind="other-building", tellable=True, physical="y"),
        row("lookalikes", (9.0, 0.0, 0.0), False, lookalike="mirror", kind="other-building", tellable=True, physical="y"),
    ]  # fmt: skip
    figures = compute_headline(rows, None)
    assert figures["merges-real"][0] == "2; 1; 1; 1" and figures["merges-real"][1].startswith("3 pairs of 1 site")
    assert figures["false-storeys"] == ("1", "1 pairs") and figures["false-lookalikes"] == ("2; 1", "3 pairs")
