"""The build of a set: the same bytes however it was interrupted and shared out, refusals counted, mistakes named."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.core import builder as module
from topomerge.datasets.core.builder import BuildRow
from topomerge.datasets.core.building import Opening, Plan
from topomerge.datasets.pairs import example, items
from topomerge.datasets.pairs.build import Build, build, main
from topomerge.datasets.pairs.example import PairSet, describe_item, load_example, make_arrays
from topomerge.datasets.pairs.items import Item, Recipe, check, draw_items, select_plans

from tests.datasets.boxes import room
from tests.package_copy import copied, edited_kernel
from tests.recipes import SMALL_HOUSES
from topomerge.code_digest import compute_code_digest, compute_data_digest
from topomerge.config import compose
from topomerge.errors import InputError

SMALL = Recipe(name="small", pairs=3, **SMALL_HOUSES)
WORDS = [
    "data=procedural", "data.name=small", "data.seed=4", "data.overlaps=[0.5]", "data.rooms=[3,4]", "data.points_per_room=16",
    "data.voxel_size=0.15", "data.two_storeys=0", *(f"data.hard.{h}=0" for h in ("other-building", "other-storey", "twin-wing")),
    *(f"data.kinds.{k}=0" for k in ("office", "openplan", "apartment", "hotel", "hospital", "school", "lab")),
    *(f"data.sensors.{s}=0" for s in ("tls", "lidar", "tablet", "laser2d", "mono")), "data.stacks=0", "data.over_stairs=0",
]  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache that was built without interruption."""
    cache = tmp_path_factory.mktemp("whole")
    report = build(Build(SMALL, str(cache)))
    assert report.made == report.items == 3 and not report.refused
    return cache


def contents(cache: Path) -> dict[str, bytes]:
    return {p.relative_to(cache).as_posix(): p.read_bytes() for p in sorted(cache.rglob("*")) if p.is_file() and p.name[0] != "."}


@pytest.mark.longer
def test_what_is_there_is_not_made_again(whole: Path) -> None:
    before = contents(whole)
    report = build(Build(SMALL, str(whole)))
    assert report.made == 0 and report.items == 3
    assert contents(whole) == before and set(before) == {
        "small.jsonl",
        "small.recipe.json",
        *(f"pairs/{i.name}.npz" for i in draw_items(SMALL, {})),
    }


@pytest.mark.longer
@pytest.mark.parametrize(("addition", "maps", "same"), [
    ("ANOTHER = 1", True, False), ("# another word", True, True), ("ANOTHER = 1", False, True),
])  # fmt: skip
def test_another_kernel_refuses_cached_maps(monkeypatch, tmp_path, addition: str, maps: bool, same: bool) -> None:
    item = replace(draw_items(SMALL, {})[0], maps=maps)
    before = item.name
    monkeypatch.setattr(items, "compute_code_digest", partial(compute_code_digest, package=edited_kernel(tmp_path, addition)))
    assert (item.name == before) is same


@pytest.mark.parametrize("maps", [False, True])
def test_other_weights_of_the_extraction_refuse_cached_pairs(monkeypatch, tmp_path, maps: bool) -> None:
    item = replace(draw_items(SMALL, {})[0], maps=maps)
    before, package = item.name, copied(tmp_path)
    with (package / "networks" / "plan_network.onnx").open("r+b") as file:
        file.write(b" ")
    for digest in (compute_code_digest, compute_data_digest):
        monkeypatch.setattr(items, digest.__name__, partial(digest, package=package))
    assert item.name != before


@pytest.mark.longer
def test_what_is_missing_or_damaged_is_made_again(whole: Path, tmp_path: Path) -> None:
    for name, data in contents(whole).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    first, second, _ = sorted((tmp_path / "pairs").iterdir())
    first.unlink()
    second.write_bytes(second.read_bytes()[:-100])
    (tmp_path / "pairs" / ".half.npz").write_bytes(b"half")
    os.utime(tmp_path / "pairs" / ".half.npz", (0, 0))
    assert build(Build(SMALL, str(tmp_path))).made == 2
    assert contents(tmp_path) == contents(whole) and not (tmp_path / "pairs" / ".half.npz").exists()


