"""Fixtures for all tests, and what was skipped, told in the last lines."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Generator
from pathlib import Path

import pytest

LACKS = {  # what a test says that it lacks, in the reason of its skip -> what the last lines call it
    r"TOPOMERGE_DATA": "real data (TOPOMERGE_DATA)",
    r"Chromium": "a browser (Chromium)",
    r"git checkout": "a git checkout, for the wheel",
    r"could not import|No module named": "a package that is not installed",
}
UNCHOSEN = pytest.StashKey[int]()  # tests that need real data and are not among the chosen ones


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config, "workerinput"):  # one of several processes of xdist
        from tests.compiling import compile_once

        compile_once()


def pytest_runtest_setup() -> None:
    from tests.exporting import share_registry

    share_registry()


@pytest.fixture(scope="session", autouse=True)
def _forked_readers() -> Generator[None]:
    """Readers of files of strangers are forks of this process; a fresh process takes a second to start."""
    from tests.forked import ForkedChild
    from topomerge.io import piece

    with pytest.MonkeyPatch.context() as patch:
        if hasattr(os, "fork"):
            patch.setattr(piece, "start_child", ForkedChild)
        yield


@pytest.fixture
def fresh_readers(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of the process itself: it starts as in the product."""
    from tests.forked import start_fresh_child
    from topomerge.io import piece

    monkeypatch.setattr(piece, "start_child", start_fresh_child)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real data named by TOPOMERGE_DATA; tests that ask for it are marked `data` and skip without it."""
    name = os.environ.get("TOPOMERGE_DATA", "")
    if not name:
        pytest.skip("TOPOMERGE_DATA is not set")
    folder = Path(name)
    if not folder.is_dir():
        pytest.skip(f"TOPOMERGE_DATA={name} is not a folder")
    return folder


@pytest.fixture(scope="session")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for `cache/` of all tests of one's own pairs, also of those in other processes: they extract the same houses."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "own_cache"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def case_dir(data_dir: Path) -> Path:
    """The folder `cases` beside that of real data: small files of strangers that failed once, not in the repository."""
    folder = data_dir.parent / "cases"
    if not folder.is_dir():
        pytest.skip("TOPOMERGE_DATA has no folder `cases` beside it")
    return folder


def skips_told(reasons: list[str], unchosen: int = 0) -> list[str]:
    """How many tests were skipped for want of what, all that can be lacking also when none was; other reasons word for word.

    Args:
        reasons: one a skipped test, or a skipped file.
        unchosen: tests that need real data and were not chosen.
    """
    lacking = [next((what for pattern, what in LACKS.items() if re.search(pattern, reason)), "") for reason in reasons]
    needs = Counter(lacking)
    lines = [f"{needs[what]} tests that need {what} were skipped" for what in LACKS.values()]
    lines[0] += f"; {unchosen} more take longer and are not of this run" if unchosen else ""
    others = Counter(reason for reason, what in zip(reasons, lacking, strict=True) if not what)
    return [*lines, *(f"{count} tests were skipped: {reason}" for reason, count in sorted(others.items()))]


def pytest_deselected(items: list[pytest.Item]) -> None:
    if items:
        stash = items[0].config.stash
        stash[UNCHOSEN] = stash.get(UNCHOSEN, 0) + sum(item.get_closest_marker("data") is not None for item in items)


def pytest_sessionfinish(session: pytest.Session) -> None:
    if hasattr(session.config, "workeroutput"):  # a worker of xdist tells the process that prints
        session.config.workeroutput["unchosen"] = session.config.stash.get(UNCHOSEN, 0)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: object) -> None:
    config, said = getattr(node, "config"), getattr(node, "workeroutput", {})  # noqa: B009 (types of xdist, which may be absent)
    config.stash[UNCHOSEN] = max(config.stash.get(UNCHOSEN, 0), said.get("unchosen", 0))  # each worker collects all


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Generator[None, None, None]:
    yield  # after all that others have to say
    skipped = terminalreporter.stats.get("skipped", [])
    reasons = [report.longrepr[2].removeprefix("Skipped: ") for report in skipped]
    for line in skips_told(reasons, terminalreporter.config.stash.get(UNCHOSEN, 0)):
        terminalreporter.write_line(line)
