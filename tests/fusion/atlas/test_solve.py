"""Atlases: all maps of a building in one frame, others apart, wrong pairs thrown out, in any order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import topomerge as tm
from tests.cases import list_longer
from tests.fusion.atlas.atlas_scenes import FRAMES, NAMES, REGISTRATIONS, office_map, stranger, truth
from topomerge.errors import InputError
from topomerge.fusion.atlas.maps import LOADED_AT_ONCE, Maps, hash_map
from topomerge.fusion.atlas.partners import COARSE_PARTNERS, _list_named_maps, compute_coarse_log_odds, find_partners
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.matching.poses import PoseHypothesis, pose_difference
from topomerge.types import Sim3, TopometricMap, build_landmarks

SHIFTED = Sim3(0.0, (4.5, 0.0, 0.0))  # by a room


@pytest.fixture(scope="module")
def registrations():
    """Registrations that were made before."""
    return REGISTRATIONS


@pytest.fixture(scope="module")
def maps() -> list[TopometricMap]:
    return [*(office_map(k) for k in range(4)), stranger()]


@pytest.fixture(scope="module")
def atlas(maps, registrations) -> AtlasResult:
    return tm.build_atlas(maps, registrations=registrations)


def off(result: AtlasResult, k: int, m: int, pose: Sim3) -> tuple[float, float]:
    """m and degrees by which T_km of a result misses another one, in the middle of map m."""
    own = result.transforms[k].inverse() @ result.transforms[m]
    metres, radians, _ = pose_difference(own, pose, result.maps[m].grid.compute_centroids().mean(axis=0))
    return metres, float(np.degrees(radians))


def right(result: AtlasResult, members: dict[int, int], first: int = 0) -> bool:
    """Is every map (place in the result -> part of the office) within 8 cm and half a degree?"""
    gaps = [off(result, first, m, truth(members[first], part)) for m, part in members.items()]
    return all(metres < 0.08 and degrees < 0.5 for metres, degrees in gaps)


@pytest.mark.longer
def test_parts_of_a_building_come_together_and_a_stranger_stays_apart(atlas):
    assert atlas.components == ((0, 1, 2, 3), (4,)) and atlas.alone == (4,) and atlas.status == "parted"
    assert right(atlas, {k: k for k in range(4)}) and atlas.transforms[4] == Sim3()
    assert "west, south, east, north" in atlas.format_summary() and "stranger stands apart" in atlas.format_summary()
    assert atlas.get_probability(0) > 0.9 and atlas.get_probability(1) == 0.0 and not atlas.rejected
    assert len(atlas.links) == 3 and all(atlas.residuals[k] < 0.05 for k in range(4))
    assert atlas.registered[0] < atlas.registered[1] == 10  # the rest follows from the links


@pytest.mark.longer
def test_the_order_of_the_maps_does_not_matter(atlas, maps, registrations):
    order = [3, 4, 1, 0, 2]
    turned = tm.build_atlas([maps[k] for k in order], registrations=registrations)
    assert {frozenset(order[k] for k in c) for c in turned.components} == {frozenset(c) for c in atlas.components}
    for k in (0, 2, 3, 4):
        if order[k] != 4:
            metres, degrees = off(turned, 0, k, atlas.transforms[3].inverse() @ atlas.transforms[order[k]])
            assert metres < 1e-6 and degrees < 1e-6
    assert turned.registered == atlas.registered


def poisoned(maps: list[TopometricMap], registrations: dict, i: int, j: int, wrong: Sim3, p: float) -> dict:
    """The registrations, with a wrong one of maps i and j (`wrong` moves map j in the frame of map i)."""
    keys = hash_map(maps[i]), hash_map(maps[j])
    pose = wrong @ truth(i, j)
    pair, pose = (keys, pose) if keys[0] < keys[1] else (keys[::-1], pose.inverse())
    return {**registrations, pair: (PoseHypothesis(pose, probability=p),)}


@pytest.mark.longer
@pytest.mark.parametrize("p", [0.997, *list_longer(0.93)])
def test_a_wrong_hypothesis_in_a_cycle_is_thrown_out_and_named(maps, registrations, p, monkeypatch):
    maps, first = maps[:4], {id(maps[0]), id(maps[3])}  # the poisoned pair is tried first

    def ranked(inner: Maps, i: int, j: int, scale: str) -> float:
        return 1e6 if {id(inner[i]), id(inner[j])} == first else compute_coarse_log_odds(inner, i, j, scale)

    monkeypatch.setattr("topomerge.fusion.atlas.partners.compute_coarse_log_odds", ranked)
    result = tm.build_atlas(maps, registrations=poisoned(maps, registrations, 0, 3, SHIFTED, p))
    assert result.components == ((0, 1, 2, 3),) and right(result, {k: k for k in range(4)})
    assert [link.maps for link in result.rejected] == [(0, 3)] and result.rejected[0].hypothesis.probability == p
    assert "west, north" in result.format_summary() and "thrown out" in result.format_summary() and result.status == "merged"


@pytest.mark.longer
def test_a_claim_against_two_surer_ones_is_not_believed(maps, registrations):
    """Of west and south, of south and east: right, of west and east: wrong; no other pair is there, free space is silent."""
    sure = poisoned(maps, poisoned(maps, registrations, 0, 1, Sim3(), 0.99), 1, 2, Sim3(), 0.99)  # by their true poses
    result = tm.build_atlas(maps[:3], registrations=poisoned(maps, sure, 0, 2, SHIFTED, 0.95))
    assert (0, 2) not in [link.maps for link in result.links]
    assert all(
        right(result, {k: k for k in component}, component[0]) for component in result.components
    )  # never at the wrong place


@pytest.mark.longer
def test_a_poisoned_map_is_not_let_in(maps, registrations):
    """A stranger that one pair believes to be surely part of the building stands on free floor there."""
    west, other = maps[0], maps[4]
    keys = hash_map(west), hash_map(other)
    pose = Sim3(0.2, (3.0, 2.0, 0.0))
    pair, pose = (keys, pose) if keys[0] < keys[1] else (keys[::-1], pose.inverse())
    result = tm.build_atlas(maps, registrations={**registrations, pair: (PoseHypothesis(pose, probability=0.95),)})
    assert result.alone == (4,) and right(result, {k: k for k in range(4)})
    assert [link.maps for link in result.rejected] == [(0, 4)] and "west, stranger" in result.format_summary()


@pytest.mark.longer
def test_the_joined_map_is_that_of_the_whole(atlas, maps):
    joined = atlas.join_component(0)
    assert 9 <= len(joined.rooms) <= 11 and joined.rooms["area"].sum() == pytest.approx(24 * 14, rel=0.15)
    assert joined.source == " + ".join(NAMES) and joined.free is not None
    bits = joined.provenance
    assert np.bitwise_or.reduce(bits) == 0b1111
    for k in range(4):
        seen = joined.grid.compute_centroids()[(bits >> k) & 1 == 1]
        back = FRAMES[k].inverse().apply(atlas.transforms[k].inverse().apply(seen))
        own = FRAMES[k].inverse().apply(maps[k].grid.compute_centroids())
        assert np.allclose(back.min(axis=0), own.min(axis=0), atol=0.2)
        assert np.allclose(back.max(axis=0), own.max(axis=0), atol=0.2)


@pytest.mark.longer
def test_files_are_read_when_needed(maps, atlas, registrations, tmp_path):
    paths = []
    for k in (0, 1, 2, 3, 4):
        paths.append(tmp_path / f"{k}.tmap")
        tm.save_map(maps[k], paths[-1])
    result = tm.build_atlas(paths, registrations=registrations)
    assert result.components == atlas.components and result.names == atlas.names
    assert all(np.allclose(result.transforms[k].matrix, atlas.transforms[k].matrix, atol=1e-9) for k in range(4))
    inner = Maps(paths)
    assert [len(inner[k].rooms) for k in range(5)] == [len(m.rooms) for m in maps] and len(inner.memory._loaded) == LOADED_AT_ONCE
    assert compute_coarse_log_odds(inner, 0, 2) > compute_coarse_log_odds(inner, 0, 4)


@pytest.mark.longer
def test_of_many_maps_only_those_that_look_alike_are_registered(maps, atlas, registrations, monkeypatch):
    monkeypatch.setattr("topomerge.fusion.atlas.partners.FEW_MAPS", 2)
    monkeypatch.setattr("topomerge.fusion.atlas.partners.MOST_PARTNERS", 2)
    made = dict(registrations)
    result = tm.build_atlas(maps, registrations=made)
    assert result.components == atlas.components and right(result, {k: k for k in range(4)})
    again = tm.build_atlas(maps[::-1], registrations=made)
    assert {frozenset(4 - k for k in c) for c in again.components} == {frozenset(c) for c in result.components}
    assert again.registered == result.registered and len(made) == len(registrations)


class Looks:
    """Maps of which nothing is there but looks of rooms, areas and how likely two lie on each other."""

    def __init__(self, rows: list[np.ndarray]) -> None:
        self.all, self.laid = rows, set[tuple[int, int]]()

    def __len__(self) -> int:
        return len(self.all)

    def get_rows(self, k: int) -> np.ndarray:
        return self.all[k]

    def get_area(self, k: int) -> float:
        return 100.0 + 1e-6 * k

    def has_landmarks(self, k: int) -> bool:
        return False

    def coarse_log_odds(self, i: int, j: int, scale: str) -> float:
        """Of maps that are 40 apart in their numbers 3; of others the less, the farther they are apart."""
        assert scale == "fixed" and (i, j) not in self.laid and i < j
        self.laid.add((i, j))
        return 3.0 if j - i == 40 else -0.1 * (j - i)


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> Looks:
    """80 maps; those that are 40 apart look alike, but for the last one, which has no rooms."""
    monkeypatch.setattr("topomerge.fusion.atlas.partners.compute_coarse_log_odds", Looks.coarse_log_odds)
    rng = np.random.default_rng(0)
    rows = [rng.normal(size=(5, 12)) for _ in range(40)]
    rows += [of + 0.1 * rng.normal(size=of.shape) for of in rows[:39]] + [np.zeros((0, 12))]
    return Looks(rows)


def test_partners_of_many_maps_are_those_on_which_they_lie_best(looks: Looks):
    partners, complete = find_partners(looks)
    assert complete and len(looks.laid) <= COARSE_PARTNERS * 80
    assert all(partners[k][0] == k + 40 and partners[k + 40][0] == k for k in range(39))
    assert all(k in partners[m] for k in range(80) for m in partners[k]) and all(k not in partners[k] for k in range(80))
    assert sum(map(len, partners)) <= 2 * 7 * 80
    assert {39, 75, 76, 77, 78} <= set(partners[79])  # on which the one without rooms lies best
    assert partners[0][1:] == sorted(partners[0][1:])


def test_all_of_few_maps_are_partners(looks: Looks):
    few, complete = find_partners(Looks(looks.all[:11]))
    assert complete and all(few[k] == sorted((m for m in range(11) if m != k), key=lambda m: abs(m - k)) for k in range(11))
    alone, (first, second) = find_partners(Looks(looks.all[:1])), find_partners(Looks(looks.all[:2]))[0]
    assert alone == ([[]], True) and (first, second) == ([1], [0])


def test_maps_with_the_same_rare_sign_are_partners_however_they_lie(looks: Looks, monkeypatch: pytest.MonkeyPatch) -> None:
    signs = {7: "2.113", 23: "2.113", 30: "4.711"}
    place = office_map(0)
    maps = {k: replace(place, landmarks=build_landmarks("text", [v], "hand", np.zeros((1, 3)))) for k, v in signs.items()}
    monkeypatch.setattr(Looks, "has_landmarks", lambda self, k: k in signs)
    monkeypatch.setattr(Looks, "__getitem__", lambda self, k: maps[k], raising=False)
    named = _list_named_maps(looks)
    assert named[7] == [23] and named[23] == [7] and not any(named[k] for k in range(len(looks)) if k not in (7, 23))
    partners, _ = find_partners(looks)
    assert 23 in partners[7] or 7 in partners[23]


def test_without_time_the_maps_that_look_alike_are_partners(looks: Looks):
    partners, complete = find_partners(looks, [(0, 5)], end=-np.inf)
    assert not complete and not looks.laid and all(k + 40 in partners[k] for k in range(39)) and 5 in partners[0]


def test_with_little_time_maps_are_laid_on_those_that_look_most_like_them(looks: Looks, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("topomerge.fusion.atlas.partners.time.perf_counter", lambda: float(len(looks.laid)))
    partners, complete = find_partners(looks, end=40.0)
    assert not complete and {(k, k + 40) for k in range(39)} <= looks.laid and len(looks.laid) == 40
    assert all(partners[k][0] == k + 40 for k in range(39))


@pytest.mark.longer
def test_strangers_stay_strangers(maps, registrations):
    result = tm.build_atlas([maps[0], maps[4]], registrations=registrations)
    assert (
        result.status == "abstained"
        and result.components == ((0,), (1,))
        and "nothing could be connected" in result.format_summary()
    )


def test_bad_maps_are_refused(maps):
    with pytest.raises(InputError, match="copy: is the same map as west; give it once"):
        tm.build_atlas([maps[0], maps[1], replace(maps[0], source="copy")])
    with pytest.raises(InputError, match="atlas takes two maps or more, 1 given"):
        tm.build_atlas(maps[:1])
    with pytest.raises(InputError, match="fixed or free"):
        tm.build_atlas(maps, scale="any")
    with pytest.raises(InputError, match="between 0 and 1"):
        tm.build_atlas(maps, threshold=1.5)
    large = replace(maps[1], grid=replace(maps[1].grid, edge=maps[1].grid.edge * 100), source="cm.ply")
    with pytest.raises(InputError, match="cm.ply: spans .* --unit cm"):
        tm.build_atlas([maps[0], large])
    empty = replace(
        maps[0], grid=maps[0].grid.select_cells(np.zeros(len(maps[0].grid), bool)), room=maps[0].room[:0], source="empty"
    )
    with pytest.raises(InputError, match="empty: has no occupied cells"):
        tm.build_atlas([maps[1], empty])


@pytest.mark.slow
def test_maps_of_unknown_scale(maps):
    grown = tm.extract(1.25 * (FRAMES[2].apply(np.asarray(maps[0].grid.compute_centroids()))).astype(np.float32), name="grown")
    result = tm.build_atlas([maps[0], maps[3], grown], scale="free")
    assert result.status == "merged" and result.transforms[2].scale == pytest.approx(0.8, rel=0.02)
