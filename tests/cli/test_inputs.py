"""The maps of a command's inputs: extracted by one process or by several, with the same result and the same errors."""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

import topomerge
from tests.cases import list_longer
from tests.cli.processes import Run
from tests.io.signs import walk_poses
from tests.io.test_read_signs import write_corridor
from tests.scenes import two_rooms
from topomerge.cli import inputs
from topomerge.cli.inputs import COMPRESSION, MEMORY_GROWTH, MEMORY_START, count_processes, iter_input_maps, measure_input
from topomerge.errors import InputError


@pytest.fixture
def clouds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Three clouds that differ, each large enough for a process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(inputs, "LEAST_SIZE", {"fork": 1, "spawn": 1})
    points = two_rooms().points()
    for k, name in enumerate("abc"):
        np.save(f"{name}.npy", points[:: k + 1] + np.float32(k))
    return ["a.npy", "b.npy", "c.npy"]


@pytest.fixture
def began(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The inputs that this process loads."""
    here: list[str] = []
    load = inputs._load_map

    def note(path: str, *rest: Any) -> Any:
        here.append(path)
        return load(path, *rest)

    monkeypatch.setattr(inputs, "_load_map", note)
    return here


@pytest.fixture(params=["fork", "spawn"])
def method(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """How processes are started: those that are forked hold what this process has, which must not matter."""
    if request.param == "fork" and (sys.platform != "linux" or "onnxruntime" in sys.modules):
        pytest.skip("another test opened a network in this process")
    monkeypatch.setattr(inputs, "choose_start", lambda: request.param)
    return str(request.param)


def list_children(of: psutil.Process | None = None) -> list[psutil.Process]:
    """Processes that were started, but for Python's own tracker of resources."""
    return [child for child in (of or psutil.Process()).children() if "resource_tracker" not in " ".join(child.cmdline())]


def choose(jobs: int, **others: Any) -> argparse.Namespace:
    return argparse.Namespace(quiet=True, jobs=jobs, **others)


@pytest.mark.longer
def test_any_number_of_processes_gives_the_same_maps(clouds: list[str], began: list[str], method: str) -> None:
    topomerge.save_map(topomerge.extract(np.load("a.npy")), "d.tmap")
    paths = [clouds[0], "d.tmap", *clouds[1:]]
    alone = list(iter_input_maps(paths, choose(1, voxel_size=0.12, sensor="tls")))
    assert began == paths
    began.clear()
    shared = list(iter_input_maps(paths, choose(2, voxel_size=0.12, sensor="tls")))
    assert "d.tmap" in began and len(began) < len(paths)  # maps are read here, and another process took a cloud
    for one, other in zip(alone, shared, strict=True):
        assert one.map.source == other.map.source and one.map.parameters == other.map.parameters
        assert one.map.warnings == other.map.warnings and one.map.grid.edge == other.map.grid.edge
        for name in ("room", "navigable_room", "rooms", "edges", "storeys", "areas", "windows"):
            assert getattr(one.map, name).tobytes() == getattr(other.map, name).tobytes(), name
        assert np.array_equal(one.map.grid.cells, other.map.grid.cells)
        assert one.parts is None and other.parts is None  # what registration needs is drawn for who asks
        assert other.read_seconds > 0 and (other.extract_seconds > 0) == (one.extract_seconds > 0)
    assert not list_children()


@pytest.mark.longer
def test_processes_start_before_the_maps_are_asked_for(clouds: list[str], began: list[str], method: str) -> None:
    """They import and read while a command checks what it was given, and draw what registration needs of a map."""
    with inputs.InputMaps(clouds[:2], choose(2), prepares=True) as maps:
        assert len(list_children()) == 1 and not began
        loaded = list(maps)
        assert not list_children()  # they do not wait for the end of the command
    assert [one.map.source for one in loaded] == clouds[:2] and len(began) == 1
    assert all(one.parts is not None and one.parts["surface"] is not None for one in loaded)
    with inputs.InputMaps(clouds[:2], choose(2)):
        pass  # a command that refuses what it was given
    assert not list_children()


def test_forked_processes_do_not_outlive_the_first(clouds: list[str]) -> None:
    """Each closes the ends of the others' pipes that it inherits: else it would wait for ever."""
    code = f"""
import argparse, os, signal
from topomerge.cli import inputs
inputs.LEAST_SIZE = {{"fork": 1, "spawn": 1}}
maps = inputs.InputMaps({clouds!r}, argparse.Namespace(quiet=True, jobs=3))
maps.__enter__()
print(inputs.choose_start(), *(process.pid for process, _ in maps._others._started), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stdout.split()
    assert len(told) == 3
    wait_for(lambda: not any(psutil.pid_exists(int(pid)) for pid in told[1:]))


def test_nothing_is_forked_beside_threads_and_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delitem(sys.modules, "onnxruntime", raising=False)
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    assert inputs.choose_start() == "fork"
    monkeypatch.setattr(threading, "active_count", lambda: 2)
    assert inputs.choose_start() == "spawn"
    monkeypatch.setattr(threading, "active_count", lambda: 1)
    monkeypatch.setitem(sys.modules, "onnxruntime", sys)
    assert inputs.choose_start() == "spawn"
    monkeypatch.delitem(sys.modules, "onnxruntime")
    monkeypatch.setattr(sys, "platform", "darwin")
    assert inputs.choose_start() == "spawn"


def test_what_is_needed_later_is_imported_while_another_process_works(clouds: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    other: Future[inputs.LoadedMap] = Future()
    here: Future[inputs.LoadedMap] = Future()
    other.set_running_or_notify_cancel()
    here.set_result(inputs.LoadedMap(topomerge.extract(np.load("b.npy")), 0.0))
    monkeypatch.setattr(inputs, "_load_future", lambda *_: here)
    monkeypatch.setattr(inputs._Processes, "__enter__", lambda self: self)
    monkeypatch.setattr(inputs._Processes, "submit", lambda self, path: other if path == "a.npy" else Future())
    with inputs.InputMaps(clouds[:2], choose(2), ["later", "never"]) as maps:

        def note(name: str) -> None:
            assert name == "later"
            other.set_result(here.result())

        monkeypatch.setattr(inputs, "import_module", note)
        assert next(iter(maps)) is here.result()


@pytest.mark.longer
def test_the_first_file_that_is_wrong_is_named(run: Run, clouds: list[str]) -> None:
    for name in "bc":
        Path(f"{name}.npy").write_bytes(b"no points")
    alone = run("merge", *clouds, "-o", "out", "--jobs", "1")
    shared = run("merge", *clouds, "-o", "out", "--jobs", "2")
    assert alone == shared and alone[0] == 1
    assert alone[2].startswith("topomerge: b.npy: ") and alone[2].count("\n") == 1


def test_a_process_that_is_killed(clouds: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    start = inputs._Processes._get_process

    def killed(self: Any) -> Any:
        process, connection = start(self)
        process.kill()
        return process, connection

    monkeypatch.setattr(inputs._Processes, "_get_process", killed)
    with pytest.raises(InputError, match=r"^[ab]\.npy: the process that extracted it ended \(signal 9\); .* give --jobs 1$"):
        list(iter_input_maps(clouds[:2], choose(2)))


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), *list_longer((signal.SIGTERM, 143))])
@pytest.mark.longer
def test_a_signal_ends_all_processes(clouds: list[str], number: int, status: int) -> None:
    code = """
import sys
from topomerge.cli import inputs
from topomerge.cli.main import main
inputs.LEAST_SIZE = {"fork": 1, "spawn": 1}
sys.exit(main())
"""
    heard = partial(signal.signal, signal.SIGINT, signal.default_int_handler)  # a suite in the background ignores Ctrl-C
    words = [sys.executable, "-c", code, "merge", *clouds, "-o", "out", "--jobs", "2"]
    command = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, preexec_fn=heard, start_new_session=True)
    own = psutil.Process(command.pid)
    wait_for(lambda: len(list_children(own)) > 0)
    children = own.children()
    time.sleep(0.3)
    if number == signal.SIGINT:
        os.killpg(command.pid, number)  # as a terminal does
    else:
        command.send_signal(number)
    _, err = command.communicate(timeout=30)
    assert command.returncode == status and err == ("topomerge: interrupted\n" if status == 130 else "")
    wait_for(lambda: not any(child.is_running() and child.status() != psutil.STATUS_ZOMBIE for child in children))
    assert not Path("out").exists()


def wait_for(holds: Callable[[], bool], seconds: float = 30) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_processes_are_limited_by_cores_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def free(size: int) -> None:
        monkeypatch.setattr(inputs, "estimate_free_memory", lambda: size)

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3}, raising=False)
    free(10**12)
    assert [count_processes([1] * 3), count_processes([1] * 9), count_processes([1] * 9, 2), count_processes([])] == [3, 4, 2, 1]
    small, large = MEMORY_START + MEMORY_GROWTH * 10**7, MEMORY_START + MEMORY_GROWTH * 10**9
    free(large + small)
    assert count_processes([10**7, 10**9, 10**7]) == 2  # the largest counts first
    free(large + small - 1)
    assert count_processes([10**7, 10**9, 10**7]) == 1
    free(0)
    assert count_processes([10**7, 10**7]) == 1


def test_free_memory_is_that_of_the_container(tmp_path: Path) -> None:
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text("MemTotal:  9000 kB\nMemAvailable:  4000 kB\n")
    assert inputs.estimate_free_memory(tmp_path) == 4000 * 1024
    group = tmp_path / "sys/fs/cgroup"
    group.mkdir(parents=True)
    (group / "memory.stat").write_text("anon 1000\nfile 5\n")
    for text, free in (("max\n", 4000 * 1024), ("500000\n", 499_000), ("10\n", 0)):
        (group / "memory.max").write_text(text)
        assert inputs.estimate_free_memory(tmp_path) == free
    assert inputs.estimate_free_memory(tmp_path / "nothing") > 10**8


def test_size_of_an_input(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for name in ("a.ply", "in/b.LAZ"):
        (tmp_path / name).write_bytes(bytes(100))
    assert measure_input(str(tmp_path / "a.ply")) == 100
    assert measure_input(str(tmp_path)) == 100 + 100 * COMPRESSION[".laz"]
    assert measure_input(str(tmp_path / "missing")) == 0


def test_signs_may_be_left_out_or_demanded(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`--text` fails without the package, before anything is read; `--no-text` reaches the reader, of `merge`, too."""
    from topomerge.cli.options import collect_reading_options
    from topomerge.io import pictures

    monkeypatch.setattr(pictures, "load_text_reader", lambda: None)
    folder = write_corridor(tmp_path / "walk", walk_poses(2))
    status, _, said = run("extract", str(folder), "-o", str(tmp_path / "a.tmap"), "--text", "-q")
    assert status == 1 and "pip install topomerge[text]" in said and not (tmp_path / "a.tmap").exists()
    assert collect_reading_options(str(folder), argparse.Namespace(text=False, up="z")) == {"text": False, "up": "z"}
    assert collect_reading_options(str(folder), argparse.Namespace(tag_size=0.2)) == {"tag_size": 0.2}
    assert {"text", "tag_size"} <= set(inputs.WORKER_OPTIONS)
    assert collect_reading_options(str(folder), argparse.Namespace()) == {}