def test_examples(whole: Path) -> None:
    pytest.importorskip("torch_geometric")
    pairs = PairSet(whole / "small.jsonl")
    assert len(pairs) == 3
    for pair, row in zip(pairs, pairs.rows, strict=True):
        assert pair.about == row and pair.a.validate() and pair.b.validate()
        assert pair.a.num_nodes == row["extracted"][0] and pair.a.room_points.shape[1:] == (16, 3)
        assert len(pair.a.true_room) == pair.a.num_nodes and pair.transform.shape == (4, 4)
        for i, j in pair.matches.tolist():
            assert pair.a.true_room[i] == pair.b.true_room[j] >= 0
    with pytest.raises(InputError, match="no such manifest"):
        PairSet(whole / "other.jsonl")
    with pytest.raises(InputError, match="no such file"):
        load_example(whole / "nothing.npz")


def test_the_manifest_is_sorted_and_tells_all(whole: Path) -> None:
    rows = [json.loads(line) for line in (whole / "small.jsonl").read_text().splitlines()]
    assert [r["file"] for r in rows] == sorted(r["file"] for r in rows)
    assert all(r["sensors"] == ["depth", "depth"] and len(r["partners"]) == 2 for r in rows)
    assert all(int(r["buildings"][0]) < 800_000 for r in rows)


def test_one_bad_item_ends_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    bad = draw_items(SMALL, {})[1].name

    def make(item: Item, plans: list[Plan]) -> dict[str, np.ndarray]:
        if item.name == bad:
            raise InputError("office-12-1: has no such rooms")
        raise KeyError("x")

    monkeypatch.setattr(example, "make_arrays", make)
    report = build(Build(SMALL, str(tmp_path)))
    assert report.items == report.made == 0 and report.refused == {"KeyError: 'x'": 2, "# has no such rooms": 1}
    assert (tmp_path / "small.jsonl").read_text() == ""
    assert [p.name for p in (tmp_path / "pairs").iterdir()] == [f"{bad}.refused"], "a KeyError is no reason for good"
    asked: list[str] = []
    monkeypatch.setattr(example, "make_arrays", lambda item, plans: asked.append(item.name))
    with pytest.raises(InputError, match=r"small.jsonl: none of 2 pairs could be made: \w+Error: "):  # not one bad item, but all
        build(Build(SMALL, str(tmp_path)))
    assert bad not in asked and len(asked) == 2, "what was refused for its inputs is not asked again"


