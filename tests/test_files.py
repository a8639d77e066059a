"""Files that are written are whole or absent, and only files are replaced.

Names of the package's face that were renamed are still importable.
"""

from __future__ import annotations

import os

import pytest

import topomerge
from topomerge.archive import replace_on_success
from topomerge.errors import InputError


def test_whole_or_absent(tmp_path):
    target = tmp_path / "a.tmap"

    def killed() -> None:
        with replace_on_success(target) as beside:
            beside.write_text("half")
            assert list(tmp_path.glob("*.tmap")) == []  # what a kill would leave is not taken for a map
            raise RuntimeError

    with pytest.raises(RuntimeError):
        killed()
    assert list(tmp_path.iterdir()) == []
    with replace_on_success(target) as beside:
        beside.write_text("whole")
    assert [p.name for p in tmp_path.iterdir()] == ["a.tmap"] and target.read_text() == "whole"


def test_permissions_stay_and_what_is_protected_too(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    path.chmod(0o440)
    with pytest.raises(InputError, match="is write-protected; make it writable"), replace_on_success(path):
        pass
    assert path.read_text() == "old"
    path.chmod(0o640)
    with replace_on_success(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "new" and path.stat().st_mode & 0o777 == 0o640


def test_a_link_is_followed(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a.txt").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "real" / "a.txt")
    with replace_on_success(tmp_path / "link") as beside:
        beside.write_text("new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real" / "a.txt").read_text() == "new"


def test_what_is_no_file_is_left_alone(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, os.devnull):
        with pytest.raises(InputError, match="no file that could be replaced"), replace_on_success(path):
            pass
    with pytest.raises(InputError, match="folder that exists"), replace_on_success(tmp_path / "no" / "a"):
        pass


@pytest.mark.parametrize("old", sorted(topomerge._RENAMED))
def test_an_old_name_gives_what_the_new_one_gives(old):
    assert getattr(topomerge, old) is getattr(topomerge, topomerge._RENAMED[old])
    assert old not in topomerge.__all__


def test_a_name_that_never_was_is_refused():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        topomerge.nothing  # noqa: B018
