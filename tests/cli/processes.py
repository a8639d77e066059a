"""Ways to run the command line in tests."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

Run = Callable[..., tuple[int, str, str]]


def process(*words: str, code: str | None = None, **settings: Any) -> subprocess.CompletedProcess[str]:
    start = [sys.executable, "-c", code] if code else [sys.executable, "-m", "topomerge"]
    return subprocess.run([*start, *words], capture_output=True, text=True, timeout=60, check=False, **settings)
