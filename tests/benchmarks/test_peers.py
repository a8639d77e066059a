"""Peers beside ours: their processes and caps, poses and scores, the choice of thresholds, what the tables count."""

from __future__ import annotations

import importlib
import json
import os
from types import SimpleNamespace

import numpy as np
import pytest

from topomerge.errors import InputError
from topomerge.types import Sim3, VoxelGrid


@pytest.fixture
def module():
    return lambda name: importlib.import_module(f"benchmarks.peers.{name}")


def pair_row(name="p", kind="overlap", common=100.0, overlap=0.6, sensors=("tls", "depth"), building="office-1-1", **methods):
    """A line as `peers.py` writes it."""
    about = {"name": name, "kind": kind, "common": common, "overlap": overlap, "sensors": list(sensors), "building": building}
    return {**about, "source": "procedural", "differs": None, "whole": None, "methods": methods}


def peer_outcome(right=True, fine=True, **scores):
    """A peer's outcome: its refined pose is `right` or 9 m off; the solver's own is right, but not fine."""
    refined = [0.01 if fine else 0.3, 0.0, 0.1] if right else [9.0, 0.0, 0.1]
    return {"status": "", "err": [0.3, 0.0, 0.1], "err_icp": refined, "scores": scores, "seconds": 2.0, "refinement_seconds": 1.0}


def our_outcome(right=True, probability=0.9):
    """Ours."""
    error = [0.01, 0.0, 0.1] if right else [9.0, 0.0, 0.1]
    return {"status": "", "err": error, "scores": {"probability": probability}, "believed": probability >= 0.8, "seconds": 1.0}


def answers_slowly(many):
    """The first answer at once, then one that never comes."""
    yield "first", many
    while True:
        pass


def dies(how):
    """Ends its process, raises, or answers."""
    if how == "killed":
        os._exit(3)
    if how == "raises":
        raise RuntimeError("no")
    yield "answer", how


@pytest.mark.longer
def test_an_answer_over_the_cap_is_a_miss_and_those_before_it_count(module) -> None:
    calls = module("methods")
    work = calls.GuardedWork(answers_slowly, seconds=1)
    answers, why, used = work(7)
    assert answers == {"first": 7} and why == calls.TOO_LONG and used >= 1
    work.close()


@pytest.mark.longer
def test_a_peer_that_dies_or_fails_is_a_miss_and_the_next_call_works(module) -> None:
    calls = module("methods")
    work = calls.GuardedWork(dies)
    for how in ("killed", "raises"):
        answers, why, _ = work(how)
        assert answers == {} and why == calls.CALL_FAILED
    assert work("well")[:2] == ({"answer": "well"}, "")
    work.close()


def corner(rng) -> np.ndarray:
    """(n, 3) points of a floor and two walls of different sizes, and of a box and a column that make it one of a kind."""
    flat = [
        rng.random((n, 3)) * size for n, size in ((9000, (9, 7, 0)), (4000, (9, 0, 3)), (3000, (0, 7, 3)), (1500, (1.5, 0.8, 1)))
    ]
    flat[3] += (5, 3, 0)
    turn = rng.random(2000) * 2 * np.pi
    column = np.column_stack([2 + 0.3 * np.cos(turn), 5 + 0.3 * np.sin(turn), 3 * rng.random(2000)])
    return np.concatenate([*flat, column])


@pytest.mark.parametrize("method", ["kiss", "open3d"])
def test_peers_bring_a_cloud_back_to_itself(module, method) -> None:
    for package in ("open3d", "kiss_matcher"):
        pytest.importorskip(package)
    methods = module("methods")
    a = corner(np.random.default_rng(0))
    truth = Sim3(0.7, (3.0, -2.0, 0.4))
    b = truth.inverse().apply(a)
    answers = dict(methods.kiss(b, a, 0.2) if method == "kiss" else methods.open3d(b, a))
    assert set(answers) == ({"kiss02", "kiss02q"} if method == "kiss" else {"fgr", "fpfh"})
    brought = 0
    for answer in answers.values():
        assert answer.seconds > 0 and answer.refinement_seconds > 0
        off = np.abs(b @ answer.refined[:3, :3].T + answer.refined[:3, 3] - a).max()
        brought += off < 0.05
        assert (answer.scores["fitness_icp"] > 0.95) == (off < 0.05)
    assert brought == 2 if method == "kiss" else brought >= 1  # FGR may land elsewhere; its fitness says so


