"""Files that are either whole or absent: written beside their place, then renamed."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from topomerge.errors import InputError


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
        # A folder of its own, so that what a kill leaves behind is nowhere found under the file's suffix.
        folder = Path(tempfile.mkdtemp(prefix=f".{path.stem[:40]}.", suffix=".part", dir=path.parent))
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
