"""What the network of plans says around a passage, and doors of maps that show no walls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.training.tiny import two_doors
from topomerge.extraction.elevations.wall_doors import (
    SOURCES,
    WALL_DOOR_FEATURES,
    add_wall_doors,
    compute_door_probability,
)
from topomerge.extraction.plans.storey_plan import (
    DOORWAY_CLASS,
    PLAN_SIGNS,
    SHUT_CLASS,
    WALL_CLASS,
    ClassifiedStorey,
    compute_plan_features,
)
from topomerge.training.wall_doors import find_candidates_of_map
from topomerge.types import EDGE_DTYPE


def storey(*holes: tuple[float, float, int], height: float = 0.0) -> ClassifiedStorey:
    """A wall along y = 3.05 m with what stands between two places along it."""
    probability = np.zeros((80, 61, 5), np.float32)
    probability[..., 0] = 1.0
    probability[:, 30] = np.eye(5)[WALL_CLASS]
    for low, high, what in holes:
        probability[round(low / 0.1) : round(high / 0.1), 29:32] = np.eye(5)[what]
    return ClassifiedStorey(probability, np.zeros(2), 0.1, height)


def signs_at(x: float, *storeys: ClassifiedStorey, z: float = 0.0) -> dict[str, float]:
    (row,) = compute_plan_features(storeys, np.array([[x, 3.05, z]]))
    return dict(zip(PLAN_SIGNS, row.tolist(), strict=True))


def test_signs_are_those_around_the_passage_on_its_storey():
    plan = storey((2.0, 2.9, DOORWAY_CLASS), (5.0, 5.9, SHUT_CLASS))
    door, leaf, wall = (signs_at(x, plan) for x in (2.45, 5.45, 7.0))
    assert door["doorway_most"] == 1 and door["doorway"] == pytest.approx(3 / 5) and door["leaf"] == 0
    assert leaf["doorway_most"] == 0 and leaf["leaf"] == 1
    assert wall["walled"] == pytest.approx(1 / 11) and wall["doorway_most"] == wall["leaf"] == 0
    assert signs_at(2.45, plan, storey(height=3.0), z=2.9)["doorway_most"] == 0


def test_no_plan_has_no_signs():
    assert not compute_plan_features((), np.zeros((2, 3))).any()
    assert not compute_plan_features((storey(),), np.array([[-90.0, 0.0, 0.0]])).any()


def test_of_a_map_without_walls_the_plan_is_weighed():
    map = two_doors(0)[0]
    open_there, wall_there = storey((2.0, 2.9, DOORWAY_CLASS)), storey()
    chances = []
    for plan in (open_there, wall_there):
        candidates = find_candidates_of_map(map, (plan,), None)
        at = dict(zip(WALL_DOOR_FEATURES, candidates.features[0], strict=True))
        assert [SOURCES[k] for k in candidates.source] == ["flat"] and at["plan"] == pytest.approx(0.9) and at["wall"] == 0
        chances += compute_door_probability(candidates).tolist()
    assert chances[0] > 0.8 and chances[1] < 0.4
    (edge,) = add_wall_doors(map, (open_there,), None).edges
    assert edge["confidence"] == pytest.approx(chances[0]) and edge["centre"].tolist() == map.edges["centre"][0].tolist()


def test_a_map_without_edges_stays_as_it_is():
    map = replace(two_doors(0)[0], edges=np.zeros(0, EDGE_DTYPE))
    assert len(add_wall_doors(map, (storey(),), None).edges) == 0


def test_the_only_way_between_two_rooms_stays_however_unlikely_and_a_second_one_does_not():
    map = two_doors(0)[0]
    two = np.concatenate([map.edges, map.edges])
    two["centre"][1, 0] = 6.5
    faint = storey((2.0, 2.9, DOORWAY_CLASS))
    edges = add_wall_doors(replace(map, edges=two), (faint,), None).edges
    assert edges["centre"][:, 0].tolist() == [map.edges["centre"][0, 0]] and edges["confidence"][0] > 0.5
    (edge,) = add_wall_doors(map, (storey(),), None).edges
    assert edge["confidence"] < 0.4