def test_the_threshold_is_the_lowest_at_which_nearly_nothing_is_wrong(module) -> None:
    least = module("thresholds").find_least_score
    assert least(np.array([1.0, 4, 3, 5, 2]), np.array([0, 1, 0, 1, 1]), 4) == (3.5, 1.0, 0.5)
    assert least(np.array([3.0, 2]), np.array([0, 1]), 1)[0] is None  # what is wrong scores best
    assert least(np.array([-np.inf, 2.0]), np.array([1, 1]), 2) == (1.0, 1.0, 0.5)  # no answer is never believed
    hundred = np.arange(200.0, 0, -1)
    wrong = np.isin(np.arange(200), (100, 150))
    assert least(hundred, ~wrong, 198)[1:] == (198 / 200, 1.0)
    wrong[199] = True  # 197 of 200 are too few
    assert least(hundred, ~wrong, 197) == (50.5, 149 / 150, 149 / 197)


def training_rows():
    """Two right answers and a wrong one of each variant; yaw alone has the higher inliers. A twin wing nobody can tell apart."""
    rows = []
    for k, (right, inliers, fitness, residual) in enumerate([(True, 6, 0.5, 0.05), (True, 9, 0.6, 0.06), (False, 8, 0.7, 0.2)]):
        both = (inliers, inliers if right else 2)
        space, yaw = (peer_outcome(right, inliers=n, fitness_icp=0.1, residual_icp=0.1) for n in both)
        flat = peer_outcome(right, fitness=fitness, residual=residual, fitness_icp=0.1, residual_icp=0.1)
        rows.append(pair_row(f"p{k}", kiss02=space, kiss02q=yaw, kiss03=space, kiss03q=space, fpfh=flat, fgr=flat))
    same = peer_outcome(False, inliers=99, fitness=0.99, residual=0.01, fitness_icp=0.99, residual_icp=0.01)
    methods = dict.fromkeys(("kiss02", "kiss02q", "kiss03", "kiss03q", "fpfh", "fgr"), same)
    return [*rows, {**pair_row("twin", kind="twin-wing", common=0.0, overlap=0.0, **methods), "differs": 0.1}]


def test_verdicts_are_chosen_over_variants_scores_and_residuals(module, tmp_path) -> None:
    thresholds = module("thresholds")
    rows = training_rows()
    verdicts = thresholds.choose(rows)
    assert (verdicts["kiss02"].variant, verdicts["kiss02"].score, verdicts["kiss02"].at_least) == ("kiss02q", "inliers", 4.0)
    assert verdicts["kiss02"].recall == 2 / 3 and verdicts["kiss02"].precision == 1
    assert verdicts["kiss03"].variant == "kiss03" and verdicts["kiss03"].at_least == 8.5  # 8 is wrong
    fpfh = verdicts["fpfh"]
    assert fpfh.score == "fitness" and 0.06 <= fpfh.residual_at_most < 0.2 and fpfh.recall == 2 / 3
    assert [fpfh.is_accepted(r["methods"]["fpfh"]) for r in rows[:3]] == [True, True, False]
    path = tmp_path / "thresholds.json"
    path.write_text(json.dumps(thresholds.serialise_verdicts(rows, verdicts)))
    assert thresholds.load_verdicts(path) == verdicts
    assert json.loads(path.read_text())["names"] == ["p0", "p1", "p2"]


def test_what_is_believed_nowhere_stays_so(module) -> None:
    verdict = module("thresholds").PeerVerdict("fgr", "fitness", None, None, 0.0, 0.0, 0)
    assert not verdict.is_accepted(peer_outcome(fitness=1.0, residual=0.0))
    assert not verdict.is_accepted({"scores": {}})


