"""A folder that changes as a whole: a kill at any moment leaves the old or the new one."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from topomerge.errors import InputError
from topomerge.fusion.atlas.folder import change_folder, finish_change


def state(folder: Path) -> dict[str, str]:
    """Its files after an interrupted change was finished."""
    finish_change(folder)
    return {p.name: p.read_text() for p in folder.rglob("*") if p.is_file() and not str(p.relative_to(folder)).startswith(".")}


def change(folder: Path) -> None:
    gone = ["old"]
    with change_folder(folder, gone) as place:
        (place / "maps").mkdir()
        for name in ("a", "maps/b", "new"):
            (place / name).write_text("2")


def test_a_full_disk_is_not_taken_for_a_wrong_name(tmp_path, monkeypatch):
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(InputError, match=r"No space left on device\); make room there, or give another folder"):
        change(tmp_path / "house")
    assert not (tmp_path / "house").exists()


@pytest.mark.longer
@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a copy of this process")
def test_a_kill_at_any_moment_leaves_the_old_or_the_new(tmp_path):
    """Every call that changes a file system is the last one once."""
    calls = [(Path, "replace"), (Path, "unlink"), (Path, "mkdir"), (Path, "write_text"), (shutil, "rmtree")]
    old, new = {"a": "1", "b": "1", "old": "1"}, {"a": "2", "b": "2", "new": "2"}
    outcomes = set()
    for last in range(30):
        folder = tmp_path / str(last)
        (folder / "maps").mkdir(parents=True)
        for name in ("a", "maps/b", "old"):
            (folder / name).write_text("1")
        child = os.fork()
        if child == 0:
            left = [last]
            for owner, name in calls:
                _killing(owner, name, left)
            change(folder)
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        now = state(folder)
        assert now in (old, new)
        outcomes.add(("killed" if status else "done", now == new))
        if not status:
            break
        change(folder)  # goes on as if nothing had been
        assert state(folder) == new
    assert outcomes == {("killed", False), ("killed", True), ("done", True)}


def _killing(owner: object, name: str, left: list[int]) -> None:
    """Let a function end the process when it is called after `left` others."""
    call = getattr(owner, name)

    def counted(*args, **settings):
        if not left[0]:
            os._exit(9)
        left[0] -= 1
        return call(*args, **settings)

    setattr(owner, name, counted)


def test_one_change_at_a_time(tmp_path):
    fcntl = pytest.importorskip("fcntl")
    with (tmp_path / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="is being changed by another process"), change_folder(tmp_path, [], 0):
            pass
