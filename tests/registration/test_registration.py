"""Known transforms are found again; what cannot be decided is not believed."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cases import list_longer
from tests.fusion.plans_of import MOVE, doubled, grid_of, off, office, part
from tests.scenes import HEIGHT, Scene
from topomerge.errors import InputError
from topomerge.matching.poses import PoseHypothesis
from topomerge.registration.pipeline import FallbackProposals, register
from topomerge.registration.posterior import FEW, WRONG
from topomerge.registration.prepared import prepare
from topomerge.types import Sim3, VoxelGrid


@pytest.fixture(scope="module")
def points():
    return office().points()


@pytest.fixture(scope="module")
def halves(points):
    """The west and the east of the office, in two frames, prepared once; T_ab = MOVE^-1."""
    return prepare(grid_of(part(points, high=(16, 99)))), prepare(grid_of(part(points, low=(5, -99)), MOVE))


@pytest.fixture(scope="module")
def joined(halves):
    return register(*halves)


def middle_in_b(frame=MOVE):
    return tuple(frame.apply(np.array([[10.0, 7.0, 1.0]]))[0])


def test_two_halves_are_joined(joined):
    metres, degrees = off(joined.transform, MOVE.inverse(), middle_in_b())
    assert metres < 0.03 and degrees < 0.1
    assert joined.accepted and joined.probability > 0.8 and joined.features["rmse"] < 0.03
    assert joined.transform.scale == 1.0 and "believed" in joined.reason


def test_the_other_way_round_is_the_inverse(halves, joined):
    there, back = joined, register(*reversed(halves))
    assert np.allclose((there.transform @ back.transform).matrix, np.eye(4), atol=1e-9)
    assert there.probability == back.probability


@pytest.mark.longer
def test_bent_maps_lie_as_high_as_rigid_ones(points):
    """Bending is level: the height is that of the fine registration, finer than a cell."""
    up = 0.035
    raised = Sim3(MOVE.yaw, (*MOVE.translation[:2], up))
    a, b = grid_of(part(points, high=(11, 9))), grid_of(part(points, (3, -99), (14.5, 9)), raised)
    bent, rigid = register(a, b), register(a, b, rigid=True)
    assert bent.bend is not None and bent.bend.transform == bent.transform
    assert bent.transform.translation[2] == pytest.approx(-up, abs=0.01)
    assert bent.transform.translation[2] == rigid.transform.translation[2]


@pytest.mark.longer
def test_bent_maps_of_unknown_scale_lie_as_high_as_rigid_ones(points):
    """Far above their origin, too, where a little more or less scale is half a metre."""
    frame = Sim3(MOVE.yaw, (*MOVE.translation[:2], 60.0), 0.8)
    a, b = grid_of(part(points, high=(17, 99))), grid_of(part(points, low=(4, -99)), frame)
    middle = frame.apply(np.array([[10.0, 7.0, 1.0]]))
    bent, rigid = (register(a, b, scale="free", rigid=rigid).transform for rigid in (False, True))
    assert bent.scale != rigid.scale
    assert bent.apply(middle)[0, 2] == pytest.approx(rigid.apply(middle)[0, 2], abs=0.02) == pytest.approx(1.0, abs=0.1)


def test_order_of_cells_changes_nothing(halves, joined):
    a, b = halves[0].load(), halves[1]
    rows = np.random.default_rng(0).permutation(len(a))
    shuffled = VoxelGrid.from_cells(a.cells[rows], a.origin, a.edge, a.shape, {"offset": a.properties["offset"][rows]})
    assert register(shuffled, b).transform == joined.transform


def test_a_hypothesis_is_tried_and_refined(halves):
    near = Sim3(-MOVE.yaw + 0.03, MOVE.inverse().translation)
    found = register(*halves, proposed=[near])
    assert off(found.transform, MOVE.inverse(), middle_in_b())[0] < 0.03


def test_poses_are_asked_for_only_where_those_of_walls_are_not_believed(halves, joined):
    def never():
        raise AssertionError("asked though walls are believed")

    assert register(*halves, proposed=FallbackProposals(never, joined.probability)).transform == joined.transform


@pytest.mark.longer
def test_poses_of_rooms_decide_where_the_search_of_walls_fails(halves, joined, monkeypatch):
    """In either order."""
    astray = PoseHypothesis(Sim3(1.0, (40.0, 0.0, 0.0)))
    monkeypatch.setattr("topomerge.registration.pipeline.search", lambda *_: [astray])
    pose = joined.transform
    assert not register(*halves).accepted
    late = register(*halves, proposed=FallbackProposals(lambda: [pose], 0.65))
    assert late.accepted and off(late.transform, pose, middle_in_b())[0] < 0.03
    back = register(*reversed(halves), proposed=FallbackProposals(lambda: [pose.inverse()], 0.65))
    assert back.accepted and off(back.transform.inverse(), pose, middle_in_b())[0] < 0.03
    assert len(late.alternatives) == 2 and late.alternatives[0].from_rooms and not late.alternatives[1].from_rooms
    assert not register(*halves, proposed=FallbackProposals(list, 0.65)).accepted  # no matched rooms: as it was


@pytest.mark.longer
@pytest.mark.parametrize("scale", [0.8])
def test_an_unknown_scale_is_found(points, scale):
    frame = Sim3(MOVE.yaw, MOVE.translation, scale)
    a, b = grid_of(part(points, high=(17, 99))), grid_of(part(points, low=(4, -99)), frame, mean=False)
    found = register(a, b, scale="free")
    assert found.transform.scale * scale == pytest.approx(1.0, abs=0.01)
    assert off(found.transform, frame.inverse(), middle_in_b(frame))[0] < 0.15


def test_a_slice_finds_its_place_in_a_scan(points):
    cut = part(points, high=(17, 99))
    cut = cut[np.abs(cut[:, 2] - 0.3) < 0.04]
    found = register(grid_of(points), grid_of(cut, MOVE))
    x, y, _ = found.transform.apply(np.array([middle_in_b()]))[0]
    assert np.hypot(x - 10, y - 7) < 0.15


@pytest.mark.longer
def test_a_mirrored_twin_is_not_believed():
    """The same rooms the other way round, as semi-detached houses are: no turn lays them on each other. Both maps are said to be
    of one storey: where less is known, less is believed."""
    bare = office(furnished=False).points()
    mirrored = bare * np.array([-1, 1, 1], np.float32)
    found = register(grid_of(bare), grid_of(mirrored, MOVE), same="storey")
    assert not found.accepted and found.probability < 0.2 and found.reason.startswith("not believed")
    assert sum(found.posterior.values()) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def row():
    """Eight empty rooms alike on both sides of a corridor."""
    scene = Scene().shell(0, 0, 32, 10)
    for y in (4, 6):
        scene.wall((0, y), (32, y), doors=tuple(2.0 + 4 * k for k in range(8)))
    for x in range(4, 32, 4):
        scene.wall((x, 0), (x, 4)).wall((x, 6), (x, 10))
    return scene.points()


@pytest.mark.parametrize(("same", "first"), list_longer(("nothing", 11.8), ("storey", 19.8)))
def test_empty_rooms_of_one_size_are_not_believed(row, first, same):
    """Neither map shows the corridor whole. They share a pair of rooms, or none: nothing tells which of them is which."""
    found = register(
        grid_of(part(row, (3.8, -9), (16.2, 19))), grid_of(part(row, (first, -9), (first + 8.4, 19)), MOVE), same=same
    )
    assert not found.accepted and found.posterior["wing"] == max(found.posterior[n] for n in WRONG)


def test_one_empty_room_of_one_size_is_not_believed():
    room = grid_of(Scene().shell(0, 0, 5, 4).points())
    found = register(room, grid_of(Scene().shell(0, 0, 5, 4).points(), MOVE))
    assert not found.accepted and found.posterior["here"] < 0.6
    assert found.posterior["wing"] == max(found.posterior[n] for n in WRONG)


@pytest.mark.longer
def test_a_refusal_is_the_same_whichever_map_is_first(row):
    a, b = grid_of(part(row, (3.8, -9), (16.2, 19))), grid_of(part(row, (11.8, -9), (24.2, 19)), MOVE)
    there, back = register(a, b), register(b, a)
    assert there.posterior == pytest.approx(back.posterior) and there.reason == back.reason


@pytest.mark.longer
def test_more_in_common_and_more_that_is_stated_never_lower_a_right_pose(points):
    a = grid_of(part(points, high=(16, 99)))
    believed = []
    for low in (13, 10, 6):
        b = grid_of(part(points, low=(low, -99)), MOVE)
        each = [register(a, b, same=same) for same in ("nothing", "storey")]
        assert off(each[0].transform, MOVE.inverse(), middle_in_b())[0] < 0.2 and each[1].transform == each[0].transform
        assert each[0].accepted and each[0].probability <= each[1].probability
        believed.append(each[0].probability)
    assert believed == sorted(believed)


def test_a_corner_in_common_is_not_believed(points):
    """The maps share one square metre."""
    found = register(grid_of(part(points, high=(6, 6))), grid_of(part(points, (5, 5), (12, 14)), MOVE))
    assert not found.accepted and found.posterior["here"] <= FEW


@pytest.mark.longer
def test_storeys_of_one_plan_are_told_apart_by_the_other_one():
    """The lower storey has another plan above it in one map: only at the right height do both storeys agree."""
    lower, upper = office(), Scene().shell(0, 0, 24, 14).wall((12, 0), (12, 14), doors=(3.0,)).wall((0, 9), (12, 9), doors=(5.0,))
    lift = np.array([0, 0, HEIGHT + 0.3], np.float32)
    both = np.concatenate([lower.points(), upper.points() + lift])
    found = register(grid_of(both), grid_of(part(both, low=(4, -99)), MOVE))
    assert off(found.transform, MOVE.inverse(), middle_in_b())[0] < 0.05


@pytest.mark.longer
def test_a_storey_that_fits_two_is_not_believed(points):
    found = register(grid_of(doubled(office())), grid_of(points, MOVE))
    assert not found.accepted


def test_a_map_without_walls_has_no_pose():
    floor = grid_of(Scene().floor(0, 0, 5, 5).points())
    found = register(floor, floor)
    assert found.transform is None and found.probability == 0 and not found.accepted


def test_another_word_for_the_scale_is_refused(halves):
    with pytest.raises(InputError, match="fixed or free"):
        register(*halves, scale="any")