def test_rows_know_the_refined_pose_and_the_time_it_took(module) -> None:
    rows, verdict = module("tables"), module("thresholds").PeerVerdict("kiss02q", "inliers", 4.5, None, 1.0, 1.0, 1)
    line = pair_row(ours=our_outcome(), kiss02=peer_outcome(False, inliers=9), kiss02q=peer_outcome(inliers=5))
    ours, kiss = rows.build_answers([line], {"kiss02": verdict})
    assert (ours["method"], ours["score"], ours["believed"]) == ("ours", 0.9, True)
    assert (kiss["method"], kiss["score"], kiss["believed"], kiss["seconds"]) == ("kiss02", 5, True, 3.0)
    columns = dict(zip(rows.ANSWER_HEADS, rows.format_answer_columns([kiss]), strict=True))
    assert columns["within 0.1 m, 1° %"].startswith("100") and columns["before ICP"] == "0"
    assert (columns["right and believed"], columns["wrong and believed"], columns["over the cap"]) == (1, 0, 0)
    assert rows.format_answer_columns([]) == [0, *["–"] * (len(rows.ANSWER_HEADS) - 1)]


def invented(module):
    """Answers of ours and FGR: two ordinary pairs, of which FGR has one right; a stranger that FGR believes."""
    verdict = module("thresholds").PeerVerdict("fgr", "fitness", 0.5, None, 1.0, 1.0, 1)
    lines = [
        pair_row("one", ours=our_outcome(), fgr=peer_outcome(fitness=0.8)),
        pair_row("two", overlap=0.3, ours=our_outcome(False, 0.1), fgr=peer_outcome(False, fitness=0.6)),
        pair_row("three", "other-building", 0.0, 0.0, ours=our_outcome(False, 0.2), fgr=peer_outcome(False, fitness=0.7)),
    ]
    for r in lines[2:]:
        r["methods"] = {m: {**o, "err": None, "err_icp": None} for m, o in r["methods"].items()}
    return module("tables").build_answers(lines, {"fgr": verdict})


def test_every_cell_of_a_crossed_table_stands_and_empty_ones_are_dashes(module) -> None:
    rows = module("tables")
    lines = rows.tabulate_crossed([r for r in invented(module) if r["kind"] == "overlap"]).splitlines()
    assert len(lines) == 2 + 9 and lines[0].endswith("| topomerge | FGR |")
    cells = {tuple(line.split(" | ")[:2]): line for line in lines[2:]}
    assert cells["| ≥80 m²", "≥0.5"].endswith("| 1 | 1 · 1 · 0 | 1 · 1 · 0 |")
    assert cells["| ≥80 m²", "0.25–0.5"].endswith("| 1 | 0 · 0 · 0 | 0 · 0 · 1 |")
    assert cells["| <40 m²", "<0.25"].endswith("| 0 | – | – |")


def test_pairs_that_must_not_merge_are_counted_by_kind(module) -> None:
    lines = module("tables").tabulate_negatives_by_kind(invented(module)).splitlines()
    assert lines[2:] == ["| stranger | 3D–3D | 1 | 0 | 1 |", "| **all** |  | 1 | 0 | 1 |"]


def test_curves_count_wrong_poses_and_strangers_against_precision(module) -> None:
    rows = module("tables")
    fgr = [r for r in invented(module) if r["method"] == "fgr"]
    precision, recall = rows.compute_curve(fgr)  # by fitness: .8 right, .7 a stranger, .6 wrong
    assert precision.tolist() == [1, 1 / 2, 1 / 3] and recall.tolist() == [0.5, 0.5, 0.5]
    assert rows.interpolate_curve(precision, recall) == [0.5, 0.5, 0.5, 0.5]
    two = rows.interpolate_curve(np.array([1.0, 0.96, 0.9]), np.array([0.2, 0.5, 0.6]))
    assert two[:3] == [0.2, 0.2, 0.5] and two[3] == pytest.approx(0.2 + 0.96 * 0.3 + 0.9 * 0.1)
    silent = [{**r, "score": -np.inf} for r in fgr]
    assert rows.interpolate_curve(*rows.compute_curve(silent)) == [0, 0, 0, 0]


def test_where_another_has_more_right_is_told(module) -> None:
    rows = module("tables")
    mine = [r for r in invented(module) if r["name"] == "one"]
    assert rows.tabulate_behind(mine, [lambda r: "all"]) == "nowhere"
    off = [{**r, "err": [9.0, 0.0, 0.0]} if r["method"] == "ours" else r for r in mine]
    assert rows.tabulate_behind(off, [lambda r: "all"]).startswith("all, within 0.5 m: FGR 1, topomerge 0")


