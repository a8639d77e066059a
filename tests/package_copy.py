"""A copy of the package's files that a test may change."""

from __future__ import annotations

import shutil
from pathlib import Path

ROOT = Path(__file__).parent.parent


def copied(folder: Path, compiled: bool = False) -> Path:
    """Copy the package's sources and data into a folder; the folder of `topomerge` in it.

    Args:
        compiled: with what Python and numba have compiled of them: a copy that is run starts in a quarter of the time.
    """
    ignored = None if compiled else shutil.ignore_patterns("__pycache__")
    for name in ("topomerge", "models", "datasets", "configs"):
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    return folder / "topomerge"


def edit(path: Path, old: str, new: str) -> None:
    """Replace a text in a file, once."""
    text = path.read_text(encoding="utf-8")
    assert old in text, f"{path}: {old}"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")


def edited_kernel(folder: Path, addition: str) -> Path:
    """A copy with an addition to the kernel that makes voxels."""
    package = copied(folder)
    kernel = package / "kernels" / "voxels.py"
    kernel.write_text(f"{kernel.read_text(encoding='utf-8')}\n{addition}\n", encoding="utf-8")
    return package
