"""Compiled functions are kept somewhere, wherever the program is installed and whoever runs it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

NOWHERE = """
import numba.core.caching as caching
caching.CacheImpl._locator_classes = [caching.UserProvidedCacheLocator]  # neither beside the source nor in a home
import numpy as np
from topomerge.kernels import voxels
print(voxels.encode(np.array([[1, 1, 1]])))
"""


def run(folder: Path) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "TMPDIR": str(folder), "NUMBA_CACHE_DIR": "", "TOPOMERGE_COMPILE_AHEAD": "0"}
    return subprocess.run([sys.executable, "-c", NOWHERE], capture_output=True, text=True, env=env, timeout=120, check=False)


@pytest.mark.longer
def test_without_a_home_in_a_private_folder(tmp_path: Path) -> None:
    done = run(tmp_path)
    assert (done.returncode, done.stdout) == (0, "[7]\n"), done.stderr
    (cache,) = tmp_path.iterdir()
    assert cache.stat().st_mode & 0o777 == 0o700 and list(cache.rglob("*.nbi"))


@pytest.mark.longer
@pytest.mark.parametrize("kind", ["open", "link"])
def test_never_in_a_folder_of_others(tmp_path: Path, kind: str) -> None:
    folder, place = tmp_path / f"topomerge-{os.getuid()}", tmp_path / "elsewhere"
    place.mkdir(mode=0o700)
    if kind == "open":
        folder.mkdir()
        folder.chmod(0o777)
    else:
        folder.symlink_to(place)
    done = run(tmp_path)
    assert done.returncode == 1 and "set NUMBA_CACHE_DIR" in done.stderr
    assert not any(place.iterdir()) and (kind == "link" or not any(folder.iterdir()))
