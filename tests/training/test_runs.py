"""Runs one can trust: what goes on, what is replaced, where it comes from, and what the seeds of a sweep say together."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from topomerge.models.weights import read_embedder

from tests.forked import run_two
from tests.graphs import write_set
from topomerge import code_digest
from topomerge.code_digest import find_other_clone, read_commit
from topomerge.config import name_by_sweep
from topomerge.embedding.learned import load_embedder
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.errors import InputError
from topomerge.statistics import estimate_mean
from topomerge.training.__main__ import main
from topomerge.training.embedding import fit
from topomerge.training.run_folder import compare_settings, describe_provenance, read_run
from topomerge.training.settings import Training, convert_to_dict
from topomerge.training.table import write_table
from topomerge.training.tasks import compose_settings, train

ROOT = Path(__file__).parent.parent.parent
SMALL = Network(Geometry(["scalars"], width=8), Node("none"), size=8)


def quiet(text: str) -> None:
    """Say nothing."""


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    write_set(folder, "some", 8)
    write_set(folder, "other", 2)
    (folder / "some.recipe.json").write_text('{"name": "some", "seed": 3}')
    return folder


@pytest.fixture
def settings(cache, tmp_path) -> Training:
    common = {"runs": str(tmp_path), "cache": str(cache), "data": "some", "validation": "other", "logger": []}
    return Training(**common, epochs=1, batch=4, network=SMALL)


@pytest.mark.usefixtures("unexported")
def test_a_run_with_other_settings_does_not_go_on(settings, tmp_path):
    fit(settings, quiet)
    before = (tmp_path / "run" / "config.json").read_bytes()
    other = replace(settings, rate=0.5, seed=2, resume=True, loss=replace(settings.loss, kind="triplet"))
    with pytest.raises(InputError) as refused:
        fit(other, quiet)
    said = str(refused.value)
    assert "\n" not in said and "loss.kind (was 'infonce', now 'triplet')" in said
    assert "rate (was 0.002, now 0.5)" in said and "seed (was 0, now 2)" in said and "epochs" not in said
    assert (tmp_path / "run" / "config.json").read_bytes() == before
    fit(replace(settings, epochs=2, threads=2, resume=True), quiet)
    starts = read_run(tmp_path / "run")["starts"]
    assert [start["resumed"] for start in starts] == [False, True]
    assert starts[1]["changed"] == {"epochs": [1, 2], "threads": [1, 2]} and not starts[0]["changed"]
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["epochs"] == 2 and not config["resume"]  # another run may begin with it
    assert len(read_embedder(tmp_path / "run" / "last")[1]["provenance"]["starts"]) == 2


def test_keys_that_one_version_lacks_count_for_nothing():
    assert compare_settings({"a": {"b": 1, "old": 2}, "c": [1, 2]}, {"a": {"b": 3}, "c": (1, 2), "new": 1}) == {"a.b": [1, 3]}


@pytest.mark.usefixtures("unexported")
def test_other_pairs_under_the_name_of_the_set_do_not_go_on(settings, tmp_path):
    for count in (6, 7):
        write_set(tmp_path / "cache", "some", count)
        write_set(tmp_path / "cache", "other", 2)
        here = replace(settings, cache=str(tmp_path / "cache"), resume=count == 7, epochs=2)
        if count == 6:
            fit(here, quiet)
            continue
        with pytest.raises(InputError, match="data=some holds other pairs than when the run began"):
            fit(here, quiet)


@pytest.mark.usefixtures("unexported")
def test_a_run_is_replaced_only_where_that_is_asked_for(settings, tmp_path):
    fit(replace(settings, epochs=2), quiet)
    kept = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    with pytest.raises(InputError, match="holds a run; resume=true goes on with it, overwrite=true replaces it"):
        fit(settings, quiet)
    assert {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()} == kept
    (tmp_path / "run" / "best" / "old.txt").write_text("of the run before")
    fit(replace(settings, overwrite=True), quiet)
    assert not (tmp_path / "run" / "best" / "old.txt").exists() and len(read_run(tmp_path / "run")["starts"]) == 1
    assert len((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()) == 1


@pytest.mark.longer
def test_tasks_keep_their_runs_too(tmp_path, monkeypatch):
    from tests.training import tiny
    from topomerge.training import match_odds

    monkeypatch.setattr(match_odds, "build_pair_evidence", tiny.evidence)
    words = ["task=match_odds", f"runs={tmp_path}", "logger=none"]
    train(compose_settings(words), quiet)
    monkeypatch.setattr(match_odds, "build_pair_evidence", lambda *_: pytest.fail("data was made"))
    with pytest.raises(InputError, match="holds a run"):
        train(compose_settings(words), quiet)
    with pytest.raises(InputError, match=r"l2 \(was 0.05, now 0.1\)"):
        train(compose_settings([*words, "resume=true", "l2=0.1"]), quiet)


@pytest.mark.longer
def test_a_run_and_what_it_exports_say_where_they_come_from(settings, tmp_path, cache, monkeypatch):
    monkeypatch.setattr(sys, "orig_argv", ["python", "train.py", "name=a b"])
    fit(replace(settings, export=str(tmp_path / "exported")), quiet)
    run = read_run(tmp_path / "run")
    (start,) = run["starts"]
    plain = torch.__version__.partition("+")[0]  # the index of wheels names the build of CUDA, the package's own metadata may not
    assert start["versions"]["torch"].partition("+")[0] == plain and start["versions"]["numpy"] == np.__version__
    assert set(start["versions"]) == {"python", "torch", "torch-geometric", "numpy", "topomerge"} and all(
        start["versions"].values()
    )
    assert (start["seed"], start["threads"], start["device"]) == (0, torch.get_num_threads(), "1 x cpu, 32-true")
    assert start["command"] == "python train.py 'name=a b'" and start["began"].endswith("Z")
    assert (start["commit"], start["changed_sources"]) == read_commit()
    assert run["data"]["data"]["recipe"] == {"name": "some", "seed": 3} and run["data"]["validation"]["recipe"] is None
    assert run["data"]["data"]["sha256"] != run["data"]["validation"]["sha256"]
    told = load_embedder(tmp_path / "exported").about["provenance"]
    assert load_embedder(tmp_path / "exported").about["settings"]["rate"] == 0.002
    assert told == describe_provenance(tmp_path / "run") and "began" not in told["starts"][0]
    (tmp_path / "run" / "run.json").write_text("{")
    with pytest.raises(InputError, match=r"run\.json: damaged"):
        read_run(tmp_path / "run")


def test_the_commit_and_whether_sources_differ_from_it(tmp_path):
    package = tmp_path / "topomerge"
    package.mkdir()
    (package / "a.py").write_text("")
    assert read_commit(package) == ("", False)
    for words in (["init", "-q"], ["add", "-A"], ["-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "first"]):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True)
    commit, changed = read_commit(package)
    assert len(commit) == 40 and not changed
    (package / "a.py").write_text("1")
    assert read_commit(package) == (commit, True)


def test_a_second_clone_is_told_that_it_runs_the_code_of_another(tmp_path):
    assert find_other_clone(ROOT / "train.py") == ""
    (tmp_path / "train.py").write_text((ROOT / "train.py").read_text())
    said = find_other_clone(tmp_path / "train.py")
    assert str(tmp_path) in said and str(Path(code_digest.__file__).parent) in said and "\n" not in said


@pytest.mark.longer
@pytest.mark.parametrize("script", ["train.py", pytest.param("evaluate.py", marks=pytest.mark.slow)])
def test_the_scripts_of_a_second_clone_say_so(tmp_path, script):
    """The clone has its own `topomerge`, which Python finds first, but the environment's models and datasets."""
    from tests.package_copy import copied

    copied(tmp_path, compiled=True)
    (tmp_path / script).write_text((ROOT / script).read_text())
    done = subprocess.run(
        [sys.executable, str(tmp_path / script), "task=nothing"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    told = [line for line in done.stderr.splitlines() if "would run the code of another clone" in line]
    assert done.returncode == 1 and len(told) == 1 and str(tmp_path) in told[0] and str(ROOT) in told[0], done.stderr


def test_names_of_the_runs_of_a_sweep_hold_what_differs():
    words = ["-m", "data=some", "node=none,gat", "loss.easy=0.5", "seed=0,1", "hydra/launcher=joblib", "resume=true"]
    assert name_by_sweep(words) == [*words, "hydra.job.config.override_dirname.exclude_keys=[data,loss.easy,resume]"]
    assert name_by_sweep([words[1], "--multirun", *words[2:]]) == name_by_sweep(words)  # Hydra takes no words on both sides of it
    assert name_by_sweep(["data=some", "node=gat"]) == ["data=some", "node=gat"]
    with pytest.raises(InputError):
        name_by_sweep(["-m", "node=[none"])


def test_seeds_are_gathered_with_mean_and_interval(settings, tmp_path):
    scores = {"a": (0.5, 0.6, 0.7), "b": (0.4,)}
    for kind, values in scores.items():
        for seed, value in enumerate(values):
            config = asdict(replace(settings, seed=seed, name=f"kind={kind},seed={seed}", rate=0.1 if kind == "a" else 0.2))
            folder = tmp_path / "sweep" / config["name"]
            folder.mkdir(parents=True)
            (folder / "config.json").write_text(json.dumps({**config, "threads": 1 + seed}))
            row = {"epoch": 0, "seconds": 2.0, "val/recall@1": value}
            (folder / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    text = write_table(tmp_path / "sweep").read_text()
    first, second = text.split("Mean over seeds")
    assert first.count("\n| kind=") == 4 and second.count("\n| kind=") == 1
    half = 4.303 * 0.1 / np.sqrt(3)  # Student's t with two degrees of freedom
    assert f"| kind=a | scalars | none | – | infonce | 3 | 0.600 [{0.6 - half:.3f}, {0.6 + half:.3f}] |" in second
    mean, low, high = estimate_mean(np.array([1.0]))
    assert mean == 1 and np.isnan(low) and np.isnan(high)


@pytest.mark.usefixtures("unexported")
def test_two_processes_take_the_step_of_one_with_all_pairs(settings, tmp_path):
    """As by torchrun: rooms of the other process are negatives, with gradients; weights end as those of one process."""
    same = replace(settings, epochs=2, batch=2, augment=replace(settings.augment, rooms=0.0, edges=0.0, jitter=0.0))
    same = replace(same, network=replace(SMALL, dropout=0.0))
    (tmp_path / "run.json").write_text(json.dumps(convert_to_dict(same)))
    for done in run_two(["-m", "topomerge.training", tmp_path / "run.json", "name=two"], ROOT):
        assert done.returncode == 0 and "another training" not in done.stderr, done.stderr
    fit(replace(same, name="one", batch=4), quiet)
    two, one = (load_weights(tmp_path / name) for name in ("two", "one"))
    for name, value in one.items():
        assert torch.allclose(value, two[name], atol=2e-5), name
    assert read_run(tmp_path / "two")["starts"][0]["device"] == "2 x cpu, 32-true"
    assert main([str(tmp_path / "run.json"), "name=two"]) == 1


def load_weights(run: Path) -> dict[str, torch.Tensor]:
    """The weights of the last epoch."""
    from safetensors.torch import load_file

    return load_file(run / "last" / "embedder.safetensors")
