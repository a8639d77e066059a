"""A building model against a scan: walls that stand where they are drawn, elsewhere by so much, or not at all."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.cases import list_longer
from tests.scenes import Scene
from topomerge.changes.model import ElementRow, _decide_elsewhere, compare_with_model, estimate_common_shift
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.io.ifc import ModelElement, read_elements
from topomerge.types import Placement, Sim3, TopometricMap

THICK = 0.15


def box(guid: str, kind: str, low: tuple[float, float, float], high: tuple[float, float, float]) -> ModelElement:
    from topomerge.datasets.core.solids import triangulate_boxes

    a, b = np.array(low), np.array(high)
    vertices, faces = triangulate_boxes(np.array([[*(a + b) / 2, *(b - a)]]))
    return ModelElement(guid, kind, f"{kind} {guid}", vertices, faces.astype(np.int64))


@cache
def scan(shift: float = 0.0, gone: bool = False) -> TopometricMap:
    """A hall of 12 x 8 m, with walls at x = 4 (moved by `shift`) and x = 8."""
    scene = Scene().shell(0, 0, 12, 8).wall((4 + shift, 0), (4 + shift, 8), doors=(2.0,))
    if not gone:
        scene.wall((8, 0), (8, 8), doors=(6.0,))
    points = np.concatenate(scene.parts)
    return extract(points + np.random.default_rng(0).normal(0, 0.004, points.shape))


@pytest.fixture(scope="module")
def model() -> list[ModelElement]:
    walls = {"left": ((-THICK, 0, 0), (0, 8, 2.7)), "right": ((12, 0, 0), (12 + THICK, 8, 2.7))}
    walls |= {"low": ((0, -THICK, 0), (12, 0, 2.7)), "high": ((0, 8, 0), (12, 8 + THICK, 2.7))}
    walls |= {f"at {x}": ((x - THICK / 2, 0, 0), (x + THICK / 2, 8, 2.7)) for x in (4, 8)}
    elements = [box(name, "wall", *corners) for name, corners in walls.items()]
    elements += [box("floor", "slab", (0, 0, -0.2), (12, 8, 0)), box("door", "door", (3.95, 1.55, 0), (4.05, 2.45, 2.05))]
    return [*elements, box("far", "wall", (30, 0, 0), (30.15, 8, 2.7)), box("ceiling", "other", (0, 0, 2.7), (12, 8, 2.8))]


@pytest.fixture(scope="module")
def built() -> TopometricMap:
    return scan()


@pytest.fixture(scope="module")
def seen(model: list[ModelElement], built: TopometricMap) -> dict[str, ElementRow]:
    """What is found of each element in the scan of what was built as drawn."""
    return judge(model, built, built)


def judge(
    model: list[ModelElement], built: TopometricMap, found: TopometricMap, pose: Sim3 | None = None
) -> dict[str, ElementRow]:
    rows = compare_with_model(model, built, found, Placement(pose or Sim3())).elements
    return {row.element.guid: row for row in rows}


def test_what_is_built_as_drawn_is_seen(seen: dict[str, ElementRow]) -> None:
    assert {guid for guid, row in seen.items() if row.state != "seen"} == {"far"} and seen["far"].state == "unseen"
    assert "ceiling" not in seen
    assert all(abs(row.shift) < 0.005 for row in seen.values() if np.isfinite(row.shift))


LONGER_SHIFTS = list_longer(0.02, 0.05, 0.10)


@pytest.mark.parametrize("shift", [-0.05, *LONGER_SHIFTS])
def test_a_wall_that_stands_elsewhere_says_by_how_much(model: list[ModelElement], built: TopometricMap, shift: float) -> None:
    rows = judge(model, built, scan(shift))
    row = rows["at 4"]
    assert row.state == "elsewhere" and row.shift == pytest.approx(shift, abs=0.005) and row.normal[0] == pytest.approx(1)
    assert {guid for guid, row in rows.items() if row.state == "elsewhere"} == {"at 4"}


def test_a_scan_that_lies_off_as_a_whole_deviates_nowhere(model: list[ModelElement], built: TopometricMap) -> None:
    rows = judge(model, built, built, Sim3(0.002, (0.02, -0.03, 0.01)))
    assert {row.state for guid, row in rows.items() if guid != "far"} == {"seen"}
    assert all(abs(row.shift) < 0.008 for row in rows.values() if np.isfinite(row.shift))


@pytest.mark.longer
def test_a_wall_that_is_not_there_is_missing_and_one_that_is_not_modelled_is_new(
    model: list[ModelElement], built: TopometricMap
) -> None:
    found = compare_with_model(model, built, scan(gone=True), Placement(Sim3()))
    (missing,) = [c for c in found.changes if c.kind == "element missing"]
    assert missing.guid == "at 8" and missing.name == "wall wall at 8" and missing.place[0] == pytest.approx(8, abs=0.05)
    reverse = compare_with_model([e for e in model if e.guid != "at 8"], scan(gone=True), built, Placement(Sim3()))
    assert [c.kind for c in reverse.changes if c.element == "wall"] == ["wall new"]


@cache
def scan_side(shift: float) -> TopometricMap:
    """A hall with three walls across it, and of the partition at its end, 12 cm thick, only the side of the hall."""
    scene = Scene().shell(0, 0, 7.94 + shift, 8)
    for x in (2, 4, 6):
        scene.wall((x, 0), (x, 8), doors=(2.0,))
    points = np.concatenate(scene.parts)
    points = points[points[:, 0] < 7.96 + shift]
    return extract(points + np.random.default_rng(1).normal(0, 0.004, points.shape))


@pytest.mark.longer
@pytest.mark.parametrize("shift", [-0.10, *LONGER_SHIFTS])
def test_a_wall_seen_from_one_side_is_not_taken_for_its_other_face(shift: float) -> None:
    walls = {"left": ((-THICK, 0, 0), (0, 8, 2.7)), "low": ((0, -THICK, 0), (8, 0, 2.7))}
    walls |= {"high": ((0, 8, 0), (8, 8 + THICK, 2.7)), "thin": ((7.94, 0, 0), (8.06, 8, 2.7))}
    walls |= {f"at {x}": ((x - THICK / 2, 0, 0), (x + THICK / 2, 8, 2.7)) for x in (2, 4, 6)}
    elements = [*(box(name, "wall", *corners) for name, corners in walls.items()), box("floor", "slab", (0, 0, -0.2), (8, 8, 0))]
    rows = judge(elements, scan_side(0.0), scan_side(shift))
    assert rows["thin"].state == "elsewhere" and rows["thin"].shift == pytest.approx(shift, abs=0.01)
    assert {guid for guid, row in rows.items() if row.state == "elsewhere"} == {"thin"}


def test_what_is_too_narrow_to_be_measured_is_not_called_elsewhere() -> None:
    """A pier as wide as three cells of the scan, 3 cm off: the cells at its edges are a mixture."""
    wide, narrow = (_decide_elsewhere(0.03, float(np.hypot(0.005, m))) for m in (0.0, 0.022))
    assert wide[0] == "elsewhere" and wide[1] > 0.9 and narrow[0] == "seen"


@pytest.mark.parametrize("moved", [0.5, *list_longer(-0.8)])
def test_a_door_that_stands_elsewhere_says_by_how_much(
    model: list[ModelElement], built: TopometricMap, seen: dict[str, ElementRow], moved: float
) -> None:
    assert seen["door"].state == "seen"
    door = box("door", "door", (3.95, 1.55 - moved, 0), (4.05, 2.45 - moved, 2.05))
    found = compare_with_model([e if e.guid != "door" else door for e in model], built, built, Placement(Sim3()))
    (row,) = [r for r in found.elements if r.element.guid == "door"]
    assert row.state == "elsewhere" and abs(row.shift) == pytest.approx(abs(moved), abs=0.08) and abs(row.normal[1]) > 0.99
    assert row.shift * row.normal[1] == pytest.approx(moved, abs=0.08)
    assert [c.guid for c in found.changes if c.kind == "element elsewhere"] == ["door"]


@pytest.mark.longer
def test_a_layer_before_a_wall_does_not_move_it(model: list[ModelElement], built: TopometricMap) -> None:
    """What the scan shows is the furring; of the wall behind it nothing is known."""
    hidden = box("hidden", "wall", (12.2 + THICK, 0, 0), (12.6, 8, 2.7))
    rows = judge([*model, hidden], built, built)
    assert rows["right"].state == "seen" and rows["hidden"].state == "unseen"


def test_the_common_shift_is_that_of_most() -> None:
    assert estimate_common_shift([])["move"].tolist() == [0, 0, 0, 0]


def test_elements_are_read_with_their_ids(tmp_path: Path) -> None:
    pytest.importorskip("ifcopenshell")
    from tests.io.export_maps import two_floors
    from topomerge.io.exports import save_export

    save_export(two_floors(), "ifc", tmp_path / "m.ifc")
    elements = read_elements(tmp_path / "m.ifc")
    import ifcopenshell

    file = ifcopenshell.open(str(tmp_path / "m.ifc"))
    for element in elements:
        entity = file.by_guid(element.guid)
        assert (entity.Name or "") == element.name and len(element.faces) and element.faces.max() < len(element.vertices)
    assert {"wall", "slab", "door", "other"} >= {e.kind for e in elements} >= {"wall", "slab"}
    (tmp_path / "cut.ifc").write_bytes((tmp_path / "m.ifc").read_bytes()[:2000])
    with pytest.raises(InputError, match=r"cut\.ifc: has no end"):
        read_elements(tmp_path / "cut.ifc")


def test_rows_are_plain_values(seen: dict[str, ElementRow]) -> None:
    row = seen["at 4"]
    told = row.serialise()
    assert told["guid"] == "at 4" and abs(told["shift_cm"]) < 0.5 and told["state"] == "seen"
    assert replace(row, shift=float("nan")).serialise()["shift_cm"] is None