def test_the_figure_is_written(module, tmp_path) -> None:
    module("tables").draw_curves({"3D–3D": invented(module), "all": invented(module)}, tmp_path / "new" / "curves.png")
    assert (tmp_path / "new" / "curves.png").stat().st_size > 5000


def test_cells_come_in_turn_and_some_more_often(module) -> None:
    pairs = module("pairs")
    groups = {("3D–3D", "a"): list("ABCDE"), ("3D–3D", "b"): list("xy"), ("with a slice", "a"): ["s"]}
    assert "".join(pairs.iter_in_turn(groups, lambda key: 2 if key[1] == "a" and key[0] == "3D–3D" else 1)) == "ABxsCDyE"
    assert list(pairs.iter_in_turn({}, lambda key: 1)) == []


def test_pairs_that_must_not_merge_are_cells_of_their_kind(module) -> None:
    cell = module("pairs").find_cell
    assert cell({"kind": "twin-wing", "common": 0.0, "sensors": ["tls", "laser2d"]}) == ("with a slice", "twin-wing")
    assert cell({"kind": "overlap", "common": 0.5, "sensors": ["tls", "drawing"]}) == ("with a floor plan", "nothing in common")
    assert cell({"kind": "overlap", "common": 80.0, "sensors": ["tls", "tls"]}) == ("3D–3D", "≥80 m²")


def test_peers_get_the_second_map_at_the_scale_of_the_first(module) -> None:
    pairs = module("pairs")
    cells = np.array([[0, 0, 0], [3, 1, 2]], np.int32)
    grid = VoxelGrid(cells, np.zeros(3), 0.1, (4, 4, 4))
    a, b = (grid.assign_properties(mean=grid.compute_centroids().astype(np.float32)) for _ in range(2))
    truth = Sim3(0.3, (1.0, 2.0, 0.0), 2.0)
    pair = module("pairs").GridPair("p", a, b, (None, None), truth, 1.0, {"kind": "overlap", "sensors": ["phone", "phone"]})
    given = pairs.thin_pair(pair)
    judged = pairs.scale_pair(pair)
    assert judged.truth.scale == 1 and np.allclose(judged.truth.apply(given.b), truth.apply(grid.compute_centroids()), atol=1e-6)
    assert np.allclose(given.a, grid.compute_centroids(), atol=1e-6)


def about_file(path, **about):
    """A cached pair of which only what stands about it is read."""
    np.savez(path, about=np.frombuffer(json.dumps(about).encode(), np.uint8))
    return path


def test_thirty_ordinary_pairs_come_first_and_unknown_scales_not_at_all(module, monkeypatch, tmp_path) -> None:
    pairs = module("pairs")
    alike = {"kind": "overlap", "common": 90.0}
    grids = [about_file(tmp_path / f"a{k:02d}.npz", sensors=["tls", "tls"], **alike) for k in range(40)]
    grids += [about_file(tmp_path / f"s{k}.npz", sensors=["tls", "laser2d"], **alike) for k in range(2)]
    grids += [about_file(tmp_path / "x.npz", sensors=["tls", "tls"], kind="twin-wing", common=0.0)]
    drawn = [about_file(tmp_path / f"d{k}.npz", sensors=["tls", "drawing"], scaled=k == 1, **alike) for k in range(2)]
    monkeypatch.setattr(pairs, "list_pair_files", lambda split: drawn if split.endswith("_drawings") else grids)
    test, train, raw = ([path.stem for path in pairs.list_cached_order(what)] for what in ("test", "train", "raw"))
    assert test[:30] == [f"a{k:02d}" for k in range(30)] and len(test) == 44 == len(set(test)) and "d1" not in test
    assert sorted(test[30:37]) == ["a30", "a31", "a32", "a33", "d0", "s0", "x"]
    assert sorted(train[:7]) == ["a00", "a01", "a02", "a03", "d0", "s0", "x"]
    assert raw == [f"a{k:02d}" for k in range(30)] == [path.stem for path in pairs.list_cached_order("thinned")]


