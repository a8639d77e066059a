"""One's own captures: what `pairs.yaml` may say, true rooms by each kind of truth, splits, training and evaluation on them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from topomerge.datasets.core.building import find_physical_building
from topomerge.datasets.pairs import own_pairs
from topomerge.datasets.pairs.evaluation_pair import load_set
from topomerge.datasets.pairs.own_pairs import build_own_sets, extract_captures, split_pairs
from topomerge.datasets.pairs.pairs_file import (
    CAPTURE_KEYS,
    KEYS,
    PARTS,
    PairTruth,
    find_overlap,
    read_pairs_file,
    read_transform,
)
from topomerge.datasets.pairs.simulate import save_cloud

import topomerge
from tests.matching.turned_maps import turned, uneven
from tests.scenes_map import building
from topomerge.cli.main import main as cli
from topomerge.errors import InputError
from topomerge.evaluation.evaluate import evaluate
from topomerge.evaluation.retrieval import Settings as RetrievalSettings
from topomerge.evaluation.retrieval import measure as measure_retrieval
from topomerge.evaluation.settings import Evaluation
from topomerge.evaluation.tasks import Data, run_task
from topomerge.io.maps import save_map
from topomerge.training import room_matcher
from topomerge.training.packed_pairs import load_pairs
from topomerge.training.tasks import compose_settings, find_weights, train
from topomerge.types import Sim3, TopometricMap, TrueRoom

SHIFT = (7.0, -3.0, 1.5)
HOUSES = (3, 4, 5)
ROOT = Path(__file__).parent.parent.parent.parent


def quiet(text: str) -> None:
    """Say nothing."""


def write_yaml(folder: Path, **values: Any) -> Path:
    """Write a `pairs.yaml` into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "pairs.yaml").write_text(yaml.safe_dump(values), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def houses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clouds of each of three small houses, and the transform between them."""
    folder = tmp_path_factory.mktemp("own") / "my_scans"
    captures, pairs = [], []
    for seed in HOUSES:
        place = folder / f"h{seed}"
        words = ["--seed", str(seed), "--rooms", "4", "--overlap", "0.5", "--sensors", "tls,depth", "-q"]
        assert cli(["simulate", "--building", "house", *words, "-o", str(place)]) == 0
        captures += [{"name": f"h{seed}{side}", "file": f"h{seed}/{side}.ply"} for side in "ab"]
        truth = json.loads((place / "truth.json").read_text())
        pairs.append({"a": f"h{seed}a", "b": f"h{seed}b", "transform": truth["T_ab"]})
    return write_yaml(folder, captures=captures, pairs=pairs, voxel_size=0.15)


@pytest.fixture(scope="module")
def cache(houses: Path, own_cache: Path) -> Path:
    """A cache that holds its maps."""
    build_own_sets(houses, own_cache)
    return own_cache


@pytest.fixture
def maps_folder(tmp_path: Path) -> Path:
    """Maps of one place, the second one turned and moved, and of another."""
    save_map(uneven(), tmp_path / "one.tmap")
    save_map(turned(uneven(), SHIFT)[0], tmp_path / "two.tmap")
    save_map(building(2), tmp_path / "other.tmap")
    return tmp_path


def captures_of(*names: str, **more: Any) -> list[dict[str, Any]]:
    return [{"file": f"{name}.tmap", **more} for name in names]


def test_every_kind_of_truth_gives_the_same_rooms(maps_folder: Path) -> None:
    one, (two, pose) = uneven(), turned(uneven(), SHIFT)
    x, y, z = pose.translation
    table = {"x": x, "y": y, "z": z, "yaw_deg": float(np.degrees(pose.yaw)), "scale": 1.0}
    truths = [{"transform": pose.matrix.tolist()}, {"transform": table}, {"rooms": [[k, k] for k in range(4)]}]
    found = []
    for truth in truths:
        write_yaml(maps_folder, captures=captures_of("one", "two"), pairs=[{"a": "one", "b": "two", **truth}])
        (pair,) = read_pairs_file(maps_folder).pairs
        found.append(find_overlap(pair, (one, two)))
    write_yaml(maps_folder, captures=[{"name": n, "file": "one.tmap", "frame": "survey"} for n in ("one", "two")])
    (framed,) = read_pairs_file(maps_folder).pairs
    assert not framed.listed
    found.append(find_overlap(framed, (one, one)))
    for overlap in found:
        assert overlap.matches.tolist() == [[k, k] for k in range(4)] and overlap.common > 50
        assert (overlap.fit > 0.4).all()
    for overlap in found[:3]:
        assert overlap.transform is not None
        assert np.allclose(overlap.transform.matrix, pose.matrix, atol=0.1)  # that of matched rooms is found by their walls


def test_a_tilted_transform_is_refused_and_a_levelled_file_is_understood() -> None:
    one, (two, pose) = uneven(), turned(uneven(), SHIFT)
    c, s = np.cos(np.radians(20)), np.sin(np.radians(20))
    tip = np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])
    with pytest.raises(InputError, match="tips b over by 20 degrees"):
        find_overlap(PairTruth("a", "b", pose.matrix @ tip), (one, two))
    levelled = replace(two, parameters={**two.parameters, "levelled": tip.T.tolist()})
    overlap = find_overlap(PairTruth("a", "b", pose.matrix @ tip.T), (one, levelled))  # of the file, which is tilted
    assert overlap.matches.tolist() == [[k, k] for k in range(4)]


NAN = float("nan")
EYE = np.eye(4).tolist()


@pytest.mark.parametrize(
    ("transform", "said"),
    [
        (np.diag([1.0, -1, 1, 1]).tolist(), "determinant -1"),
        (np.diag([1.0, 2, 1, 1]).tolist(), "no rotation times a scale"),
        (np.zeros((4, 4)).tolist(), "last row"),
        (np.diag([0.0, 0, 0, 1]).tolist(), "determinant 0"),
        (np.diag([1e-4, 1e-4, 1e-4, 1]).tolist(), "scale"),
        ([[NAN, 0, 0, 0], *EYE[1:]], "must be a number, not nan"),
        ([["x", 0, 0, 0], *EYE[1:]], "must be a number"),
        (EYE[:3], "four rows of four numbers"),
        (7, "must be a list"),
        ({"x": 1, "roll": 2}, "unknown key 'roll'"),
        ({"scale": 0}, "scale: must be 0.01 to 100"),
        ({"scale": -1.0}, "scale: must be 0.01 to 100"),
        ({"yaw_deg": NAN}, "yaw_deg: must be a number"),
        ({"x": True}, "x: must be a number"),
    ],
)
def test_a_truth_that_is_no_rotation(transform: Any, said: str) -> None:
    with pytest.raises(InputError, match=said) as raised:
        read_transform(transform, "pairs.yaml: pairs[0].transform")
    assert "pairs.yaml: pairs[0].transform" in str(raised.value) and "\n" not in str(raised.value)


def test_a_scaled_rotation_with_few_digits_is_taken() -> None:
    matrix = read_transform([[1.732, -1, 0, 5], [1, 1.732, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]], "t")
    assert np.allclose(matrix, read_transform({"x": 5, "y": 6, "z": 7, "yaw_deg": 30, "scale": 2}, "t"), atol=1e-3)


ONE, TWO = {"file": "one.tmap"}, {"file": "two.tmap"}
PAIR = {"a": "one", "b": "two", "transform": {"x": 1}}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"captures": []}, "lists no captures"),
        ({"capture": [ONE]}, "unknown key 'capture'"),
        ({"captures": [{**ONE, "colour": 3}]}, r"captures\[0\]: unknown key 'colour'"),
        ({"captures": [{"name": "one"}]}, "names no file"),
        ({"captures": [{"file": "nowhere.ply"}]}, r"captures\[0\]: .*nowhere.ply: no such file"),
        ({"captures": [ONE, {"file": "two.tmap", "name": "one"}], "pairs": [PAIR]}, "a second capture is called 'one'"),
        ({"captures": [ONE, TWO]}, "no two captures share a place"),
        ({"captures": [ONE, TWO], "pairs": [{**PAIR, "b": "three"}]}, r"pairs\[0\]: no capture is called 'three'"),
        ({"captures": [ONE, TWO], "pairs": [{**PAIR, "b": "one"}]}, "are both 'one'"),
        ({"captures": [ONE, TWO], "pairs": [{**PAIR, "rooms": [[0, 0]]}]}, "has transform and rooms"),
        ({"captures": [ONE, TWO], "pairs": [{"a": "one", "b": "two"}]}, "says nothing of how"),
        ({"captures": [ONE, TWO], "pairs": [PAIR, PAIR]}, r"pairs\[1\]: one and two are listed before"),
        ({"captures": [{**ONE, "building": "x"}, TWO], "pairs": [PAIR]}, "need the same building"),
        ({"captures": [ONE, TWO], "pairs": [{"a": "one", "b": "two", "rooms": [[0, -1]]}]}, "is no pair of rooms"),
        ({"captures": [ONE, TWO], "pairs": [{"a": "one", "b": "two", "rooms": [[0]]}]}, "is no pair of rooms"),
        ({"captures": [ONE, TWO], "pairs": [PAIR], "split": {"train": ["nowhere"]}}, "no capture is of building 'nowhere'"),
        ({"captures": [ONE, TWO], "pairs": [PAIR], "split": {"train": 1}}, "share above 0 each"),
        ({"captures": [ONE, TWO], "pairs": [PAIR], "split": {"seed": "x"}}, "seed: must be a whole number"),
        ({"captures": [{**ONE, "read": {"colour": 1}}, TWO], "pairs": [PAIR]}, "read: unknown key 'colour'"),
        ({"captures": [ONE, TWO], "pairs": [PAIR], "voxel_size": NAN}, "voxel_size: must be a number"),
        ({"captures": [ONE, TWO], "pairs": [PAIR], "voxel_size": 10**400}, "voxel_size: must be 0.02 to 1, not a huge number"),
        ({"captures": [{**ONE, "building": "a\nb"}, TWO], "pairs": [PAIR]}, "building: must be one line"),
        ({"captures": [{"file": "x" * 400}]}, "captures.0.: .*(can't be read|no such file)"),
        ({"captures": [ONE, TWO], "pairs": [{"a": "one", "b": "two", "rooms": [[0, 10**30]]}]}, "is no pair of rooms"),
    ],
)
def test_a_file_that_cannot_be_used(maps_folder: Path, values: Mapping[str, Any], said: str) -> None:
    write_yaml(maps_folder, **values)
    with pytest.raises(InputError, match=said) as raised:
        read_pairs_file(maps_folder)
    assert str(maps_folder / "pairs.yaml") in str(raised.value) and "\n" not in str(raised.value)


def test_the_documented_file_is_taken(tmp_path: Path) -> None:
    text = re.findall(r"(?ms)^```yaml\n(captures.*?)^```$", (ROOT / "docs" / "training.md").read_text())[0]
    (tmp_path / "pairs.yaml").write_text(text)
    for entry in yaml.safe_load(text)["captures"]:
        (tmp_path / entry["file"]).parent.mkdir(exist_ok=True)
        (tmp_path / entry["file"]).touch()
    listing = read_pairs_file(tmp_path)
    assert set(yaml.safe_load(text)) == set(KEYS)
    assert {key for entry in yaml.safe_load(text)["captures"] for key in entry} == set(CAPTURE_KEYS)
    assert [(p.a, p.b, p.listed) for p in listing.pairs] == [
        *(("a", "b", True), ("d", "e", True), ("a", "c", True), ("c", "d", True)),
        ("b", "c", False),
    ]
    assert listing.captures["a"].building == "home" and listing.captures["d"].building == "office"
    assert listing.captures["c"].read == {"resolution": 0.05} and listing.captures["b"].sensor == "lidar"


def test_an_empty_folder_and_a_file_that_is_no_yaml(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no pairs\.yaml"):
        read_pairs_file(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        read_pairs_file(tmp_path / "nowhere")
    for text in ("captures: [", "\0", "- 1", ""):
        (tmp_path / "pairs.yaml").write_text(text)
        with pytest.raises(InputError, match=r"pairs\.yaml: (is no YAML|must be a table)") as raised:
            read_pairs_file(tmp_path)
        assert "\n" not in str(raised.value)


def wrong_pair(folder: Path, cache: Path, **truth: Any) -> str:
    write_yaml(folder, captures=captures_of("one", "two"), pairs=[{"a": "one", "b": "two", **truth}])
    listing = read_pairs_file(folder)
    _, faults = extract_captures(listing, cache)
    assert not faults
    with pytest.raises(InputError) as raised:
        find_overlap(listing.pairs[0], (uneven(), turned(uneven(), SHIFT)[0]))
    assert cli(["dataset", "check", str(folder), "--cache", str(cache), "-q"]) == 1
    return str(raised.value)


def test_pairs_that_are_wrong_are_named(maps_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cache = maps_folder / "cache"
    for truth, said in (
        ({"transform": {"x": 500}}, "share no floor"),
        ({"rooms": [[0, 99]]}, "two has no room 99; it has rooms 0 to 3"),
        ({"rooms": [[0, 3], [1, 2], [2, 1], [3, 0]]}, "no pose lays these rooms over each other"),
    ):
        text = wrong_pair(maps_folder, cache, **truth)
        assert said in text and text.startswith("one, two: ") and "\n" not in text
        out, err = capsys.readouterr()
        assert f"WRONG: {text}" in out and err.count("\n") == 1 and str(maps_folder) in err


def test_a_capture_without_rooms_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = np.random.default_rng(0).uniform(0, 1, (3000, 3)).astype(np.float32)
    save_cloud(topomerge.PointCloud(points), tmp_path / "cube.ply")
    save_cloud(topomerge.PointCloud(points), tmp_path / "again.ply")
    pairs = [{"a": "cube", "b": "again", "transform": {"x": 1}}]
    write_yaml(tmp_path, captures=[{"file": "cube.ply"}, {"file": "again.ply"}], pairs=pairs)
    for _ in range(2):  # what is refused is kept
        with pytest.raises(InputError, match=r"cube\.ply: ") as raised:
            build_own_sets(tmp_path, tmp_path / "cache")
        assert "\n" not in str(raised.value)
    assert cli(["dataset", "check", str(tmp_path), "--cache", str(tmp_path / "cache"), "-q"]) == 1
    out, err = capsys.readouterr()
    assert "a capture has no map" in out and "WRONG: cube: " in out and err.count("\n") == 1


def listing_of(folder: Path, buildings: int, captures: int, **more: Any) -> Any:
    """A file that lists pairs of all captures of each building; no map is read."""
    names = [(f"b{k}", f"b{k}c{n}") for k in range(buildings) for n in range(captures)]
    for _, name in names:
        (folder / f"{name}.ply").touch()
    entries = [{"file": f"{name}.ply", "building": of, "frame": of} for of, name in names]
    return read_pairs_file(write_yaml(folder, captures=entries, **more))


def test_buildings_are_split_and_negatives_are_drawn(tmp_path: Path) -> None:
    listing = listing_of(tmp_path, 10, 3)
    parts, warnings = split_pairs(listing)
    of = {part: {listing.captures[p.a].building for p in pairs if not p.different} for part, pairs in parts.items()}
    assert [len(of[part]) for part in PARTS] == [6, 2, 2] and len(set().union(*of.values())) == 10 and not warnings
    for part, pairs in parts.items():
        strangers = [pair for pair in pairs if pair.different]
        assert len(strangers) == np.ceil(0.25 * 3 * len(of[part]))
        for pair in strangers:
            buildings = {listing.captures[name].building for name in (pair.a, pair.b)}
            assert len(buildings) == 2 and buildings & of[part]
            assert part != "train" or buildings <= of["train"]
    again = split_pairs(listing_of(tmp_path, 10, 3))[0]
    assert [(p.a, p.b) for p in again["test"]] == [(p.a, p.b) for p in parts["test"]]
    other = split_pairs(listing_of(tmp_path, 10, 3, split={"seed": 1}))[0]
    assert [(p.a, p.b) for p in other["test"]] != [(p.a, p.b) for p in parts["test"]]
    named = {"train": [f"b{k}" for k in range(1, 9)], "val": ["b0"], "test": ["b9"]}
    parts, _ = split_pairs(listing_of(tmp_path, 10, 2, split=named, negatives=0))
    assert [(p.a, p.b) for p in parts["val"]] == [("b0c0", "b0c1")] and [(p.a, p.b) for p in parts["test"]] == [("b9c0", "b9c1")]


def test_two_buildings_are_told_about_and_one_holds_captures_out(tmp_path: Path) -> None:
    parts, (text,) = split_pairs(listing_of(tmp_path, 2, 2))
    assert parts["val"] == parts["test"] and "flatters" in text
    listing = listing_of(tmp_path, 1, 6)
    parts, (text,) = split_pairs(listing)
    assert "captures are held out" in text and "'b0'" in text
    trained = {name for pair in parts["train"] for name in (pair.a, pair.b)}
    assert len(trained) == 4 and sum(len(pairs) for pairs in parts.values()) == 15
    assert all(len({pair.a, pair.b} - trained) > 0 for part in ("val", "test") for pair in parts[part])
    with pytest.raises(InputError, match="none can be held out"):
        split_pairs(listing_of(tmp_path, 1, 2))
    with pytest.raises(InputError, match="give shares, which hold out captures"):
        split_pairs(listing_of(tmp_path, 1, 6, split={"train": ["b0"]}))


def test_storeys_of_one_frame_are_no_pair_but_strangers(tmp_path: Path) -> None:
    for name in "abcd":
        (tmp_path / f"{name}.ply").touch()
    captures = [{"file": f"{n}.ply", "frame": "f", "storey": s} for n, s in zip("abcd", (0, 0, 1, 1), strict=True)]
    listing = read_pairs_file(write_yaml(tmp_path, captures=captures, split={"seed": 0}, negatives=1.0))
    assert [(p.a, p.b) for p in listing.pairs] == [("a", "b"), ("c", "d")]
    parts, _ = split_pairs(listing)
    strangers = [pair for pair in parts["test"] if pair.different]
    assert strangers and all({pair.a, pair.b} & {"a", "b"} and {pair.a, pair.b} & {"c", "d"} for pair in strangers)


def test_the_building_is_what_its_owner_calls_it() -> None:
    assert find_physical_building("own", "Site/b2-scan") == "own/Site/b2-scan" != find_physical_building("own", "Other/b2-scan")
    assert find_physical_building("own", "x + y") == "own/x"


@pytest.mark.longer
def test_sets_are_made_once_and_say_what_is_true(houses: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_pairs, "extract", lambda *_, **__: pytest.fail("extracted again"))
    sets = build_own_sets(houses, cache)
    loaded = {part: load_set(sets.manifests[part]) for part in PARTS}
    assert [sum(pair.about["kind"] == "overlap" for pair in loaded[part]) for part in PARTS] == [1, 1, 1]
    for pair in (pair for pairs in loaded.values() for pair in pairs):
        a, b = pair.load_maps()
        assert len(a.rooms) == len(pair.true[0]) and len(b.rooms) == len(pair.true[1])
        if pair.about["kind"] != "overlap":
            assert pair.transform is None and not len(pair.matches) and " + " in pair.about["building"]
            continue
        seed = pair.about["building"][1:]
        truth = json.loads((houses / f"h{seed}" / "truth.json").read_text())
        assert pair.transform is not None and np.allclose(pair.transform.matrix, truth["T_ab"], atol=1e-6)
        assert len(pair.matches) >= 2 and pair.about["common"] > 20
        assert all(pair.true[0][i] == pair.true[1][j] >= 0 for i, j in pair.matches)
        unmatched = np.setdiff1d(np.arange(len(pair.true[0])), pair.matches[:, 0])
        assert (pair.true[0][unmatched] == -1).all()
        assert len(np.unique(pair.true[0][pair.one[0]])) == pair.one[0].sum() == pair.one[1].sum()
    (trained,) = load_pairs(sets.manifests["train"], ["sheet"])
    assert "sheet" in trained.a and len(trained.matches) == len(loaded["train"][0].matches)


def rooms_of(entry: Mapping[str, Any]) -> tuple[TrueRoom, ...]:
    """The true rooms of a map of `truth.json`."""
    outlines = [np.array(room["polygon"]) for room in entry["rooms"]]
    rows = zip(entry["rooms"], outlines, strict=True)
    return tuple(TrueRoom(room["name"], outline, room["floor"], room["ceiling"], room["storey"]) for room, outline in rows)


@pytest.mark.longer
def test_rooms_that_match_are_those_of_the_simulator(houses: Path, cache: Path) -> None:
    from topomerge.datasets.pairs.parts import find_true_matches, match_true_rooms

    listing = read_pairs_file(houses)
    items, _ = extract_captures(listing, cache)
    for pair in listing.pairs:
        truth = json.loads((houses / listing.captures[pair.a].building / "truth.json").read_text())
        maps: list[TopometricMap] = []
        rooms = []
        for name, entry in zip((pair.a, pair.b), truth["maps"], strict=True):
            maps.append(topomerge.load_map(cache / "own" / "captures" / f"{items[name].name}.tmap"))
            cloud = topomerge.read_points(listing.captures[name].path)
            rooms.append(match_true_rooms(maps[-1], replace(cloud, rooms=rooms_of(entry), labels=None)))
        ids = [[room["id"] for room in entry["rooms"]] for entry in truth["maps"]]
        shared = [(ids[0].index(k), ids[1].index(k)) for k in set(ids[0]) & set(ids[1])]
        requested = {tuple(row) for row in find_true_matches(rooms[0], rooms[1], shared).tolist()}
        found = {tuple(row) for row in find_overlap(pair, (maps[0], maps[1])).matches.tolist()}
        assert found and len(found & requested) >= 0.5 * len(found), (found, requested)


@pytest.mark.longer
def test_train_and_evaluate(houses: Path, cache: Path, tmp_path: Path) -> None:
    words = ["data=folder", f"path={houses}", f"cache={cache}", f"runs={tmp_path}", "name=own", "logger=none", "epochs=2"]
    best = train(compose_settings([*words, "experiment=gat_scalars", "batch=1"]), quiet)
    assert 0 <= best["val/recall@1"] <= 1 and best["val/rooms"] > 0
    told = json.loads((tmp_path / "own" / "config.json").read_text())
    assert told["data"].endswith("-train.jsonl") and told["validation"].endswith("-val.jsonl")
    settings = Evaluation(
        descriptors={"engineered": {"name": "engineered"}}, only=["engineered"], run=[str(tmp_path / "own")], path=str(houses),
        cache=str(cache / "evaluation"), folder=str(tmp_path / "eval"), methods=["assignment"], merge=False, tables=["ranking"],
    )  # fmt: skip
    settings.data.name, settings.data.split = "folder", "test"
    scores = evaluate(settings)
    assert "| own |" in scores.summary and "| engineered |" in scores.summary
    assert {row["source"] for row in scores.ranks} == {"own"} and {row["seen"] for row in scores.ranks} == {"unseen"}
    assert all(row["building"].startswith("own/h") for row in scores.ranks)
    assert {row["title"] for row in scores.ranks if row["kind"] == "overlap"} <= {f"h{k}a-h{k}b" for k in HOUSES}
    assert not (cache / "evaluation").exists() or not list((cache / "evaluation").rglob("*.tmap"))  # extracted once


@pytest.mark.longer
def test_retrieval_takes_them(houses: Path, cache: Path) -> None:
    settings = RetrievalSettings(data=Data("folder"), path=str(houses), cache=str(cache), descriptor="engineered")
    assert "Queries: 1 maps of 1 physical buildings" in measure_retrieval(settings, quiet)[0]["text"]
    with pytest.raises(InputError, match="data=folder needs path="):
        measure_retrieval(replace(settings, path=""), quiet)


@pytest.mark.longer
def test_merges_of_them_are_counted(maps_folder: Path, tmp_path: Path) -> None:
    _, pose = turned(uneven(), SHIFT)
    pair = {"a": "one", "b": "two", "transform": pose.matrix.tolist()}
    captures = [*captures_of("one", "two", building="home"), *captures_of("other", building="office")]
    write_yaml(maps_folder, captures=captures, pairs=[pair])
    words = ["data=folder", f"path={maps_folder}", f"cache={tmp_path / 'cache'}", f"folder={tmp_path / 'eval'}"]
    outcome = run_task("merges", words, quiet)
    same, apart = sorted(outcome.rows, key=lambda row: row["kind"] != "overlap")
    assert same["pair"] == "one two" and same["right"] and same["err"][0] < 0.2 and same["common"] > 50
    assert apart["kind"] == "other-building" and apart["err"] is None and not apart["right"]
    believed, wrong = int(same["believed"]), int(apart["believed"])
    head = f"1 pairs of one place: 1 placed right, {believed} of these believed, 0 merged wrongly. "
    assert outcome.summary.startswith(f"{head}1 pairs of two places: {wrong} merged wrongly.")
    assert "| one two |" in outcome.summary
    far = Sim3(0.0, (500.0, 0.0, 0.0)).matrix.tolist()
    for truth, said in (({"transform": far}, "share no floor"), ({"rooms": [[0, 99]]}, "two has no room 99")):
        write_yaml(maps_folder, captures=captures, pairs=[{"a": "one", "b": "two", **truth}])
        with pytest.raises(InputError, match=said):
            run_task("merges", words, quiet)
    with pytest.raises(InputError, match="data=folder needs path="):
        run_task("merges", ["data=folder"], quiet)
    with pytest.raises(InputError, match="is of data=folder, not of data=test"):
        run_task("merges", ["data=test", f"path={maps_folder}"], quiet)


@pytest.mark.longer
def test_the_matcher_of_rooms_takes_them(houses: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room_matcher, "run_network", lambda job, *_: {"learned": len(job.learned), "watched": len(job.watched)})
    settings = compose_settings(["task=room_matcher", "data=folder", f"path={houses}", f"cache={cache}", "views=1"])
    assert room_matcher.fit(settings, quiet) == {"learned": 1, "watched": 2}
    scores = room_matcher.judge(settings, find_weights("room_matcher", ""), quiet)
    assert scores["pairs"] == 2 and scores["rooms"] > 0


def test_a_path_needs_its_data_and_data_its_path(tmp_path: Path) -> None:
    for task in ("embedding", "room_matcher"):
        with pytest.raises(InputError, match="data=folder needs path="):
            compose_settings([f"task={task}", "data=folder"])
        with pytest.raises(InputError, match="is of data=folder, not of data=train_small"):
            compose_settings([f"task={task}", "data=train_small", f"path={tmp_path}"])
    with pytest.raises(InputError, match="data=folder: is for tasks that learn from pairs of maps, not for match_odds"):
        compose_settings(["task=match_odds", "data=folder"])
    settings = Evaluation(descriptors={"engineered": {"name": "engineered"}}, only=["engineered"])
    settings.data.name = "folder"
    with pytest.raises(InputError, match="data=folder needs path="):
        evaluate(settings)
