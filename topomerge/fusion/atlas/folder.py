"""A folder that changes as a whole: whatever moment a change is killed at, the folder is as before or as after.

A change is written into `.new`, which becomes `.next` by one renaming: that is the moment at which it counts. Then its files are
moved to their places; who finds a `.next` finishes the moving first.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from topomerge.errors import InputError

NEW, NEXT, LOCK, GONE = ".new", ".next", ".lock", "gone.json"


@contextmanager
def changing(folder: Path, gone: list[str]) -> Iterator[Path]:
    """Yield an empty folder for files that replace those of the same names if all goes well; on any error nothing changes.

    Args:
        folder: created if it is not there.
        gone: names of files that shall be deleted; read at the end.

    Raises:
        InputError: the folder can't be written, or another change is under way.
    """
    created = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder):
            _finish(folder)
            shutil.rmtree(folder / NEW, ignore_errors=True)
            (folder / NEW).mkdir()
            try:
                yield folder / NEW
                (folder / NEW / GONE).write_text(json.dumps(gone), encoding="utf-8")
                (folder / NEW).replace(folder / NEXT)
            except BaseException:
                shutil.rmtree(folder / NEW, ignore_errors=True)
                raise
            _finish(folder)
    except OSError as error:
        raise InputError(f"{folder}: can't be written ({error.strerror or error}); give the name of a folder") from error
    finally:
        if created and folder.is_dir() and {p.name for p in folder.iterdir()} <= {NEW, LOCK}:
            shutil.rmtree(folder, ignore_errors=True)


def finished(folder: Path) -> None:
    """Finish a change that was interrupted after it began to count, if there is one.

    Raises:
        InputError: it can't be finished, or it is under way.
    """
    if (folder / NEXT).is_dir():
        with _locked(folder):
            _finish(folder)


def _inside(folder: Path, name: str) -> Path:
    """A file of the atlas; an atlas of a stranger must not reach for files elsewhere, by its names or by links."""
    path = folder / name
    if not path.parent.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"{name[:100]!r} lies elsewhere")
    return path


def _finish(folder: Path) -> None:
    """Move the files of a change that counts to their places, and delete those that it has no more."""
    source = folder / NEXT
    if not source.is_dir():
        return
    try:
        listed = source / GONE
        gone: Sequence[str] = json.loads(listed.read_text(encoding="utf-8")) if listed.exists() else []
        for path in sorted(p for p in source.rglob("*") if p.is_file() and p != listed):
            target = _inside(folder, str(path.relative_to(source)))
            target.parent.mkdir(parents=True, exist_ok=True)
            path.replace(target)
        for name in gone:
            _inside(folder, name).unlink(missing_ok=True)
        shutil.rmtree(source)
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{folder}: a change that was interrupted can't be finished ({error}); is it writable?") from error


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """One change at a time; the system frees the lock of a process that was killed."""
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield
        return
    with (folder / LOCK).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"{folder}: is being changed by another process; wait for it") from error
        yield


def link_or_copy(source: Path, target: Path) -> None:
    """The same file under another name."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
