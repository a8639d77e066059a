"""Broken and hostile files of every format are read or refused, within a limit of time and of memory.

`python -m tests.fuzz.drive --each 1000` tries more of them and prints a table.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.drive import run
from tests.fuzz.mutate import general, mutant


def faults(folder: Path, seeds: range) -> tuple[int, list[str]]:
    """How many were tried, and what went wrong."""
    tried = list(run(folder, seeds))
    return len(tried), [f"{name} {seed}: {message}" for name, seed, state, message in tried if state == "fault"]


@pytest.mark.longer
def test_a_few_mutants_of_every_format(tmp_path: Path) -> None:
    tried, wrong = faults(tmp_path / "a", range(2))
    assert tried >= 50
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
def test_thousands_of_mutants(tmp_path: Path) -> None:
    tried, wrong = faults(tmp_path / "a", range(1000, 1300))
    assert tried >= 8000
    assert not wrong, "\n".join(wrong)


def test_the_same_seed_breaks_a_file_in_the_same_way() -> None:
    corpus = {"a.ply": bytes(range(256)) * 8, "b.npz": b"PK" + bytes(100)}
    made = [[mutant(name, corpus, seed) for name in corpus for seed in range(50)] for _ in range(2)]
    assert made[0] == made[1]
    assert len(set(made[0])) > 80


@pytest.mark.longer
def test_the_driver_sees_what_must_not_happen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that dies, hangs, eats memory or raises something else is found out."""
    (tmp_path / "sitecustomize.py").write_text(
        "import os, time\n"
        "import tests.fuzz.corpus as corpus\n"
        "plain = corpus.read_cloud\n"
        "def read(path):\n"
        "    data = path.read_bytes()\n"
        "    if data.startswith(b'die'): os.abort()\n"
        "    if data.startswith(b'eat'): bytearray(3 << 30)\n"
        "    if data.startswith(b'odd'): raise KeyError('odd')\n"
        "    if data.startswith(b'hang'): time.sleep(60)\n"
        "    return plain(path)\n"
        "corpus.read_cloud = read\n"
        "import tests.fuzz.mutate as mutate\n"
        "mutate.mutant = lambda name, corpus, seed: (b'die', b'eat', b'odd', b'hang', b'1 2 3')[seed]\n"
    )
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path(__file__).parent.parent.parent}")
    monkeypatch.setattr("tests.fuzz.drive.PATIENCE", 1.0)
    told = [(state, message) for *_, state, message in run(tmp_path / "a", range(5), ["table.xyz"])]
    assert [state for state, _ in told] == ["fault"] * 4 + ["read"]
    for (_, message), word in zip(told, ("died with -6", "MemoryError", "KeyError", "more than 1 s", "1"), strict=True):
        assert word in message


def test_damage_is_damage() -> None:
    import numpy as np

    data = bytes(range(200))
    assert sum(general(data, np.random.default_rng(s)) != data for s in range(100)) > 90
