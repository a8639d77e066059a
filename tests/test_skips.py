"""The last lines of a run of the tests: how many were skipped, and for want of what."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOME = """
import pytest
def test_data(data_dir): pass
@pytest.mark.data
@pytest.mark.slow
def test_slow_data(data_dir): pass
def test_browser(): pytest.skip("no Chromium here: apt-get install chromium")
def test_package(): pytest.importorskip("no_such_package")
@pytest.mark.parametrize("k", [1, 2])
def test_shell(k): pytest.skip("no fish")
def test_fine(): pass
"""
NOTHING_LACKED = [
    "0 tests that need real data (TOPOMERGE_DATA) were skipped",
    "0 tests that need a browser (Chromium) were skipped",
    "0 tests that need a git checkout, for the wheel were skipped",
    "0 tests that need a package that is not installed were skipped",
]


def last_lines(folder: Path, text: str, *options: str) -> list[str]:
    """What a run of these tests says last, without the line that counts all."""
    tests = folder / "tests"
    tests.mkdir(parents=True)
    for name in ("conftest.py", "compiling.py", "exporting.py", "forked.py"):
        shutil.copy(ROOT / "tests" / name, tests)
    (tests / "test_some.py").write_text(text)
    (folder / "pytest.ini").write_text("[pytest]\nmarkers =\n  slow: s\n  data: d\n")
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("TOPOMERGE_", "PYTEST_"))}
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # they take seconds
    words = [sys.executable, "-m", "pytest", "-q", "-rs", "-m", "not slow", *options, str(folder)]
    done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    *lines, total = done.stdout.strip().splitlines()
    assert "passed" in total
    return lines


@pytest.mark.longer
@pytest.mark.parametrize("options", [(), ("-p", "xdist.plugin", "-n", "2")], ids=["alone", "xdist"])
def test_the_last_lines_tell_what_was_skipped(tmp_path: Path, options: tuple[str, ...]) -> None:
    assert last_lines(tmp_path / "some", SOME, *options)[-5:] == [
        "1 tests that need real data (TOPOMERGE_DATA) were skipped; 1 more take longer and are not of this run",
        "1 tests that need a browser (Chromium) were skipped",
        "0 tests that need a git checkout, for the wheel were skipped",
        "1 tests that need a package that is not installed were skipped",
        "2 tests were skipped: no fish",
    ]


def test_nothing_skipped_is_told_too(tmp_path: Path) -> None:
    assert last_lines(tmp_path / "none", "def test_fine(): pass")[-4:] == NOTHING_LACKED


def test_ci_ends_with_the_tests() -> None:
    """What the tests print last is what CI prints last."""
    commands = [line for line in (ROOT / ".ci" / "run").read_text().splitlines() if line and not line.startswith("#")]
    assert commands[-1] == "make test"
    recipe = (ROOT / "Makefile").read_text().partition("\ntest test-longer: setup\n")[2].split("\n\n")[0]
    assert recipe.count("\n") == 0 and "pytest" in recipe
