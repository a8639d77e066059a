"""Writers that results save themselves with, by kind: reports stand above the results, so the face of the package puts their
writers here (`topomerge/__init__.py`), and neither imports the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

WRITERS: dict[str, Callable[[Any, Any], None]] = {}  # "merge": (MergeResult, folder)
