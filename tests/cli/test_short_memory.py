"""What the command line says where memory is short, a command was killed, or a name steers a terminal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from topomerge import archive
from topomerge.archive import replace_on_success
from topomerge.cli.console import find_signal, format_failure
from topomerge.errors import InputError, is_memory_short
from topomerge.fusion.atlas import folder as atlas_folder
from topomerge.viz.tables import build_element

SHORT = [
    MemoryError(),
    OSError(12, "Cannot allocate memory"),
    RuntimeError("std::bad_alloc"),
    RuntimeError("can't start new thread"),
    ImportError("libx.so: failed to map segment from shared object"),
    np._core._exceptions._ArrayMemoryError((9, 9), np.dtype(float)),
]


@pytest.mark.parametrize("error", SHORT)
def test_short_memory_in_any_words(error: BaseException) -> None:
    assert format_failure(error, ["a.ply"]).startswith("a.ply: not enough memory")
    outer = OSError("Could not find a library")
    outer.__cause__ = error
    assert is_memory_short(outer)


def test_other_errors_and_circles_of_them_are_not_short_memory() -> None:
    first, second = ValueError("a"), KeyError("b")
    first.__context__, second.__context__ = second, first
    assert not is_memory_short(first) and find_signal(first) is None
    assert not is_memory_short(InputError("a name that is out of memory"))


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="limits of the address space are Linux's")
@pytest.mark.parametrize("megabytes", [260, 480])
def test_a_limited_address_space_is_named(tmp_path: Path, megabytes: int) -> None:
    np.save(tmp_path / "a.npy", np.random.default_rng(0).random((200_000, 3)) * (30, 20, 3))
    words = f"ulimit -v {megabytes * 1000}; exec {sys.executable} -m topomerge extract a.npy -o a.tmap"
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(["bash", "-c", words], cwd=tmp_path, capture_output=True, text=True, env=environment, timeout=200)
    assert done.returncode == 1
    assert "not enough memory" in done.stderr or "does not fit into memory" in done.stderr
    assert "fault in topomerge" not in done.stderr


def test_what_killed_processes_left_is_cleared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kill = "import os, sys; from topomerge.archive import replace_on_success\nwith replace_on_success(sys.argv[1]): os._exit(9)"
    for k in range(3):
        subprocess.run([sys.executable, "-c", kill, str(tmp_path / f"m{k}.tmap")], check=False)
    assert list(tmp_path.glob(".*.part"))
    (tmp_path / f".mine.{archive._compute_machine_id()}-{os.getpid()}.abc.part").mkdir()
    (tmp_path / ".theirs.00000000-1.abc.part").mkdir()
    archive._delete_stale_parts.cache_clear()
    with replace_on_success(tmp_path / "a.txt") as beside:
        beside.write_text("a")
    left = sorted(p.name.split(".")[1] for p in tmp_path.glob(".*.part"))
    assert left == ["mine", "theirs"] and (tmp_path / "a.txt").read_text() == "a"


@pytest.mark.parametrize("exists", [False, True])
def test_an_atlas_that_cannot_be_written_leaves_no_lock(tmp_path: Path, exists: bool) -> None:
    place = tmp_path / "site"
    if exists:
        place.mkdir()
    with pytest.raises(InputError, match="No space left"), atlas_folder.change_folder(place, []):
        raise OSError(28, "No space left on device")
    assert place.exists() == exists and not list(tmp_path.rglob(".lock"))


def test_watch_that_is_interrupted_while_it_starts(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    slow = "import time, topomerge.cli.atlas as w\nw._build_monitor = lambda args: print('on', flush=True) or time.sleep(60)\n"
    start = f"{slow}import sys; from topomerge.cli.main import main; sys.argv[0] = 'topomerge'; sys.exit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", start, "watch", str(tmp_path / "scans"), "-o", str(tmp_path / "site")],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None and process.stdout.readline() == "on\n"
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    assert process.stdout.readline().startswith("stopped after")
    assert process.wait(30) == 0


def test_control_characters_reach_no_page() -> None:
    made = build_element("title", "a\x1b[31m\x07\x9b.ply", title="b\x07")
    assert not any(c in made for c in "\x1b\x07\x9b") and "\ufffd" in made
