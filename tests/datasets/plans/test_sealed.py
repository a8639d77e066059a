"""The sealed set: whoever trains, fits, chooses or looks is refused in one line, and one file alone holds the gate."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.pairs.build import Build, build
from topomerge.datasets.pairs.example import build_candidate
from topomerge.datasets.pairs.flat_maps import read_flat
from topomerge.datasets.pairs.grid_pairs import GridRecipe, draw_grid_items
from topomerge.datasets.pairs.items import Recipe, draw_items
from topomerge.datasets.pairs.plan_examples import PlanRecipe, check_plans
from topomerge.datasets.plans import sealed, splits
from topomerge.datasets.plans.floorplans import Refusal, group_siblings, iter_plans, list_plan_names, read_plans
from topomerge.datasets.public import s3dis
from topomerge.datasets.public.sources import iter_public_pairs

from tests.cases import list_longer
from tests.datasets.plans import plan_files as write
from topomerge.cli.main import main as cli
from topomerge.config import compose
from topomerge.errors import InputError
from topomerge.training.tasks import compose_settings, train

ROOT = Path(__file__).parents[3]
GATE = "open_sealed_set"
SEED = 1_000_005  # a sealed one; nothing is made of it here
CODE = ("topomerge", "models", "datasets", "configs", "benchmarks", "train.py", "evaluate.py")


def lines() -> list[str]:
    text = (ROOT / "datasets" / "plans" / "splits" / "sealed.txt").read_text()
    return [line for line in text.splitlines() if line and not line.startswith("#")]


def sources() -> list[Path]:
    """What is code or settings."""
    files = [p for name in CODE for p in ([ROOT / name] if name.endswith(".py") else (ROOT / name).rglob("*"))]
    return [p for p in files if p.suffix in (".py", ".yaml")]


@pytest.fixture
def line_maps(tmp_path: Path) -> Path:
    """A folder of real data with a sealed line map and one that is not."""
    folder = tmp_path / "utexas_amrl_vectormaps"
    for name in ("AHG1", "GDC1"):
        (folder / name).mkdir(parents=True)
        write.amrl(folder / name / f"{name}.vectormap.json")
    return folder


# Who is refused


MADE_OF_SEEDS: dict[str, Callable[[Path], object]] = {
    "a building": lambda folder: make_building("office", SEED),
    "pairs": lambda folder: build(Build(Recipe(split="sealed", sources={"procedural": 1.0}), cache=str(folder))),
    "pairs of grids": lambda folder: draw_grid_items(GridRecipe(split="sealed")),
    "scans of plans": lambda folder: check_plans(PlanRecipe(split="sealed")),
    "a name": lambda folder: splits.list_members("sealed", "utexas"),
}


@pytest.mark.parametrize("what", MADE_OF_SEEDS)
def test_seeds_are_refused(what: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^sealed: .* is kept for `make sealed`, once a release; take [^\n]*$"):
        MADE_OF_SEEDS[what](tmp_path)


def test_an_item_of_a_cache_that_names_a_sealed_seed_is_refused() -> None:
    (item,) = draw_items(Recipe(pairs=1, sources={"procedural": 1.0}, kinds={"office": 1.0}, sensors={"tls": 1.0}), {})
    with pytest.raises(InputError, match=f"sealed: seed {SEED}"):
        build_candidate(replace(item, buildings=(str(SEED),)), 0, [])


@pytest.mark.parametrize(
    ("task", "data"),
    [
        ("merge_belief", "grids"),
        ("plan_segmentation", "plan_scans"),
        *list_longer(
            ("door_classification", "door_scans"),
            ("room_odds", "room_scans"),
            ("match_odds", "matching_train"),
            ("match_belief", "matching_validation"),
            ("feature_scale", "matching_train"),
        ),
    ],
)
def test_training_and_fitting_are_refused(task: str, data: str, tmp_path: Path) -> None:
    """By way of its settings, as a person would try it. The task embedding reads what `pairs.build` made, which refuses."""
    pytest.importorskip("torch")
    words = [f"task={task}", f"data={data}", "data.split=sealed", "data.folder=", f"cache={tmp_path}", f"runs={tmp_path}"]
    with pytest.raises(InputError, match="sealed: split 'sealed'"):
        train(compose_settings(words), print)


def test_the_user_command_is_refused_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One rule without exception: a hundred thousand seeds of all that there are."""
    assert cli(["simulate", "--building", "office", "--seed", str(SEED), "-o", str(tmp_path / "a")]) != 0
    assert f"sealed: seed {SEED}" in capsys.readouterr().err


def test_plans_are_refused(line_maps: Path) -> None:
    file = line_maps / "AHG1" / "AHG1.vectormap.json"
    results = dict(iter_plans(line_maps))
    refusal = results["AHG1/AHG1.vectormap"]
    assert isinstance(refusal, Refusal) and refusal.reason.startswith("sealed: AHG1")
    assert not isinstance(results["GDC1"], Refusal)
    assert list_plan_names(line_maps) == ["GDC1"] and group_siblings(line_maps) == []
    with pytest.raises(InputError, match="sealed: AHG1"):
        read_plans(file)
    with sealed.open_sealed_set():
        assert len(read_plans(file)) == 1
    with pytest.raises(InputError, match="sealed"):
        read_plans(file)


