"""Compiled inner loops, kept between runs where that is possible: beside the source or in the user's cache folder.

Where neither can be written (an installation by somebody else, a container without a home), numba would refuse to import them
at all: then they are kept in a folder below the system's temporary one.
"""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from pathlib import Path

from numba import config, njit

if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:  # TBB is there with Open3D only, and may then hang when Python ends
    config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # type: ignore[attr-defined]


def _probe() -> None: ...


def _create_private_folder() -> Path:
    """A folder that nobody else can write to: what is kept there is code.

    Raises:
        OSError: there is none.
    """
    folder = Path(tempfile.gettempdir(), f"topomerge-{os.getuid()}")
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
        reason = "others may write to it; set NUMBA_CACHE_DIR to a folder of yours"
        raise OSError(errno.EPERM, reason, str(folder))
    return folder


try:
    njit(cache=True)(_probe)  # compiles nothing yet
except RuntimeError:  # no place to keep it
    config.CACHE_DIR = str(_create_private_folder())  # type: ignore[attr-defined]
