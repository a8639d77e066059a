"""Rows of the embedder that ships do not depend on the frame of a map: turned maps have them, rolled by quarter turns."""

from __future__ import annotations

import numpy as np
import pytest

from tests.matching.turned_maps import turned
from tests.scenes import Scene
from topomerge import load_embedder
from topomerge.embedding.learned import LearnedEmbedder
from topomerge.embedding.quarter_turns import TurnedRows
from topomerge.embedding.sheets import rasterise_sheet
from topomerge.extraction.extract import extract
from topomerge.types import Array, Sim3, TopometricMap

CELL = 0.1  # m
# Points on the border of two pixels fall to the same side of it in either frame (`surroundings.TIE`), and so to the other side of
# what stands there: one or two percent of the numbers of crops differ, and rows by less than half of this.
QUARTER_TOLERANCE = 0.02  # of each number of rows of length 1
COSINE_OF_ANY_TURN = 0.99  # cells of a cloud that is turned by 37 degrees are others
WINGS = 30.0  # degrees between two


@pytest.fixture(scope="module")
def describe() -> LearnedEmbedder:
    return load_embedder()


def flat() -> Array:
    """(N, 3) points of four rooms with a cupboard and a shelf, 11 x 8 m, that look the same from no two sides."""
    scene = Scene().shell(0, 0, 11, 8)
    scene.wall((0, 4), (11, 4), doors=(2.0, 7.5)).wall((4.5, 0), (4.5, 4), doors=(3.0,)).wall((7, 4), (7, 8), doors=(1.5,))
    return scene.box(0.5, 0.5, 0, 1.5, 2.5, 0.8).box(9.5, 6, 0, 10.5, 7.6, 1.9).points()


@pytest.fixture(scope="module")
def map() -> TopometricMap:
    return extract(flat(), voxel_size=CELL)


def rows_of(describe: LearnedEmbedder, map: TopometricMap) -> Array:
    """(R, 4, D)."""
    rows = describe(map)
    assert isinstance(rows, TurnedRows) and np.linalg.norm(rows.rows, axis=2) == pytest.approx(1.0)
    return rows.rows


def test_a_map_that_was_turned_by_a_quarter_has_the_same_rows_rolled(describe: LearnedEmbedder, map: TopometricMap) -> None:
    rows = rows_of(describe, map)
    assert len(rows) == 4
    other = map
    for quarters in (1, 2, 3):
        other, _ = turned(other, (30.0, -7.0, 2.0))
        again = rows_of(describe, other)
        apart = [float(np.abs(again - np.roll(rows, -k, axis=1)).max()) for k in range(4)]
        assert apart[quarters] < QUARTER_TOLERANCE
        assert min(apart[:quarters] + apart[quarters + 1 :]) > 0.3  # so that the roll is no matter of course


def test_a_cloud_that_was_turned_by_any_angle_has_the_same_rows(describe: LearnedEmbedder, map: TopometricMap) -> None:
    pose = Sim3(np.radians(37.0), (5.0, -3.0, 1.0))
    other = extract(pose.apply(flat()).astype(np.float32), voxel_size=CELL)
    away = np.linalg.norm(pose.apply(map.rooms["centroid"])[:, None, :2] - other.rooms["centroid"][None, :, :2], axis=2)
    partner = away.argmin(axis=1)
    assert sorted(partner.tolist()) == list(range(len(map.rooms))) and away.min(axis=1).max() < CELL
    turn_a, turn_b = (float(rasterise_sheet(m).turn[0]) for m in (map, other))
    off = np.radians(37.0) + turn_a - turn_b  # by which crops of the other map are turned
    assert np.degrees(off) == pytest.approx(90.0 * round(off / (np.pi / 2)), abs=0.5)
    rows, again = rows_of(describe, map), rows_of(describe, other)[partner]
    cosine = [(again * np.roll(rows, -k, axis=1)).sum(axis=2) for k in range(4)]
    right = round(off / (np.pi / 2)) % 4
    assert cosine[right].min() > COSINE_OF_ANY_TURN
    assert all(cosine[k].mean() < 0.5 for k in range(4) if k != right)


@pytest.mark.longer
@pytest.mark.parametrize("turn", [pytest.param(0.0, marks=pytest.mark.longer), WINGS])
def test_an_oblique_map_stands_as_the_wing_with_more_wall_does(describe: LearnedEmbedder, turn: float) -> None:
    """A wing of four rooms, and one of two beside it at 30 degrees; `turn` is that of the first."""
    one, two = Sim3(np.radians(turn)), Sim3(np.radians(WINGS - turn), (15.0, 9.0, 0.0))
    other = Scene().shell(0, 0, 5, 4).wall((2.5, 0), (2.5, 4), doors=(2.0,)).points()
    oblique = extract(np.concatenate([one.apply(flat()), two.apply(other)]).astype(np.float32), voxel_size=CELL)
    off = float(np.degrees(rasterise_sheet(oblique).turn[0])) - turn
    assert abs((off + 45) % 90 - 45) < 0.5
    rows = rows_of(describe, oblique)
    assert len(rows) == 6 and np.isfinite(rows).all()


@pytest.mark.longer
def test_rows_at_the_true_scale_are_those_of_the_map_in_metres(describe: LearnedEmbedder, map: TopometricMap) -> None:
    """A map that was made half as large again, its heights as they were, as a drawing without scale is raised."""
    larger = flat() * (1.5, 1.5, 1.0)
    other = extract(larger.astype(np.float32), voxel_size=CELL)
    away = np.linalg.norm(1.5 * map.rooms["centroid"][:, None, :2] - other.rooms["centroid"][None, :, :2], axis=2)
    partner = away.argmin(axis=1)
    assert sorted(partner.tolist()) == list(range(len(map.rooms)))
    rows = rows_of(describe, map)
    cosine = {}
    for scale in (1 / 1.5, 1.0):
        at_scale = describe.at_scales(other)(scale)
        assert isinstance(at_scale, TurnedRows)
        cosine[scale] = (rows * at_scale.rows[partner]).sum(axis=2).mean()
        assert at_scale.places == pytest.approx(scale * np.asarray(describe(other).places))  # type: ignore[union-attr]
    assert cosine[1 / 1.5] > 0.9 > cosine[1.0] + 0.05


def test_at_scale_one_rows_are_as_they_are(describe: LearnedEmbedder, map: TopometricMap) -> None:
    assert np.array_equal(describe.at_scales(map)(1.0).rows, rows_of(describe, map))  # type: ignore[union-attr]
