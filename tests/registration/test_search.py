"""Heights that bring a storey to another, scales at which walls are as far apart, and which hypotheses go on."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from topomerge.matching.poses import PoseHypothesis, pair_storeys
from topomerge.registration.search import SEARCH, find_height_offsets, find_scale_candidates, select_strongest
from topomerge.structure.lines import DIRECTION_STEP, compute_direction_profile
from topomerge.types import Sim3

NAN = float("nan")


def storey(floor: float, ceiling: float = NAN, guess: float | None = None, sliced: bool = False) -> Any:
    """What heights are told by."""
    return SimpleNamespace(levels=(floor, ceiling), floor_guess=floor if guess is None else guess, sliced=sliced)


def test_every_storey_is_brought_to_every_other_one_once():
    assert find_height_offsets([storey(0.0), storey(3.0)], [storey(1.0), storey(4.1)]) == pytest.approx([-1.0, -4.1, 2.0])
    assert find_height_offsets([storey(3.0)], [storey(2.0)], 0.5) == [2.0]


def test_ceilings_tell_the_height_where_a_floor_was_not_seen_and_guesses_where_neither_was():
    assert find_height_offsets([storey(0.0, 2.7)], [storey(NAN, 5.0, 2.0)]) == pytest.approx([-2.3])
    assert find_height_offsets([storey(0.0)], [storey(NAN, 5.0, 2.0)]) == [-2.0]
    assert find_height_offsets([storey(NAN, 2.7, 0.2)], [storey(NAN, 5.0, 2.6)], 0.5) == pytest.approx([0.2])


@pytest.mark.parametrize(("gap", "meets", "guessed_meets"), [(0.45, True, True), (0.55, False, True), (1.25, False, False)])
def test_storeys_lie_on_one_level_or_not(gap, meets, guessed_meets):
    """Guesses of floors that were not seen, or were seen by a slice, may be off by more."""

    def on_level(plan: Any, other: Any, scale: float = 1.0) -> bool:
        return bool(pair_storeys([SimpleNamespace(plan=plan)], [SimpleNamespace(plan=other)], -2.0 + gap, scale))

    assert on_level(storey(0.0), storey(2.0)) == meets and on_level(storey(0.0), storey(4.0), 0.5) == meets
    for unseen in (storey(NAN, 5.0, 2.0), storey(2.0, sliced=True)):
        assert on_level(storey(0.0), unseen) == guessed_meets
        assert bool(pair_storeys([SimpleNamespace(plan=unseen)], [SimpleNamespace(plan=storey(0.0))], 2.0 + gap)) == guessed_meets


def test_hypotheses_of_rooms_never_push_out_those_of_the_correlation():
    rooms = [PoseHypothesis(Sim3(), 0.0, from_rooms=True) for _ in range(3)]
    others = [PoseHypothesis(Sim3(), float(k)) for k in range(SEARCH.hypotheses + 20)]
    chosen = select_strongest([*others, *rooms])
    assert chosen[:3] == rooms and [h.score for h in chosen[3:]] == [float(k) for k in range(SEARCH.hypotheses + 19, 19, -1)]


def walls_of(corridors: tuple[float, ...], rows: tuple[float, ...], scale: float = 1.0, turn: float = 0.0) -> Any:
    """Walls at distances along x and along y that are all different."""
    along = np.arange(0, rows[-1], 0.1)
    parts = [np.column_stack([np.full(len(along), x), along]) for x in corridors]
    along = np.arange(0, corridors[-1], 0.1)
    parts += [np.column_stack([along, np.full(len(along), y)]) for y in rows]
    c, s = np.cos(turn), np.sin(turn)
    walls = np.concatenate(parts) @ np.array([[c, s], [-s, c]]) * scale
    profile = compute_direction_profile(walls, 0.1)
    return SimpleNamespace(walls=walls, profile=profile, main_direction=np.radians(profile.argmax() * DIRECTION_STEP))


@pytest.mark.parametrize("scale", [0.62, 1.0, 1.7])
def test_the_scale_brings_walls_as_far_apart_as_those_of_the_other_map(scale):
    """b is the same plan in other units, turned by 40 degrees: the best scale undoes that, and none beside it is as good."""
    plan = (0.0, 4.2, 7.1, 13.4, 15.5), (0.0, 5.3, 7.2, 11.8)
    a, b = walls_of(*plan), walls_of(*plan, 1 / scale, np.radians(40.0))
    best = find_scale_candidates(a, b, [np.radians(-40.0), 0.1])[0]
    assert best[1] == pytest.approx(np.radians(-40.0)) and best[2] == pytest.approx(scale, rel=0.02)
    assert best[0] == pytest.approx(2.0, abs=0.3)  # each direction correlates by 1 at most