def test_grids_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "grids_rose2_homes_strands" / "Giraff"
    folder.mkdir(parents=True)
    for path in (folder / "home_x.yaml", tmp_path / "home_x.yaml"):
        with pytest.raises(InputError, match="sealed: home_x" if path.parent == folder else "no such file"):
            read_flat(path)
    look = importlib.import_module("topomerge.evaluation.scans")
    case = look.Case("by eye", "file", "grids_rose2_homes_strands/Giraff/home_x.yaml")
    with pytest.raises(InputError, match="sealed"):
        look.make_scan(case, tmp_path)


def test_what_was_looked_at_is_no_longer_sealed() -> None:
    for name in ("home_f", "home_f.yaml", "EX1.png", "EX1_pgm.png", "movecare_map1.yaml"):
        assert not sealed.is_sealed("strands", f"Giraff/{name}")
        assert not sealed.is_sealed_file(f"/data/grids_rose2_homes_strands/Giraff/{name}")
    for name in ("home_g", "home_g.png", "EX2_pgm.png", "EX1_other.png"):
        assert sealed.is_sealed("strands", f"Giraff/{name}")
        assert sealed.is_sealed_file(f"/data/grids_rose2_homes_strands/Giraff/{name}")
    assert sealed.is_sealed_file("/data/utexas_amrl_vectormaps/AHG1.json")  # the stem of a file, too


def test_published_sets_are_refused(tmp_path: Path) -> None:
    for area in ("Area_5", "Area_6"):
        (tmp_path / area).mkdir()
    reasons = {name: result.reason for name, result in iter_public_pairs(tmp_path, "s3dis")}
    assert reasons["s3dis/Area_6"].startswith("sealed") and not reasons["s3dis/Area_5"].startswith("sealed")
    with pytest.raises(InputError, match="sealed"):
        s3dis.read_area(tmp_path / "Area_6")


# What is sealed


def test_nothing_sealed_is_in_another_list() -> None:
    first, last = sealed.read_list("sealed")[2]
    assert (first, last) == (1_000_000, 1_099_999)
    for split in splits.SPLITS:
        assert splits.get_seed_range(split)[1] < first
        assert not [n for source in splits.FOLDERS for n in splits.list_members(split, source) if sealed.is_sealed(source, n)]
    assert splits.find_split("procedural", str(SEED)) == splits.find_split("utexas", "ASE4") == "sealed"
    assert splits.find_split("utexas", "GDC1") == "test" and splits.find_split("strands", "tsc-2015-2016") == "test"


def test_a_line_holds_for_what_lies_below_it_and_for_nothing_else() -> None:
    assert sealed.is_sealed("mall", "data/site1/F3") and not sealed.is_sealed("mall", "data/site2/F3")
    assert not sealed.is_sealed("mall", "data/site12") and not sealed.is_sealed("procedural", "1100000")
    assert sealed.is_sealed_file("/x/plans_malls/data/site1/F1/geojson_map.json")
    assert not sealed.is_sealed_file("/x/other/data/site1/F1/geojson_map.json")


def test_no_code_and_no_setting_names_what_is_sealed() -> None:
    """Seeds in the sealed range, and paths of sealed files: in the list only."""
    names = [line.rpartition("/")[2] for line in lines() if "procedural" not in line]
    names = [n for n in names if n not in ("Area_6", "Priory")]  # named in what tells the formats of published sets
    any_name = rf"\b({'|'.join(map(re.escape, names))})\b"
    for path in sources():
        text = path.read_text(encoding="utf-8")
        named = re.findall(any_name, text)
        assert not named, f"{path}: {named}"
        numbers = [int(n.replace("_", "")) for n in re.findall(r"(?<![\w.])1_?0\d\d_?\d\d\d(?![\w.])", text)]
        assert not [n for n in numbers if n > 1_000_000 and n <= 1_099_999], path


# The gate


def test_the_sealed_run_alone_enters_the_gate() -> None:
    """By name, by attribute or by a text that `getattr` might be given."""
    entered = []
    for path in sources():
        text = path.read_text(encoding="utf-8")
        if path != ROOT / "datasets" / "plans" / "sealed.py" and path.suffix == ".py" and (GATE in text or "_opened" in text):
            for node in ast.walk(ast.parse(text)):
                words = [getattr(node, name, None) for name in ("id", "attr", "name", "value")]
                if GATE in words or "_opened" in words:
                    entered.append(path.relative_to(ROOT).as_posix())
    assert set(entered) == {"topomerge/evaluation/sealed.py"}


def test_the_gate_closes_behind_an_error() -> None:
    def broken() -> None:
        with sealed.open_sealed_set():
            assert splits.get_seed_range("sealed")[0] == 1_000_000
            raise KeyError

    with pytest.raises(KeyError):
        broken()
    with pytest.raises(InputError):
        splits.get_seed_range("sealed")


def test_every_recipe_that_ships_is_of_another_split() -> None:
    for path in (ROOT / "configs" / "data").glob("*.yaml"):
        assert "sealed" not in path.read_text(), path
    assert compose("build", Build, ["data=heldout_small"]).data.split == "test"
