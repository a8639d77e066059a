"""`topomerge watch`: exit statuses and lines, a Ctrl-C, and a kill of the process itself."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

import topomerge as tm
from tests.cli.processes import Run
from tests.fusion.atlas.test_watch import room, state
from topomerge.fusion.atlas.folder import read_atlas

QUICK = ("--settle", "0.05", "--every", "0.05")


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    folder = tmp_path / "scans"
    folder.mkdir()
    for k in range(2):
        tm.save_map(room(k), folder / f"{k}.tmap")
    return folder


def test_once(run: Run, scans: Path) -> None:
    (scans / "bad.ply").write_text("no cloud")
    status, out, err = run("watch", "scans", "-o", "site", "--once", *QUICK)
    assert status == 0 and out.splitlines()[-1] == "2 added, 1 unreadable; site holds 2 maps"
    assert err.count("\n") == 1 and "bad.ply: is not a PLY file" in err and "skipped until it changes" in err
    assert run("watch", "scans", "-o", "site", "--once", *QUICK) == (0, "nothing new; site holds 2 maps\n", "")
    assert run("watch", "scans", "-o", "site", "--once", "-q", *QUICK) == (0, "", "")
    assert json.loads((Path("site") / "watch.json").read_text())["format"] == 1


@pytest.mark.longer
def test_what_simulate_wrote_beside_clouds_is_passed_over(run: Run, scans: Path) -> None:
    words = ("simulate", "--building", "house", "--rooms", "3", "--sensors", "tls", "-q", "-o", "pair")
    assert run(*words) == (0, "", "")
    for name in ("truth.json", "plan.png"):
        (scans / name).write_bytes((Path("pair") / name).read_bytes())
    status, out, err = run("watch", "scans", "-o", "site", "--once", *QUICK)
    assert (status, err) == (0, "") and out.splitlines()[-1] == "2 added; site holds 2 maps"
    (scans / "truth.json").write_text('{"format": 1}')
    _, _, err = run("watch", "scans", "-o", "site", "--once", *QUICK)
    assert err.count("\n") == 2 and "plan.png" in err and "truth.json" in err


def test_a_link_to_nothing_is_told_of_once(run: Run, scans: Path) -> None:
    (scans / "gone.ply").symlink_to(scans / "other.ply")
    status, out, err = run("watch", "scans", "-o", "site", "--once", *QUICK)
    assert status == 0 and "2 added" in out and err.count("\n") == 1
    assert "gone.ply: is a link to what is not there; it is skipped until it is" in err


@pytest.mark.skipif(sys.platform == "win32", reason="no line breaks in names there")
def test_a_name_with_a_line_break_is_printed_in_one_line(run: Run, scans: Path) -> None:
    (scans / "1.tmap").rename(scans / "li\nne.tmap")
    _, out, _ = run("watch", "scans", "-o", "site", "--once", *QUICK)
    assert len(out.splitlines()) == 3 and "li ne.tmap -> li_ne: " in out
    _, out, _ = run("atlas", "list", "site")
    assert len(out.splitlines()) == 4 and out.splitlines()[-1].endswith("li ne.tmap")


def test_other_options_are_another_reading(run: Run, scans: Path) -> None:
    run("watch", "scans", "-o", "site", "--once", *QUICK)
    status, out, _ = run("watch", "scans", "-o", "site", "--once", "--sensor", "tls", *QUICK)
    assert status == 0 and "0.tmap: is in the atlas already, as 0" in out  # the same maps, as they are no clouds


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nowhere", "-o", "site"), "nowhere: no such folder"),
        (("scans", "-o", "scans"), "scans: is watched and can't be the atlas"),
        (("scans", "-o", "site", "--every", "0"), "above 0"),
        (("scans",), "required: -o"),
        (("scans", "-o", "site", "--risk", "10", "--threshold", "0.9"), "give one of them"),
    ],
)
def test_bad_input_is_told_in_one_line(run: Run, scans: Path, words: tuple[str, ...], message: str) -> None:
    status, out, err = run("watch", *words, "--once")
    assert status == 1 and out == "" and message in err and len(err.splitlines()) == 1


def started(scans: Path, site: Path, *words: str) -> subprocess.Popen[str]:
    start = [sys.executable, "-m", "topomerge", "watch", str(scans), "-o", str(site), *QUICK, *words]
    heard = partial(signal.signal, signal.SIGINT, signal.default_int_handler)  # a suite in the background ignores Ctrl-C
    return subprocess.Popen(start, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heard)


@pytest.mark.longer
def test_a_ctrl_c_ends_it_with_a_line(scans: Path, tmp_path: Path) -> None:
    process = started(scans, tmp_path / "site")
    assert process.stdout is not None and process.stdout.readline().startswith("0.tmap -> 0: 1 room; ")
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0 and out.splitlines()[-1].startswith("stopped after ") and "Traceback" not in err
    if (tmp_path / "site" / "atlas.json").exists():
        assert {e.name for e in read_atlas(tmp_path / "site").entries} <= {"0", "1"}


@pytest.mark.slow
def test_the_process_killed_twenty_times_ends_as_if_never_killed(scans: Path, tmp_path: Path) -> None:
    began = time.monotonic()
    assert started(scans, tmp_path / "whole", "--once").wait(300) == 0
    took, rng, killed = time.monotonic() - began, random.Random(1), 0
    for _ in range(20):
        process = started(scans, tmp_path / "killed", "--once")
        time.sleep(rng.uniform(0.3 * took, took))
        process.kill()
        process.communicate(timeout=60)
        killed += process.returncode == -signal.SIGKILL
        if (tmp_path / "killed" / "atlas.json").exists() and rng.random() < 0.5:
            with (scans / f"{len(list(scans.iterdir()))}.tmap").open("wb") as stream:  # there is always more to do
                stream.write((scans / "0.tmap").read_bytes()[: -rng.randrange(9)])
    assert killed >= 5 and started(scans, tmp_path / "killed", "--once").wait(300) == 0
    assert started(scans, tmp_path / "whole", "--once").wait(300) == 0
    whole, ended = state(tmp_path / "whole"), state(tmp_path / "killed")
    assert whole.pop("watch.json") and ended.pop("watch.json") and ended == whole