def test_poses_are_judged_upright_and_misses_are_told(module, monkeypatch) -> None:
    peers, pairs, answer = module("run"), module("pairs"), module("methods").PeerAnswer
    grid = VoxelGrid(np.array([[0, 0, 0], [30, 10, 20]], np.int32), np.zeros(3), 0.1, (40, 40, 40))
    about = {"kind": "overlap", "sensors": ["tls", "tls"], "source": "procedural", "building": "office-1-1"}
    given = pairs.thin_pair(pairs.GridPair("p", grid, grid, (None, None), Sim3(0.0, (1.0, 0.0, 0.0)), 1.0, about))
    off, exact = np.eye(4), np.eye(4)
    off[0, 3], exact[0, 3] = 1.3, 1.0
    over = np.diag([1.0, -1.0, -1.0, 1.0])
    said = {"kiss02": answer(off, exact, {"inliers": 5.0}, 2.0, 1.0), "kiss02q": answer(over, over, {"inliers": 0.0}, 2.0, 1.0)}
    calls = ((lambda b, a: (said, "", 6.0), ("kiss02", "kiss02q")), (lambda b, a: ({}, "over the cap", 60.0), ("fpfh", "fgr")))
    monkeypatch.setattr(peers, "PEER_CALLS", calls)
    monkeypatch.setattr(
        peers, "run_ours", lambda given: {"status": "", "err": None, "scores": {"probability": 0.0}, "seconds": 1.0}
    )
    tried = [set(peers.measured(given, "real", number)[0]["methods"]) for number in (3, 4)]
    assert tried == [{"ours", "kiss02", "kiss02q", "fpfh", "fgr"}, {"ours", "kiss02", "kiss02q"}]  # every third pair, all
    outcomes, used = peers.peers(given, calls)
    assert used == 66.0 and outcomes["kiss02"]["scores"] == {"inliers": 5.0}
    assert outcomes["kiss02"]["err"] == pytest.approx([0.3, 0.0, 0.0]) and outcomes["kiss02"]["err_icp"] == pytest.approx(
        [0, 0, 0]
    )
    assert outcomes["kiss02q"]["err"] is None and outcomes["kiss02q"]["status"] == ""  # it turns the map over
    assert outcomes["fgr"]["status"] == "over the cap" and outcomes["fgr"]["seconds"] == module("methods").CALL_SECONDS


def test_ours_is_measured_anew_and_what_peers_answered_stays(module, monkeypatch, tmp_path) -> None:
    peers = module("run")
    monkeypatch.setattr(peers, "CACHE", tmp_path)
    lines = [{"name": name, "methods": {"ours": {"err": None}, "kiss02": {"err": [9.0, 0.0, 1.0]}}} for name in ("p", "q")]
    target = tmp_path / "peers_test.jsonl"
    target.write_text("".join(json.dumps(line) + "\n" for line in lines))
    given = [SimpleNamespace(pair=SimpleNamespace(name=name)) for name in ("p", "other")]
    monkeypatch.setattr(peers, "iter_peer_pairs", lambda what, done: iter(given))
    monkeypatch.setattr(peers, "run_ours", lambda given: {"err": [0.1, 0.0, 0.0]})
    peers.measure_ours_anew("test")
    after = [json.loads(line) for line in target.read_text().splitlines()]
    assert after[0]["methods"] == {"ours": {"err": [0.1, 0.0, 0.0]}, "kiss02": {"err": [9.0, 0.0, 1.0]}}
    assert after[1] == lines[1] and list(tmp_path.iterdir()) == [target]


def test_without_a_peer_nothing_is_measured(module, monkeypatch) -> None:
    """An answer of a peer that is not there would count as a miss of its."""
    peers = module("run")
    monkeypatch.setitem(peers.PACKAGES, "no_such_module", "no-such-package==1.0")
    with pytest.raises(InputError, match=r"no-such-package==1.0: not installed.*pip install"):
        peers.check_peers()


def test_points_of_pairs_of_another_version_are_not_simulated(module, monkeypatch, tmp_path) -> None:
    pairs = module("pairs")
    monkeypatch.setattr(pairs, "list_cached_order", lambda what: [tmp_path / "old.npz"])
    monkeypatch.setattr(pairs, "load_raw_items", lambda names: {})
    with pytest.raises(InputError, match="old.npz: was made by another version.*task=merges data=test"):
        next(pairs.iter_peer_pairs("raw", set()))


