"""What is seen around rooms, measured on a made pair: wrong axes, the crops without a network, and the sections written."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.matching.turned_maps import turned, uneven
from topomerge.embedding.learned import load_embedder
from topomerge.embedding.schema import width
from topomerge.embedding.sheets import sheet, sheet_arrays
from topomerge.embedding.surroundings import crops
from topomerge.io import archive

NAME = "made"


@pytest.fixture(scope="module")
def module() -> ModuleType:
    return importlib.import_module("benchmarks.surroundings")


@pytest.fixture
def manifest(tmp_path: Path) -> Path:
    """A set of one pair: a map, and the same one turned by a quarter; and of one of unknown scale."""
    from topomerge.datasets.pairs.evaluation_pair import save_maps

    a = uneven()
    b, pose = turned(a, (30.0, -7.0, 2.0))
    count, folder = len(a.rooms), tmp_path / "pairs"
    folder.mkdir()
    rooms, none = np.arange(count), np.zeros(count, bool)
    sides = {"true_room": rooms, "true_one": ~none, "twin": none, "x": np.zeros((count, width("x")), np.float32)}
    arrays = {f"{side}.{name}": array for side in "ab" for name, array in sides.items()}
    arrays |= {"matches": np.column_stack([rooms, rooms]), "transform": pose.matrix, "anchor": np.zeros(3)}
    about = {"source": "procedural", "building": "office-1", "rooms": "labelled", "scale_free": False}
    for name, free in ((NAME, False), ("free", True)):
        text = json.dumps({**about, "scale_free": free}).encode()
        archive.write(arrays | {"about": np.frombuffer(text, np.uint8)}, folder / f"{name}.npz")
        save_maps((a, b), folder, name)
    rows = [json.dumps({"file": f"{name}.npz"}) for name in (NAME, "free")]
    (tmp_path / "set.jsonl").write_text("\n".join(rows))
    return tmp_path / "set.jsonl"


@pytest.mark.parametrize("degrees", [2, 20, 45])
def test_sheets_stand_in_the_direction_that_is_taken_for_that_of_the_walls(module: ModuleType, degrees: int) -> None:
    map = uneven()
    right = sheet(map).turn
    with module.axes_off(degrees):
        off = sheet(map).turn
    assert np.degrees(off - right) % 90 == pytest.approx(degrees)
    assert sheet(map).turn.tolist() == right.tolist()


def test_crops_are_compared_at_the_turn_at_which_they_are_most_alike(module: ModuleType) -> None:
    map = uneven()
    other, _ = turned(map, (30.0, -7.0, 2.0))
    a, b = (crops(sheet_arrays(m)) for m in (map, other))
    quarters, alike = module.likenesses(a, b)
    assert quarters == 3
    assert alike.argmax(axis=1).tolist() == list(range(len(a))) and np.diag(alike).min() > 0.8
    quarters, again = module.likenesses(a, np.rot90(b, 2, (1, 2)))
    assert quarters == 1 and np.array_equal(again, alike)
    assert module.likenesses(a, a)[1].diagonal() == pytest.approx(1.0)


def test_likeness_is_the_correlation_of_walls_floor_and_things(module: ModuleType) -> None:
    a, b = (np.random.default_rng(k).integers(0, 256, (1, 64, 64, 8), np.uint8) for k in (0, 1))
    right = [np.corrcoef(a[..., :4].ravel(), np.rot90(b, k, (1, 2))[..., :4].ravel())[0, 1] for k in range(4)]
    assert module.likenesses(a, b)[1].item() == pytest.approx(max(right))
    b[..., :4] = 7  # nothing stands out in it, whatever its other planes show
    assert module.likenesses(a, b)[1].item() == 0.0


def test_rows_of_a_pair(module: ModuleType, manifest: Path) -> None:
    pairs = module.load_set(manifest)
    (pair,) = module.usable(pairs)
    assert pair.name == NAME and len(pairs) == 2
    rows = module.ranks(pair, load_embedder())
    assert [(r["way"], r["degrees"]) for r in rows] == [
        *((module.LEARNED, degrees) for degrees in module.WRONG_BY),
        (module.UNTRAINED, 0),
        (module.BOTH_SEEN, 0),
        (module.UNSCALED, 0),
    ]
    assert all(r["queries"] == r["five"] == 2 * len(pair.matches) >= r["first"] for r in rows)
    assert all(r["first"] == r["queries"] and r["turned"] for r in rows if r["degrees"] == 0)


def test_sections_are_written(module: ModuleType, manifest: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = manifest.parent / "page.md"
    page.write_text("# Page\n\n<!-- axes:begin -->\nold\n<!-- axes:end -->\n\nrest\n")
    assert module.main([str(manifest), "--limit", "1", "--write", str(page)]) == 0
    text = page.read_text()
    assert "old" not in text and "rest" in text and f"`python -m benchmarks.surroundings {manifest} --limit 1" in text
    assert text.count("1 pairs of maps, 1 buildings, 8 rooms with a partner") == 2
    assert "| 0° | 1.00 | 1.00 | – | 1.00 | 1 of 1 pairs |" in text and f"| {module.UNTRAINED} | 1.00 |" in text
    assert all(f"| {degrees}° |" in text for degrees in module.WRONG_BY)
    assert "| 45° |" in capsys.readouterr().out


def test_real_pairs_are_told_by_site(
    module: ModuleType, manifest: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a made pair in the place of the real ones."""
    monkeypatch.setattr(module, "real_pairs", lambda cache: module.load_set(manifest))
    assert module.main(["--real", str(manifest.parent)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    assert lines[1].split(" | ")[1:5] == ["1", "8", "1.00", "1.00"]
    assert lines[-1].startswith("| all | 1 | 8 | ")


def test_a_real_map_is_looked_for_among_all_others(module: ModuleType, manifest: Path) -> None:
    """The map turned by a quarter is found beside another building, and nothing else is looked for."""
    retrieval = importlib.import_module("benchmarks.retrieval")
    describe, (pair, other) = load_embedder(), module.load_set(manifest)
    rows = [tuple(describe(map) for map in other.maps())]
    other.about["building"] = "office-2"
    pair.about["title"] = "made"
    found, late = retrieval.real_searches([other], rows, [pair], describe)
    assert [(search.rank, search.building) for search in found] == [(1, retrieval.building(pair))]
    assert late == "Not first: none."