def test_parts_make_the_whole(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made: list[list[str]] = []

    def make(item: Item, plans: list[Plan]) -> dict[str, np.ndarray]:
        made[-1].append(item.name)
        return {"about": np.frombuffer(b"{}", np.uint8)}

    monkeypatch.setattr(example, "make_arrays", make)
    for k in (1, 2):
        made.append([])
        build(Build(SMALL, str(tmp_path / str(k)), part=[k, 2]))
    names = [i.name for i in draw_items(SMALL, {})]
    assert set(made[0]) == set(names[::2]) and made[1] == names[1::2]
    with pytest.raises(InputError, match=r"part must be \[k, n\]"):
        build(Build(SMALL, str(tmp_path), part=[3, 2]))


def test_real_storeys_are_stacked_where_the_recipe_says_so() -> None:
    wall = Opening("door", (4.1, 2.0), (4.1, 2.9), 0.2)
    one = Plan((room("a", 0, 0, 4, 5), room("b", 4.2, 0, 8, 5)), openings=(wall,))
    plans = {"campus": {"x": (one,), "y": (one,), "x + y": (one, one)}}
    recipe = replace(SMALL, pairs=200, sources={"campus": 1.0}, stacks=0.4, over_stairs=0.5)
    items = draw_items(recipe, plans)
    stacked = [i for i in items if i.storeys == 2]
    assert 0.3 < len(stacked) / 200 < 0.5 and all(set(i.buildings) == {"x + y"} for i in stacked)
    assert all(set(i.buildings) <= {"x", "y"} for i in items if i.storeys == 1)
    assert 0.3 < np.mean([i.over_stairs for i in stacked]) < 0.7 and not any(i.over_stairs for i in items if i.storeys == 1)
    assert not any(i.storeys == 2 for i in draw_items(replace(recipe, stacks=0.0), plans))
    assert select_plans(stacked[0], plans)[0] == (one, one)


def test_what_takes_too_long_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def spin(item: Item, plans: object) -> None:
        end = time.process_time() + 20
        while time.process_time() < end:
            pass

    monkeypatch.setattr(example, "make_arrays", spin)
    monkeypatch.setattr(example, "LONGEST_PAIR", 0.1)
    begin = time.process_time()
    row = example.make_file(draw_items(SMALL, {})[0], [], str(tmp_path))
    assert row.reason == "takes more than 0.1 s of a processor" and not list(tmp_path.iterdir())
    assert time.process_time() - begin < 10


def test_waiting_for_a_busy_machine_counts_for_nothing() -> None:
    with module.limit_time(0.05):
        time.sleep(0.2)


def test_items() -> None:
    items = draw_items(SMALL, {})
    assert draw_items(replace(SMALL, pairs=2), {}) == items[:2]
    names = {i.name for i in items}
    for change in ({"seed": 5}, {"voxel_size": 0.1}, {"points_per_room": 8}, {"sensors": {"tls": 1.0}}, {"spread": 0.4}):
        assert not names & {i.name for i in draw_items(replace(SMALL, **change), {})}, change
    many = draw_items(replace(SMALL, pairs=400, hard={"twin-wing": 0.5}, split="test", scale=0.3), {})
    assert 0.4 < np.mean([i.hard == "twin-wing" for i in many]) < 0.6 and 0.2 < np.mean([i.scale for i in many]) < 0.4
    assert all(900_000 <= int(b) <= 999_999 for i in many for b in (*i.buildings, i.other[0]))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"split": "holdout"}, "split 'holdout'"),
        ({"sources": {"mars": 1.0}}, "sources: unknown 'mars'"),
        ({"sources": {}}, "sources: no weight"),
        ({"kinds": {"castle": 1.0}}, "kinds: unknown 'castle'"),
        ({"sensors": {"sonar": 1.0}}, "sensor 'sonar'"),
        ({"sensors": {"tls": -1.0}}, "sensors.tls must be"),
        ({"hard": {"twin-wing": 0.7, "other-storey": 0.7}}, "hard, in all, must be"),
        ({"overlaps": [0.5, 1.5]}, r"overlaps\[1\] must be"),
        ({"rooms": [2, 5]}, "3 or more"),
        ({"voxel_size": 0.0}, "voxel_size"),
    ],
)
def test_recipes_that_nothing_can_be_made_of(change: dict[str, object], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        check(replace(SMALL, **change))


def test_real_plans_need_their_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="set folder or TOPOMERGE_DATA"):
        build(Build(replace(SMALL, sources={"r2v": 1.0}), str(tmp_path)))
    with pytest.raises(InputError, match="no such file or folder"):
        build(Build(replace(SMALL, sources={"r2v": 1.0}, folder=str(tmp_path)), str(tmp_path)))


