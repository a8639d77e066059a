from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.buildings.erect import erect
from topomerge.datasets.reports import realism, realism_measures, realism_sources

from tests.datasets.boxes import BARE, one_room
from topomerge.errors import InputError
from topomerge.types import Array, TrueRoom

ROOM = TrueRoom("a", np.array([[0, 0], [4, 0], [4, 5], [0, 5]], float), 0.0, 2.7)
STEP = 0.05


def plane(u: tuple[float, float], v: tuple[float, float], axis: int, at: float) -> Array:
    """Points 0.05 m apart on a plane across an axis."""
    a, b = np.meshgrid(*(np.arange(x[0] + STEP / 2, x[1], STEP) for x in (u, v)))
    return np.insert(np.column_stack([a.ravel(), b.ravel()]), axis, at, axis=1)


def box(floor: float = 4.0, low: float = 0.0) -> Array:
    """Room of 4 by 5 by 2.7 m with its floor up to x = `floor`, and the wall at x = 0 from a height on."""
    faces = [plane((0, floor), (0, 5), 2, 0.0), plane((0, 4), (0, 5), 2, 2.7)]
    faces += [plane((0, 4), (0, 2.7), 1, y) for y in (0.0, 5.0)]
    return np.concatenate([*faces, plane((0, 5), (low, 2.7), 0, 0.0), plane((0, 5), (0, 2.7), 0, 4.0)])


def test_a_whole_box_lacks_nothing() -> None:
    points = box()
    row = realism_measures.surfaces(points, realism_measures.space_of(ROOM))
    assert row is not None
    assert row["area"] == pytest.approx(20.0)
    assert row["points"] == pytest.approx(len(points) / 20)
    assert row["density"] == pytest.approx(400, rel=0.05)  # edges are shared
    assert [row[k] for k in ("floor", "ceiling", "wall 0", "wall 1", "wall 2", "clutter")] == pytest.approx([0] * 6, abs=1e-9)


def test_missing_floor_and_walls_are_shares_of_what_is_there() -> None:
    row = realism_measures.surfaces(box(floor=3.0, low=1.5), realism_measures.space_of(ROOM))
    assert row is not None
    assert row["floor"] == pytest.approx(0.25 - 0.04, abs=0.03)  # the foot of the walls counts as floor
    side = (5 - 4 * 0.1) / 18  # of the outline; the ends are within 0.2 m of the other walls
    assert row["wall 0"] == pytest.approx(0.9 * side, abs=0.01)  # the floor is its lowest tenth
    assert row["wall 1"] == pytest.approx(side / 2, abs=0.03)
    assert row["wall 2"] == pytest.approx(0, abs=1e-9)


def test_clutter_is_what_is_neither_floor_nor_ceiling_nor_wall() -> None:
    points, table = box(), plane((1, 3), (1, 2), 2, 0.72)
    row = realism_measures.surfaces(np.concatenate([points, table]), realism_measures.space_of(ROOM))
    assert row is not None
    cells = len(np.unique(np.floor(points / 0.1 + 1e-6).astype(int), axis=0))
    assert row["clutter"] == pytest.approx(200 / (cells + 200), rel=0.1)


def test_a_room_that_the_map_does_not_show_is_none() -> None:
    assert realism_measures.surfaces(box() + [30, 0, 0], realism_measures.space_of(ROOM)) is None
    assert realism_measures.surfaces(np.zeros((0, 3)), realism_measures.space_of(ROOM)) is None
    assert realism_measures.together([None]) == {"seen": 0.0}


def test_the_outline_of_a_cloud_is_that_of_its_largest_piece() -> None:
    away = plane((8, 9), (0, 1), 2, 0.0)
    space = realism_measures.outline_of(np.concatenate([box(floor=1.0), away]), 0.0, 2.7)
    assert space.mask.sum() * realism_measures.SURFACE_CELL**2 == pytest.approx(20, rel=0.06)


def test_thickness_is_the_spread_across_planes() -> None:
    rng = np.random.default_rng(0)
    flat, wall = plane((0, 6), (0, 6), 2, 0.0), plane((0, 6), (1, 4), 0, 0.0)
    flat[:, 2] += rng.normal(0, 0.01, len(flat))
    wall[:, 0] += rng.normal(0, 0.03, len(wall))
    spread = realism_measures.thickness(np.concatenate([flat, wall]))
    assert spread["flat"] == pytest.approx(10, rel=0.1) and spread["upright"] == pytest.approx(30, rel=0.1)
    assert spread["loose"] < 0.05
    cloud = realism_measures.thickness(rng.uniform(0, 2, (20_000, 3)))
    assert cloud["loose"] > 0.95


def test_rooms_and_doors_are_counted() -> None:
    row = realism_measures.rooms_and_doors([[4.0, 10.0, 20.0], [150.0]], [0.9, 0.9, 0.9, 1.2])
    assert row["rooms"] == 2 and row["area"] == 15 and row["small"] == row["large"] == 0.25
    assert row["door"] == 0.9 and row["equal"] == 0.75
    assert np.isnan(realism_measures.rooms_and_doors([[4.0]], [])["door"])


def test_maps_are_weighed_by_the_area_of_their_rooms() -> None:
    rows = [{"area": 30.0, "floor": 0.1}, {"area": 10.0, "floor": 0.5}, None]
    assert realism_measures.together(rows)["floor"] == pytest.approx(0.2)


def test_a_table_leaves_out_what_is_not_known() -> None:
    text = list(realism.lines("x", {"a": "a:.1f", "b": "b:.0%"}, [("one", {"a": 1.25}), ("two", {"a": 1.0, "b": 0.5})]))
    assert text == ["| x | a | b |", "|---|---|---|", "| one | 1.2 |  |", "| two | 1.0 | 50% |"]


def test_the_levels_of_a_room_are_found() -> None:
    points = np.concatenate([box(floor=3.0) + [0, 0, 0.02], plane((1, 3), (1, 3), 2, 0.75)])
    assert [realism_sources.level(points, top) for top in (False, True)] == pytest.approx([0.02, 2.72], abs=0.03)


def test_a_scan_of_a_box_lacks_little() -> None:
    row = realism_sources.simulated(erect([one_room()], BARE), "tls")
    assert row["seen"] == 1 and row["floor"] < 0.2 and row["wall 1"] < 0.25 and row["flat"] < 6


def test_points_of_a_vtk_file(tmp_path: Path) -> None:
    path = tmp_path / "a.vtk"
    path.write_text("# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 2 float\n 0 1 2\n3 4 5\nVERTICES 2 4\n")
    assert realism_sources.read_vtk(path).points.tolist() == [[0, 1, 2], [3, 4, 5]]
    path.write_text("POINTS 2 float 0 1")
    with pytest.raises(InputError, match="copy it again"):
        realism_sources.read_vtk(path)


def test_the_folder_must_be_named(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TOPOMERGE_DATA", raising=False)
    assert realism.main(["--fast"]) == 1
    assert "name the folder" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.data
def test_real_clouds_have_a_floor_below_their_ceiling(data_dir: Path) -> None:
    levels = {title: (floor, ceiling) for title, _, floor, ceiling in realism_sources.real_clouds(data_dir)}
    assert len(levels) == 13
    assert all(2.2 < ceiling - floor < 3.3 for floor, ceiling in levels.values())
