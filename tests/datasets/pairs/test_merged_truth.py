"""Truth by merging: what is believed and closed in cycles is written; what is contradicted or stands alone is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from topomerge.datasets.pairs import merged_truth
from topomerge.datasets.pairs.merged_truth import TriedPair, build_merged_truth, find_components, list_captures, select_consistent
from topomerge.datasets.pairs.pairs_file import read_pairs_file

from tests.matching.turned_maps import turned, uneven
from tests.scenes_map import building
from topomerge.cli.main import main as cli
from topomerge.errors import InputError
from topomerge.io.maps import save_map
from topomerge.registration.pipeline import Registration, register
from topomerge.types import Sim3

PLACES = {"a": Sim3(), "b": Sim3(0.5, (3.0, 1.0, 0.0)), "c": Sim3(-1.0, (0.0, 9.0, 0.0)), "d": Sim3(2.0, (5.0, 5.0, 0.0))}


def tried(a: str, b: str, probability: float = 0.995, off: float = 0.0, refused: str = "") -> TriedPair:
    """A pair whose pose is that of `PLACES`, or so many metres off."""
    pose = Sim3(0.0, (off, 0.0, 0.0)) @ PLACES[a].inverse() @ PLACES[b]
    return TriedPair(a, b, probability, pose, np.zeros(3), refused)


def outcome(pairs: list[TriedPair]) -> dict[str, str]:
    """Why each pair is refused, whatever the order in which they come."""
    said = {one.a + one.b: one.refused for one in select_consistent(pairs)}
    assert {one.a + one.b: one.refused for one in select_consistent(pairs[::-1])} == said
    return said


def test_a_pair_of_two_captures_needs_no_cycle() -> None:
    assert outcome([tried("a", "b"), tried("a", "c", refused="not believed")]) == {"ab": "", "ac": "not believed"}


def test_cycles_that_close_are_taken_and_what_contradicts_them_is_not() -> None:
    square = [tried(a, b) for a, b in ("ab", "bc", "ac", "ad", "bd")]
    assert set(outcome([*square, tried("c", "d")]).values()) == {""}
    said = outcome([*square, tried("c", "d", 0.9999, off=8.0)])  # the most probable one, against triangles
    assert said.pop("cd") == "other pairs contradict it" and set(said.values()) == {""}


def test_a_chain_keeps_its_most_probable_pair() -> None:
    said = outcome([tried("a", "b", 0.999), tried("b", "c", 0.992)])
    assert said == {"ab": "", "bc": "no cycle of other pairs confirms it"}


def test_one_wrong_pair_does_not_join_two_buildings() -> None:
    pairs = [tried("a", "b"), tried("b", "c"), tried("a", "c"), tried("c", "d", 0.9999)]
    said = outcome(pairs)
    assert said.pop("cd") == "no cycle of other pairs confirms it" and set(said.values()) == {""}
    kept = [one for one in select_consistent(pairs) if not one.refused]
    assert find_components(kept) == [("a", "b", "c")]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A map, the same one turned and moved, another building, and files that are no captures."""
    place = tmp_path / "captures"
    place.mkdir()
    save_map(uneven(), place / "one.tmap")
    save_map(turned(uneven(), (7.0, -3.0, 1.5))[0], place / "two.tmap")
    save_map(building(1), place / "other.tmap")
    (place / "notes.md").write_text("no capture")
    (place / "broken.tmap").write_bytes(b"no map")
    return place


@pytest.mark.longer
def test_a_folder_without_truth(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    believed: list[Registration] = []

    def sure(a, b, **options) -> Registration:  # maps by hand are too small to be believed
        found = register(a, b, **options)
        mine = found.probability > 0.3
        believed.append(found)
        return Registration(found.transform, 0.995 if mine else found.probability, mine, reason=found.reason)

    monkeypatch.setattr(merged_truth, "register", sure)
    words = ["dataset", "from-merges", str(folder), "--cache", str(tmp_path / "cache"), "-q", "-o"]
    assert cli([*words, str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out.splitlines()
    verdicts = {" ".join(line.split()[:2]): line.split(maxsplit=2)[2] for line in out[1:4]}
    assert verdicts["one two"].endswith("taken") and "refused: not believed" in verdicts["one other"]
    assert "left out: broken:" in out[-1] and len(believed) == 3
    listing = read_pairs_file(tmp_path / "out")
    (pair,) = listing.pairs
    truth = turned(uneven(), (7.0, -3.0, 1.5))[1]
    assert pair.matrix is not None and np.allclose(pair.matrix, truth.matrix, atol=0.15)
    assert {c.building for c in listing.captures.values()} == {"one"} and listing.negatives == 0
    first = (tmp_path / "out" / "pairs.yaml").read_bytes()
    assert cli([*words, str(tmp_path / "out2")]) == 0
    assert (tmp_path / "out2" / "pairs.yaml").read_bytes() == first
    assert cli(["dataset", "check", str(tmp_path / "out"), "--cache", str(tmp_path / "cache"), "-q"]) == 0
    assert "one two  4 4" in capsys.readouterr().out
    assert cli([*words, str(tmp_path / "out")]) == 1
    assert "holds a pairs.yaml" in capsys.readouterr().err


def test_what_is_not_believed_is_not_written(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setattr(merged_truth, "register", lambda *_, **__: Registration(Sim3(), 0.98, True))
    assert (
        cli(["dataset", "from-merges", str(folder), "--cache", str(tmp_path / "cache"), "-q", "-o", str(tmp_path / "out")]) == 1
    )
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "none of its pairs reaches 0.99" in err and not (tmp_path / "out").exists()


def test_captures_of_a_pairs_file_are_read_without_its_pairs(folder: Path) -> None:
    captures = [{"file": "one.tmap"}, {"name": "deux", "file": "two.tmap", "sensor": "lidar"}]
    (folder / "pairs.yaml").write_text(yaml.safe_dump({"captures": captures, "voxel_size": 0.2}))
    listing = list_captures(folder)
    assert list(listing.captures) == ["one", "deux"] and listing.voxel_size == 0.2


def test_bad_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        build_merged_truth(tmp_path / "none", tmp_path / "out", tmp_path / "cache")
    (tmp_path / "few").mkdir()
    with pytest.raises(InputError, match="holds 0 captures"):
        build_merged_truth(tmp_path / "few", tmp_path / "out", tmp_path / "cache")
    for name in "ab":
        (tmp_path / "few" / f"{name}.tmap").write_bytes(b"no map")
    with pytest.raises(InputError, match="0 captures with rooms"):
        build_merged_truth(tmp_path / "few", tmp_path / "out", tmp_path / "cache")