@pytest.mark.parametrize(
    ("word", "key"),
    [
        ("jbos=2", "jbos"),
        ("+jbos=2", "jbos"),
        ("data.pirs=2", "pirs"),
        ("+data.pirs=2", "pirs"),
        ("data=train_smal", "train_smal"),
        ("data.pairs=many", "data.pairs"),
        ("jobs=[1]", "jobs"),
        ("jobs 2", "jobs 2"),
    ],
)
def test_mistakes_are_named(word: str, key: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("hydra")
    assert main([word]) == 1
    err = capsys.readouterr().err
    assert key in err and err.count("\n") == 1


def test_settings_reach_the_build(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("hydra")
    settings = compose("build", Build, [*WORDS, "jobs=2", "cluster=tcp://host:8786", "data.pairs=3"])
    assert settings.jobs == 2 and settings.cluster == "tcp://host:8786"
    drawn = {k: v for k, v in settings.data.kinds.items() if v > 0}
    assert drawn == {"house": 1}
    assert [i.name for i in draw_items(settings.data, {})] == [i.name for i in draw_items(SMALL, {})]
    assert main(["--help"]) == 0 and "data=train_small" in capsys.readouterr().out


@pytest.mark.longer
def test_no_scheduler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(module, "PATIENCE", 1.0)
    with pytest.raises(InputError, match="no scheduler answers at tcp://127.0.0.1:9"):
        build(Build(SMALL, str(tmp_path), cluster="tcp://127.0.0.1:9"))


def crash(item: Item, plans: list[Plan], folder: str) -> BuildRow:
    """Stands in for `make_file`: the second item kills its worker."""
    if item.name == draw_items(SMALL, {})[1].name:
        os.kill(os.getpid(), signal.SIGKILL)
    return BuildRow(item.name, "", 0.0)


def misnamed(item: Item, plans: list[Plan], folder: str) -> BuildRow:
    """Stands in for `make_file`: a file that no task asked for."""
    return BuildRow(f"{item.name}.3", "", 0.0)


def test_a_file_of_another_name_ends_the_building() -> None:
    tasks = [(item, [], "") for item in draw_items(SMALL, {})]
    with pytest.raises(ValueError, match="no task has this name"):
        module.run_tasks(tasks, Build(SMALL), lambda row: None, misnamed)


@pytest.mark.slow
def test_an_item_that_kills_its_worker_is_refused() -> None:
    items = draw_items(SMALL, {})
    rows = module.run_tasks([(i, [], "") for i in items], Build(SMALL, jobs=2), lambda row: None, crash)
    assert {r.name: r.reason[:6] for r in rows} == {i.name: "killed" if i == items[1] else "" for i in items}


def wait_for(check, seconds: float = 120.0) -> None:  # type: ignore[no-untyped-def]
    end = time.monotonic() + seconds
    while not check():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.05)


@pytest.mark.slow
def test_killed_and_started_again_gives_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "topomerge.datasets.pairs.build", *WORDS, "data.pairs=3", f"cache={tmp_path}", "jobs=2"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)
    wait_for(lambda: list(tmp_path.glob("pairs/[0-9a-f]*.npz")))
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert not (tmp_path / "small.jsonl").exists()
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert contents(tmp_path) == contents(whole)


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker(whole: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    started = [subprocess.Popen([*dask, "scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)], **quiet)]
    try:
        wait_for(file.exists)
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--scheduler-file", str(file)]
        started += [subprocess.Popen([*dask, "worker", *options], **quiet) for _ in range(2)]
        address = json.loads(file.read_text())["address"]
        killed = []

        def kill_one(text: str) -> None:
            if not killed and text.startswith("1 of"):
                killed.append(os.kill(started[1].pid, signal.SIGKILL))

        settings = Build(SMALL, str(tmp_path / "cache"), cluster=address)
        report = build(settings, kill_one, every=0.0)
        assert killed and report.made == 3 and not report.refused
        assert started[1].wait(10) == -signal.SIGKILL and started[2].poll() is None
        assert contents(tmp_path / "cache") == contents(whole)
    finally:
        for process in started:
            process.kill()
            process.wait()


def test_signs_change_nothing_else_of_a_recipe() -> None:
    """Items without signs keep their names, by which cached pairs are found; those with signs differ in nothing but them."""
    signed = replace(SMALL, pairs=40, signs=0.5)
    before, after = (draw_items(recipe, {}) for recipe in (replace(SMALL, pairs=40), signed))
    assert [replace(item, signs="") for item in after] == before
    assert {item.signs for item in after} == {"", "good", "poor"} and 10 < sum(bool(item.signs) for item in after) < 30
    assert all((one.name == other.name) == (not one.signs) for one, other in zip(after, before, strict=True))
    assert "signs" not in describe_item(before[0])
    with pytest.raises(InputError, match="signs are of pairs of two walks"):
        check(replace(signed, walks=3))


@pytest.mark.longer
def test_maps_of_a_pair_with_signs_hold_landmarks() -> None:
    """Rooms that are one bear the same number where both were read; the pair is the same but for these."""
    item = replace(draw_items(SMALL, {})[0], signs="good")
    signed, plain = make_arrays(item, [()] * 5), make_arrays(replace(item, signs=""), [()] * 5)
    assert {*signed} - {*plain} == {"a.landmarks", "b.landmarks"}
    for name in plain.keys() - {"about"}:
        np.testing.assert_array_equal(signed[name], plain[name])  # nan is nan
    read = [signed[f"{side}.landmarks"] for side in "ab"]
    both = [(i, j) for i, j in plain["matches"].tolist() if read[0][i, 0] and read[1][j, 0]]
    # A sign beside a door may be given to the room on its other side.
    assert len(both) > 2 and np.median([read[0][i, 2:] @ read[1][j, 2:] for i, j in both]) > 0.7