def test_the_figure_of_the_readme_needs_all_three_methods(module) -> None:
    compute_headline = module("tables").compute_headline
    about = {"name": "x", "kind": "overlap", "sensors": ["tls", "depth"], "building": "b", "source": "procedural"}
    rows = [
        {**about, "believed": True, "common": common, "method": method, "err": (0.1 if method == "ours" else 2.0, 0.0, 0.5)}
        for method in ("ours", "kiss02", "kiss03")
        for common in (100.0, 20.0)
    ]
    result, of = compute_headline(rows)["peers-right"]
    assert of == "1 of these pairs" and [part.split()[0] for part in result.split("; ")] == ["100", "0", "0"]
    assert not compute_headline([row for row in rows if row["method"] != "kiss03"])


def test_a_scan_in_whole_maps_is_counted_by_its_pose_and_by_the_map_with_most_inliers(module) -> None:
    scans = module("scans")
    assert scans.choose_maps(24, 10)[0] == 24 and len(set(scans.choose_maps(24, 10))) == 10
    turned = Sim3(0.3, (2.0, 1.0, 0.0))
    error = scans.measure_error(Sim3(0.3, (2.1, 1.0, 5.0)).matrix, turned)
    assert abs(error["away"] - 0.1) < 1e-9 and error["turned"] < 1e-9
    good, far = {"away": 0.1, "turned": 0.0}, {"away": 9.0, "turned": 0.0}
    ours = {"status": "located", "room": True, "seconds": 0.5, "stranger": False}

    def row(own: dict, inliers: float) -> dict:
        kiss = [{"map": 24, "inliers": inliers, "seconds": 1.0, **own}, {"map": 3, "inliers": 9.0, "seconds": 1.0, **far}]
        return {"kind": "sweep", "building": 24, "ours": ours, "kiss": kiss}

    table = scans.tabulate([row(good, 20.0), row(good, 5.0), row(far, 20.0)])
    assert "| sweep | 3 | 2 | 2 | 1 | 1.00 | 50 | 3 | 0 | 0.50 |" in table


@pytest.mark.longer
def test_scans_are_compared_when_the_module_is_the_program(module, tmp_path, monkeypatch, capsys) -> None:
    scans = module("scans")

    def compare(number: int, kind: str, count: int, folder) -> dict:
        found = {"map": number, "inliers": float(count), "seconds": 1.0, "away": 0.1, "turned": 0.0}
        ours = {"status": "located", "room": True, "seconds": 0.5, "stranger": False}
        return {"kind": kind, "building": number, "ours": ours, "kiss": [found]}

    compare.__module__ = "__main__"
    for name, value in (("compare_scan", compare), ("find_spec", lambda name: name)):
        monkeypatch.setattr(scans, name, value)
    monkeypatch.setattr(scans.os, "sched_setaffinity", lambda process, cores: None)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.chdir(tmp_path)
    scans.main("2", "3")
    assert "| all | 2 | 2 | 2 | 2 | 1.00 | 50 | 2 | 0 | 0.50 |" in capsys.readouterr().out


def test_a_peer_that_cannot_be_called_is_an_error_and_not_a_wrong_answer(module, monkeypatch) -> None:
    scans = module("scans")
    cloud = SimpleNamespace(points=np.zeros((3, 3)))
    stored = SimpleNamespace(load=lambda: SimpleNamespace(grid=SimpleNamespace(compute_centroids=lambda: np.zeros((3, 3)))))
    placed = SimpleNamespace(place_scan=lambda scan: (Sim3(0.0), np.zeros(3)))
    monkeypatch.setattr(scans, "load_atlas", lambda *args: (SimpleNamespace(maps=[stored] * 50), [placed] * 50))
    monkeypatch.setattr(scans, "make_located_scan", lambda *args: SimpleNamespace(cloud=cloud))
    monkeypatch.setattr(scans, "measure_scan", lambda *args: {})
    monkeypatch.setattr(scans, "start_peer", lambda: lambda *args: ({}, scans.CALL_FAILED, 0.0))
    with pytest.raises(RuntimeError, match="KISS-Matcher failed on 24 walk"):
        scans.compare_scan(24, "walk", 3, None)
