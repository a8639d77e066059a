"""Fixtures of the tests of readers and writers."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.samples import write_all


@pytest.fixture(scope="session")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Name -> a small file of every format. Tests copy what they change."""
    return write_all(tmp_path_factory.mktemp("samples"))


@pytest.fixture
def bags_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bags are read in this process: for tests that read dozens."""
    from topomerge.io import bag

    monkeypatch.setattr(bag, "read_in_subprocess", lambda _module, _kind, path, options, **_: bag.read_in_process(path, options))
