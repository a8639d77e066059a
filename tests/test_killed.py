"""Commands that are killed at any moment leave whole files or none, and never files of two runs beside each other."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import topomerge
from topomerge.io.maps import load_map

SMALL = ["--building", "house", "--rooms", "4", "--quiet"]

# Ends the process, as a kill would, before the rename whose number is in the first word.
AT_A_RENAME = """
import os, pathlib, sys
left = int(sys.argv.pop(1))
plain = pathlib.Path.replace
def replace(self, target):
    global left
    left -= 1
    if left < 0:
        os._exit(9)
    return plain(self, target)
pathlib.Path.replace = replace
from topomerge.cli.main import main
sys.exit(main(sys.argv[1:]))
"""


def run(*words: str | Path, renames: int | None = None) -> int:
    start = ["-m", "topomerge"] if renames is None else ["-c", AT_A_RENAME, str(renames)]
    return subprocess.run([sys.executable, *start, *map(str, words)], capture_output=True, timeout=300, check=False).returncode


def killed_after(seconds: float, *words: str | Path) -> bool:
    """Start a command and kill it; was it still at work?"""
    process = subprocess.Popen(
        [sys.executable, "-m", "topomerge", *map(str, words)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
    return process.wait() == -signal.SIGKILL


def check_whole(folder: Path) -> set[str]:
    """Names of the files that a command could take for whole; each is read to its end."""
    readers: dict[str, Callable[[Path], object]] = {
        ".tmap": load_map,
        ".ply": topomerge.read_points,
        ".json": lambda path: json.loads(path.read_text()),
        ".html": lambda path: path.read_text().rstrip().endswith("</html>") or pytest.fail(f"{path} is cut off"),
        "": lambda path: None,  # a folder of another test
        ".png": lambda path: path.read_bytes().endswith(b"IEND\xaeB`\x82") or pytest.fail(f"{path} is cut off"),
    }
    names = set()
    for path in folder.iterdir() if folder.exists() else ():
        if path.suffix == ".part":  # hidden, and no reader takes this suffix
            assert path.name.startswith(".")
            continue
        readers[path.suffix](path)
        names.add(path.name)
    return names


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("killed") / "pair"
    assert run("simulate", *SMALL, "--seed", "3", "-o", folder) == 0
    return folder


@pytest.mark.longer
def test_killed_between_two_renames(tmp_path: Path) -> None:
    """The files of an earlier run never stand beside those of a later one."""
    names = ["a.ply", "b.ply", "truth.json"]
    for renames in range(4):
        folder = tmp_path / str(renames)
        folder.mkdir()
        for name in names:
            (folder / name).write_text("old")
        code = AT_A_RENAME.replace("topomerge.cli.main import main", "topomerge.cli.console import write_all").replace(
            "sys.exit(main(sys.argv[1:]))",
            "write_all([(n, lambda path: path.write_text('new')) for n in sys.argv[1:]])",
        )
        done = subprocess.run([sys.executable, "-c", code, str(renames), *names], cwd=folder, timeout=60, check=False)
        assert done.returncode == (9 if renames < 3 else 0)
        left = [folder / name for name in names if (folder / name).exists()]
        assert [path.read_text() for path in left] == ["new"] * renames


@pytest.mark.slow
def test_killed_at_each_rename(pair: Path, tmp_path: Path) -> None:
    commands: list[list[str | Path]] = [
        ["simulate", *SMALL, "--seed", "4", "-o", tmp_path / "pair"],
        ["extract", pair / "a.ply", "-o", tmp_path / "a.tmap", "--json", tmp_path / "a.json", "--ply", tmp_path / "a.ply", "-q"],
    ]
    for words in commands:
        status, renames = 9, 0
        while status == 9:
            status = run(*words, renames=renames)
            check_whole(tmp_path / "pair" if words[0] == "simulate" else tmp_path)
            renames += 1
        assert status == 0 and renames > 3


@pytest.mark.slow
@pytest.mark.parametrize("command", ["simulate", "extract", "merge"])
def test_killed_at_random_moments(pair: Path, tmp_path: Path, command: str) -> None:
    """Kills all over the time that the command takes; what is left is read, and then the command is run to its end there."""
    words: dict[str, list[str | Path]] = {
        "simulate": ["simulate", *SMALL, "--seed", "3", "-o", tmp_path / "out"],
        "extract": ["extract", pair / "a.ply", "-o", tmp_path / "a.tmap", "--json", tmp_path / "a.json", "-q"],
        "merge": ["merge", pair / "a.ply", pair / "b.ply", "-o", tmp_path / "out", "--force", "-q"],
    }
    place = tmp_path if command == "extract" else tmp_path / "out"
    began = time.monotonic()
    assert run(*words[command]) in (0, 2)
    whole, took = check_whole(place), time.monotonic() - began
    rng, killed = random.Random(7), 0
    for _ in range(20):
        for name in check_whole(place):
            (place / name).unlink()
        killed += killed_after(rng.uniform(0.0, took), *words[command])
        assert check_whole(place) <= whole
    assert killed >= 5
    assert run(*words[command]) in (0, 2) and check_whole(place) == whole
