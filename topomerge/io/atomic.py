"""Files that are either whole or absent: written beside their place, then renamed."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from topomerge.errors import InputError

PART_SUFFIX = ".part"  # of the folders in which files are written
PART_NAME = re.compile(r"\.([0-9a-f]{8})-(\d+)\.[^.]*\.part$")  # machine and process of the one that writes


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path` with the same name; rename it to `path` on success, delete it on any error.

    A link is followed: what it points to is replaced.

    Raises:
        InputError: the folder does not exist or can't be written, or `path` is no regular file.
    """
    path = Path(path)
    if path.is_symlink():
        path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: is no file that could be replaced; give the name of a file")
    try:
        _clear_stale(path.parent)
        # A folder of its own, so that what a kill leaves behind is nowhere found under the file's suffix.
        prefix = f".{path.stem[:40]}.{_machine()}-{os.getpid()}."
        folder = Path(tempfile.mkdtemp(prefix=prefix, suffix=PART_SUFFIX, dir=path.parent))
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: can't be written ({reason}); give a folder that exists and is yours") from error
    beside = folder / path.name
    try:
        beside.touch()
        yield beside
        umask = os.umask(0)
        os.umask(umask)
        beside.chmod(0o666 & ~umask)
        try:
            beside.replace(path)
        except OSError as error:
            raise InputError(f"{path}: can't be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@cache
def _machine() -> str:
    """A short name of the machine, or the container, whose numbers of processes those of this process are."""
    space = Path("/proc/self/ns/pid")
    numbers = os.readlink(space) if os.path.lexists(space) else ""
    return hashlib.sha256(f"{platform.node()} {numbers}".encode()).hexdigest()[:8]


@cache
def _clear_stale(folder: Path) -> None:
    """Delete, once a process, what killed processes of this machine left in a folder."""
    if os.name != "posix":  # elsewhere a signal can't ask for a process
        return
    for left in folder.glob(f".*{PART_SUFFIX}"):
        owner = PART_NAME.search(left.name)
        if owner is not None and owner[1] == _machine() and not _is_running(int(owner[2])):
            shutil.rmtree(left, ignore_errors=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
