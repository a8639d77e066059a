"""Fixtures for all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


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
