"""Colours of walls: what is lighter, redder or yellower than its wall, and doors that nothing but their colour shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from topomerge.models.colour_network import ColourNetwork, exported_colours

from tests.extraction.elevations.doors import SHUT_DOOR, flush_door
from tests.scenes import DOOR
from topomerge.errors import InputError
from topomerge.extraction.elevations.colour_network import (
    COLOUR_CLASSES,
    INPUTS,
    coarse_classes,
    colour_inputs,
    read_network,
    with_colours,
)
from topomerge.extraction.elevations.doorways import SHUT, coloured_both_ways, coloured_classes, place_classes
from topomerge.extraction.elevations.elevation import (
    BANDS,
    DEPTHS,
    FACE_DTYPE,
    STRIP_CHANNELS,
    WALL_CLASSES,
    Elevations,
    strip_colours,
    wall_elevations,
)
from topomerge.extraction.elevations.elevation import HUE_STEP as HUE
from topomerge.extraction.extract import extract, rooms_and_passages
from topomerge.extraction.parameters import PRESETS
from topomerge.extraction.stopwatch import Stopwatch
from topomerge.types import PointCloud, Sim3

WHITE, WOOD = np.array([210, 208, 200]), np.array([150, 95, 50])
SIZE = 120  # places, 6 m


def one_wall():
    """A face along x, and (k, 3) points on it, 2 cm apart."""
    face = np.array([(0, (0, 0), (1, 0), (0, 1), SIZE * 0.05, 0.0)], FACE_DTYPE)
    x, z = np.meshgrid(np.arange(0.01, 6, 0.02), np.arange(0.01, 2.2, 0.02), indexing="ij")
    strips = np.zeros((SIZE, DEPTHS, STRIP_CHANNELS), np.float32)
    return Elevations(face, np.array([0, SIZE]), strips), np.column_stack([x.ravel(), np.full(x.size, 0.02), z.ravel()])


def patch(points, low, high, top=2.1):
    return (points[:, 0] > low) & (points[:, 0] < high) & (points[:, 2] < top)


def test_contrast_is_that_to_most_of_the_wall():
    walls, points = one_wall()
    colours = np.where(patch(points, 2, 3)[:, None], WOOD, WHITE).astype(np.uint8)
    seen = strip_colours(walls, points, colours)
    assert seen.shape == (SIZE, BANDS, 4) and seen[:, 1:10, 0].all()
    assert np.abs(seen[:38, 1:10, 1:]).max() < 1e-6
    leaf = seen[42:58, 2:9].reshape(-1, 4)
    assert leaf[:, 1] == pytest.approx(np.log((WOOD.mean() + 15) / (WHITE.mean() + 15)), abs=1e-5)
    assert leaf[:, 2] == pytest.approx((55 - 2) / HUE, abs=1e-5)
    assert leaf[:, 3] == pytest.approx((122.5 - 50 - (209 - 200)) / HUE, abs=1e-5)


def test_turning_moving_and_mirroring_change_nothing():
    walls, points = one_wall()
    colours = np.where(patch(points, 2, 3)[:, None], WOOD, WHITE).astype(np.uint8)
    move = Sim3(0.7, (5.0, -3.0, 1.0))
    face = walls.faces.copy()
    face["start"], face["floor"] = move.apply(np.zeros((1, 3)))[0, :2], 1.0
    turn = Sim3(0.7).matrix[:2, :2]
    face["along"], face["out"] = turn @ (1, 0), turn @ (0, 1)
    moved = strip_colours(replace(walls, faces=face), move.apply(points), colours)
    assert np.mean(np.abs(moved - strip_colours(walls, points, colours)) > 0.02) < 0.02  # points at the edges of elements


def test_what_was_not_seen_says_nothing():
    walls, points = one_wall()
    hidden = patch(points, 1, 2, 9)
    seen = strip_colours(walls, points[~hidden], np.tile(WHITE, ((~hidden).sum(), 1)).astype(np.uint8))
    assert not seen[22:38].any() and not seen[:, BANDS - 1].any()
    nothing = strip_colours(walls, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    assert nothing.shape == (SIZE, BANDS, 4) and not nothing.any()


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(1)
    made = ColourNetwork(16)
    torch.nn.init.normal_(made.out.weight)
    return made.eval()


def example(rng):
    colours = rng.normal(0, 1, (SIZE, BANDS, 4)).astype(np.float32)
    colours[..., 0] = rng.random((SIZE, BANDS)) < 0.7
    return colours * colours[..., :1], rng.dirichlet(np.ones(4), SIZE // 2).astype(np.float32)


def test_numpy_and_torch_say_the_same(network):
    colours, classes = example(np.random.default_rng(0))
    x, scores = colour_inputs(colours, classes)
    assert x.shape == (SIZE // 2, INPUTS)
    with torch.no_grad():
        wanted = torch.softmax(network(torch.from_numpy(x)[None], torch.from_numpy(scores)[None])[0].T, dim=1).numpy()
    weights = {name: values.astype(np.float32) for name, values in exported_colours(network).items()}
    assert with_colours(colours, classes, weights) == pytest.approx(wanted, abs=1e-5)


def test_a_network_that_learned_nothing_changes_nothing():
    colours, classes = example(np.random.default_rng(1))
    weights = exported_colours(ColourNetwork(8))
    assert with_colours(colours, classes, weights) == pytest.approx(np.maximum(classes, 1e-4), abs=1e-3)
    assert with_colours(np.zeros_like(colours), classes) is classes


def test_half_open_doors_are_open_and_niches_and_cupboards_wall_to_colours():
    classes = np.random.default_rng(3).dirichlet(np.ones(len(WALL_CLASSES)), 5)
    coarse, at = coarse_classes(classes), {name: classes[:, k] for k, name in enumerate(WALL_CLASSES)}
    assert coarse.sum(axis=1) == pytest.approx(np.ones(5))
    assert coarse[:, COLOUR_CLASSES.index("open")] == pytest.approx(at["open"] + at["half"])
    assert coarse[:, COLOUR_CLASSES.index("wall")] == pytest.approx(at["wall"] + at["niche"] + at["cupboard"])
    assert coarse[:, [SHUT, 3]] == pytest.approx(classes[:, [SHUT, 3]]) and WALL_CLASSES[:4] == COLOUR_CLASSES


def test_a_mirrored_wall_is_the_mirrored_answer():
    colours, _ = example(np.random.default_rng(2))
    classes = np.random.default_rng(2).dirichlet(np.ones(len(WALL_CLASSES)), SIZE // 2).astype(np.float32)
    there, back = coloured_both_ways(colours, classes), coloured_both_ways(colours[::-1], classes[::-1])
    assert back[::-1] == pytest.approx(there, abs=1e-5)


def test_a_damaged_network_is_refused(tmp_path):
    np.savez(tmp_path / "colour_network.npz", **{"in.w": np.zeros((3, 4))})
    with pytest.raises(InputError, match=r"colour_network\.npz: is no network of colours of walls"):
        read_network(tmp_path / "colour_network.npz")


def painted_door(points: np.ndarray, top: float = DOOR[1], low: float = 0.0) -> np.ndarray:
    on = (np.abs(points[:, 0] - 4) < 0.1) & (np.abs(points[:, 1] - SHUT_DOOR) < DOOR[0] / 2)
    rng = np.random.default_rng(0)
    colours = np.where((on & (points[:, 2] > low) & (points[:, 2] < top))[:, None], WOOD, WHITE) + rng.normal(0, 4, points.shape)
    return colours.astype(np.uint8)


def shut_doors(cloud: PointCloud):
    edges = extract(cloud).edges
    return edges[~edges["open"]]


def test_a_flush_door_is_seen_by_its_colour_alone():
    points = flush_door()
    assert not len(shut_doors(PointCloud(points)))
    (door,) = shut_doors(PointCloud(points, colors=painted_door(points)))
    assert door["centre"][:2] == pytest.approx([4, SHUT_DOOR], abs=0.1) and door["width"] == pytest.approx(DOOR[0], abs=0.3)


def test_intensities_speak_for_a_flush_door_whatever_they_are_counted_in():
    points = flush_door()
    bright = painted_door(points)[:, 0].astype(np.float32)
    bright[points[:, 2] < points[:, 2].min() + 0.05] -= 96  # a dark floor
    chances = []
    for counted in (bright, bright * 12.5 - 7000):
        scan, _, _, map = rooms_and_passages(PointCloud(points, intensities=counted), 0.1, PRESETS["default"], Stopwatch())
        walls = wall_elevations(map, scan.fine, scan.shades)
        shape = place_classes(walls)
        chances.append([classes[:, SHUT].max() for classes in (shape, coloured_classes(walls, shape))])
    odds = [chance / (1 - chance) for chance in chances[0]]  # the shape alone says .45: four times that is no probability
    assert odds[1] > 4 * odds[0] and chances[0][1] > 0.75
    assert chances[1] == pytest.approx(chances[0], abs=0.02)


def test_what_hangs_on_a_wall_is_no_door():
    points = flush_door()
    assert not len(shut_doors(PointCloud(points, colors=painted_door(points, top=1.9, low=1.1))))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("lacking", [slice(None), slice(0, 1)], ids=["all", "one of three"])
def test_colours_that_are_no_numbers_say_nothing(lacking: slice):
    points = flush_door()
    colours = painted_door(points).astype(np.float32)
    colours[:, lacking] = np.nan
    assert np.array_equal(extract(PointCloud(points, colors=colours)).edges, extract(PointCloud(points)).edges)


@pytest.mark.filterwarnings("error")
def test_a_door_shows_by_the_colours_that_are_numbers():
    points = flush_door()
    colours = painted_door(points).astype(np.float32)
    colours[::3] = np.nan
    (door,) = shut_doors(PointCloud(points, colors=colours))
    assert door["centre"][:2] == pytest.approx([4, SHUT_DOOR], abs=0.1)
