"""A folder that changes as a whole: whatever moment a change is killed at, the folder is as before or as after.

A change is written into `.new`, which becomes `.next` by one renaming: that is the moment at which it counts. Then its files are
moved to their places; who finds a `.next` finishes the moving first. Changes of several processes come one after the other: the
lock is the system's, which frees that of a killed process; where a file system has none, it is a file that names its owner.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from topomerge.errors import InputError

NEW, NEXT, LOCK, GONE = ".new", ".next", ".lock", "gone.json"
LOCK_POLL = 0.1  # s between two looks at a lock that another process holds
log = logging.getLogger(__name__)


@contextmanager
def changing(folder: Path, gone: list[str], patience: float | None = None) -> Iterator[Path]:
    """Yield an empty folder for files that replace those of the same names if all goes well; on any error nothing changes.

    No other process changes the folder meanwhile: what is read of it within stays so.

    Args:
        folder: created if it is not there.
        gone: names of files that shall be deleted; read at the end.
        patience: s to wait at most for the changes of other processes to end; None: as long as they take.

    Raises:
        InputError: the folder can't be written, or another change takes too long.
    """
    created = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with _locked(folder, patience):
            try:
                _finish(folder)
                shutil.rmtree(folder / NEW, ignore_errors=True)
                (folder / NEW).mkdir()
                yield folder / NEW
                (folder / NEW / GONE).write_text(json.dumps(gone), encoding="utf-8")
                (folder / NEW).replace(folder / NEXT)
            except BaseException:
                shutil.rmtree(folder / NEW, ignore_errors=True)
                _leave_as_found(folder, created)
                raise
            _finish(folder)
    except OSError as error:
        _leave_as_found(folder, created)
        reason = error.strerror or error
        raise InputError(f"{folder}: can't be written ({reason}); make room there, or give another folder") from error


def _leave_as_found(folder: Path, created: bool) -> None:
    """Take away the lock of a folder that did not become an atlas, and the folder if it is new."""
    with suppress(OSError):  # what stays is in nobody's way
        if {p.name for p in folder.iterdir()} <= {LOCK}:
            (folder / LOCK).unlink(missing_ok=True)
            if created:
                folder.rmdir()


def finished(folder: Path) -> None:
    """Finish a change that was interrupted after it began to count, if there is one.

    Raises:
        InputError: it can't be finished.
    """
    if (folder / NEXT).is_dir():
        try:
            with _locked(folder, None):
                _finish(folder)
        except OSError as error:
            raise InputError(f"{folder}: can't be locked ({error.strerror or error}); is it writable?") from error


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
def _locked(folder: Path, patience: float | None) -> Iterator[None]:
    """One change at a time; the others wait."""
    lock, waits = FileLock(folder / LOCK, poll_interval=LOCK_POLL), False
    while not lock.is_locked:
        try:
            lock.acquire(timeout=0 if not waits else -1 if patience is None else patience)
        except FileNotFoundError:  # who made the folder gave up, and took it away
            folder.mkdir(parents=True, exist_ok=True)
        except Timeout:
            if waits or patience == 0:
                raise InputError(f"{folder}: is being changed by another process; wait for it") from None
            log.warning("%s: is being changed by another process; waiting for it", folder)
            waits = True
    try:
        yield
    finally:
        lock.release()


def link_or_copy(source: Path, target: Path) -> None:
    """The same file under another name."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
