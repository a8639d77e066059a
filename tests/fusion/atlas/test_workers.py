"""Pairs registered elsewhere: the same atlas as by one process; who dies is replaced, who is killed goes on."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

import topomerge as tm
from tests.fusion.atlas.atlas_scenes import NAMES, office_map
from topomerge.errors import InputError
from topomerge.fusion.atlas import maps as memory
from topomerge.fusion.atlas import partners as workers
from topomerge.fusion.atlas.partners import CoarseTask, register_pair, score_coarsely
from topomerge.fusion.atlas.solve import JOURNAL_FILE, Journal
from topomerge.fusion.atlas.store import add
from topomerge.io.maps import load_map
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import TopometricMap


def parts() -> list[tuple[str, TopometricMap]]:
    return [(NAMES[k], office_map(k)) for k in range(3)]


def listing_of(folder: Path) -> dict:
    listing = json.loads((folder / "atlas.json").read_text(encoding="utf-8"))
    return {key: value for key, value in listing.items() if key != "seconds"}


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    """The atlas as one process makes it."""
    folder = tmp_path_factory.mktemp("alone") / "house"
    add(folder, parts(), tm.render_atlas_html)
    return folder


def same_atlas(one: Path, other: Path) -> bool:
    assert listing_of(one) == listing_of(other)
    return all((one / name).read_bytes() == (other / name).read_bytes() for name in ("pairs.json", "merged_0.ply"))


def backwards(work: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
    """A worker of this process that ends with the first task."""
    for k in reversed(range(len(tasks))):
        yield k, work(tasks[k])


@pytest.mark.longer
def test_who_is_killed_goes_on_and_the_order_in_which_pairs_end_changes_nothing(alone, tmp_path):
    asked: dict[str, list[int]] = {"score_coarsely": [], "register_pair": []}

    def failing(work: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        asked[work.__name__].append(len(tasks))
        yield 0, work(tasks[0])
        if work is register_pair:
            raise KeyboardInterrupt
        yield from ((k, work(tasks[k])) for k in range(1, len(tasks)))

    def going_on(work: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        asked[work.__name__].append(len(tasks))
        return backwards(work, tasks)

    folder = tmp_path / "house"
    with pytest.raises(KeyboardInterrupt):
        add(folder, parts(), tm.render_atlas_html, failing)
    journal = folder / JOURNAL_FILE
    assert journal.read_text().count("hypotheses") == 1 and not (folder / "atlas.json").exists()
    journal.write_text(journal.read_text() + '{"stamp": "cut sh')  # as of a process that was killed while it wrote
    add(folder, parts(), tm.render_atlas_html, going_on)
    first, second = asked["register_pair"][:2]
    assert second == first - 1 and same_atlas(alone, folder)
    assert asked["score_coarsely"] == [2]  # the first map on two, the second on one; then it is written down
    assert not journal.exists()


def test_a_journal_is_heard_with_its_settings_only(tmp_path):
    settings = {"scale": "fixed", "embedder": None, "same": "nothing"}
    ranked = (PoseHypothesis(tm.Sim3(0.3, (1.0, 2.0, 0.0)), probability=0.7, features={"walls": 3.0}),)
    Journal(tmp_path, settings)["a", "b"] = ranked
    (again,) = Journal(tmp_path, settings)["a", "b"]
    assert (again.transform, again.probability, again.features) == (ranked[0].transform, 0.7, {"walls": 3.0})
    Journal(tmp_path, settings).coarse["a", "c"] = -2.5
    assert dict(Journal(tmp_path, settings).coarse) == {("a", "c"): -2.5} and len(Journal(tmp_path, settings)) == 1
    other = Journal(tmp_path, settings | {"same": "storey"})
    assert other == {} and not other.coarse
    (tmp_path / JOURNAL_FILE).write_text("no line of it\n[]\n{}\n")
    assert Journal(tmp_path, settings) == {}


@pytest.mark.longer
def test_a_worker_loads_a_map_of_many_pairs_once_and_forgets_what_was_laid_at_another_scale(alone, monkeypatch):
    loaded: list[Path] = []
    monkeypatch.setattr(memory, "load_corrected_map", lambda path: loaded.append(path) or load_map(path))
    workers._get_memory.cache_clear()
    listing = listing_of(alone)
    maps = [(alone / m["file"], m["key"]) for m in listing["maps"]]
    for others in ((1, 2), (2,)):
        of = [maps[k] for k in (0, *others)]
        odds = score_coarsely(CoarseTask(tuple(file for file, _ in of), tuple(key for _, key in of), "fixed"))
    assert len(loaded) == 3
    free = score_coarsely(CoarseTask((maps[0][0], maps[2][0]), (maps[0][1], maps[2][1]), "free"))
    assert len(loaded) == 3 and free != odds
    workers._get_memory.cache_clear()


@pytest.mark.slow
def test_processes_give_the_same_atlas(alone, tmp_path):
    add(tmp_path / "house", parts(), tm.render_atlas_html, workers.start_processes(2))
    assert same_atlas(alone, tmp_path / "house")


@contextlib.contextmanager
def dask(*words: str, folder: Path) -> Iterator[subprocess.Popen]:
    """A scheduler or a worker."""
    root = str(Path(__file__).parent.parent.parent.parent)
    about = {**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *words], cwd=folder, env=about, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()


@pytest.mark.slow
def test_a_cluster_gives_the_same_atlas_though_a_worker_is_killed(alone, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    words = ("--scheduler-file", str(file))
    worker = ("worker", *words, "--nthreads", "1", "--no-nanny", "--no-dashboard")
    with dask("scheduler", *words, "--port", "0", "--no-dashboard", folder=tmp_path) as _:
        while not file.exists():
            time.sleep(0.2)
        with dask(*worker, folder=tmp_path) as first, dask(*worker, folder=tmp_path):
            address = json.loads(file.read_text())["address"]
            with distributed.Client(address, set_as_default=False) as client:
                client.wait_for_workers(2, timeout=60)
            real = workers.connect_cluster(address)

            def killing(work: Callable[[Any], Any], tasks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
                for count, numbered in enumerate(real(work, tasks)):
                    if count == 0 and work is register_pair:
                        first.send_signal(signal.SIGKILL)
                    yield numbered

            add(tmp_path / "house", parts(), tm.render_atlas_html, killing)
            assert first.wait(10) == -signal.SIGKILL
    assert same_atlas(alone, tmp_path / "house")


def test_nobody_answers(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "CONNECTING", 0.5)
    with pytest.raises(InputError, match=r"--cluster tcp://127\.0\.0\.1:9: no scheduler answers there"):
        add(tmp_path / "house", parts(), tm.render_atlas_html, workers.connect_cluster("tcp://127.0.0.1:9"))


def test_dask_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"needs Dask: pip install 'topomerge\[cluster\]'"):
        workers.connect_cluster("tcp://127.0.0.1:9")
