"""A map that goes on takes the place of its beginning: registered with it, under its name, where it lay."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import topomerge as tm
from tests.fusion.atlas.atlas_scenes import FRAMES, office_map, stranger, truth
from tests.fusion.atlas.test_watch import seen
from tests.fusion.plans_of import office
from topomerge.extraction.extract import extract
from topomerge.fusion.atlas.folder import Entry, StoredAtlas, read_atlas
from topomerge.fusion.atlas.watch import LongerVersion, find_longer_version, replace_map
from topomerge.types import Sim3


@cache
def whole() -> tm.TopometricMap:
    """All of the office, in the frame of its south."""
    return extract(FRAMES[1].apply(office().points()).astype(np.float32), name="whole")


def near(pose: Sim3, true: Sim3, limit: float = 0.2) -> bool:
    at = np.array([[3.0, 3.0, 1.0], [9.0, 9.0, 1.0]])
    return float(np.linalg.norm(pose.apply(at) - true.apply(at), axis=1).max()) < limit


@pytest.mark.longer
def test_the_rest_of_a_building_makes_a_map_longer_and_not_shorter():
    stored = StoredAtlas(Path("house"))
    longer = find_longer_version("west", office_map(0), whole(), stored)
    assert longer is not None and near(longer.pose, truth(0, 1)) and longer.rooms > longer.of / 2 and longer.name == "west"
    assert find_longer_version("whole", whole(), office_map(0), stored) is None
    assert find_longer_version("west", office_map(0), stranger(), stored) is None


def test_poses_of_the_one_before_are_handed_on():
    entries = tuple(Entry(name, f"key {name}", name, 3, 1) for name in ("a", "b", "c"))
    moved = {"1": {"matrix": Sim3(0.5, (2.0, 1.0, 0.0)).matrix.tolist()}}
    listing = {"components": [{"maps": [0, 1]}, {"maps": [2]}], "transforms": moved, "links": [{"maps": [0, 1]}]}
    stored = StoredAtlas(Path("house"), entries, listing=listing)
    pose = Sim3(-0.3, (1.0, 4.0, 0.0))
    after, proposed = replace_map(stored, LongerVersion("b", pose, 3, 3), Entry("b-2", "key new", "b", 5, 1))
    assert [e.name for e in after.entries] == ["a", "b", "c"] and after.entries[1].key == "key new"
    assert np.allclose(after.entries[1].frame.matrix, pose.matrix) and list(proposed) == [("key a", "key new")]
    assert np.allclose(proposed["key a", "key new"].matrix, (Sim3(0.5, (2.0, 1.0, 0.0)) @ pose).matrix)


@pytest.mark.slow
def test_a_longer_version_replaces_its_map_and_the_frame_stays(tmp_path):
    scans, site = tmp_path / "scans", tmp_path / "site"
    scans.mkdir()
    tm.save_map(office_map(0), scans / "a.tmap")
    tm.save_map(office_map(2), scans / "b.tmap")
    assert "; lies with b (0." in seen(scans, site).told[0]
    before = read_atlas(site).get_poses()
    tm.save_map(whole(), scans / "a.tmap")
    lines = seen(scans, site)
    assert "a.tmap -> a: " in lines.told[0] and "takes the place of the map before" in lines.told[0]
    after, entries = read_atlas(site).get_poses(), read_atlas(site).entries
    assert [e.name for e in entries] == ["a", "b"] and near(entries[0].frame, truth(0, 1))
    assert after["a"][1] == entries[0].frame and near(after["b"][1], before["b"][1]) and after["b"][0] == after["a"][0]
    joined = tm.load_map(site / "map_0.tmap")
    assert near(Sim3(), Sim3()) and np.allclose(joined.grid.compute_centroids().min(axis=0)[:2], (0, 0), atol=0.6)
    tm.save_map(stranger(), scans / "a.tmap")
    assert "no longer version of a, which stays; stands apart" in seen(scans, site).told[0]
    assert [e.name for e in read_atlas(site).entries] == ["a", "b", "a-2"]
