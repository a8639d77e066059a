"""What is worked out from cached files, cached as well: hypotheses of pairs, features of doors; an item is a file, or two.

A step is a function of paths that gives arrays. Its files are named by a hash of its sources' names, of its options and of the
digest of the code and data that make them, so that none outlives a change.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.core.builder import Report, Row, Say, Sharing, build_set, make_item

from topomerge.code_digest import code_digest
from topomerge.io import archive
from topomerge.io.listing import plain
from topomerge.types import Array

LONGEST_STEP = 900.0  # s an item
Step = Callable[..., Mapping[str, Array]]  # of paths and options


@dataclass(frozen=True)
class DerivedItem:
    """Everything that the bytes of one file depend on."""

    step: str
    sources: tuple[str, ...]
    options: str
    code: str

    @property
    def name(self) -> str:
        """A hash of it."""
        return hashlib.sha256(json.dumps(plain(vars(self)), sort_keys=True).encode()).hexdigest()[:24]


def make_derived(item: DerivedItem, given: tuple[Step, Sequence[Path]], folder: str) -> Row:
    """Make one file of a step."""
    step, paths = given
    options = json.loads(item.options)

    def make() -> dict[str, Array]:
        arrays = dict(step(*paths, **options))
        about = json.dumps({"file": f"{item.name}.npz", "sources": list(item.sources)}, sort_keys=True)
        return {**arrays, "about": np.frombuffer(about.encode(), np.uint8)}

    return make_item(item.name, folder, make, LONGEST_STEP)


def derive(
    name: str, step: Step, sources: Sequence[Sequence[Path]], sharing: Sharing, options: Mapping[str, Any] | None = None,
    say: Say = lambda text: None,
) -> tuple[list[Path], Report]:  # fmt: skip
    """Files of a step, made where they are missing, in the order of their sources; those that were refused are left out.

    Args:
        name: of the manifest and of the folder.
        step: a function of a module, which other processes can import.
        sources: the paths that each file is made from, which are named by hashes themselves.
        options: more arguments, as JSON has them.
    """
    cache = Path(sharing.cache).resolve()
    folder, code = cache / name, code_digest(step.__module__)
    text = json.dumps(plain(dict(options or {})), sort_keys=True)
    items = [DerivedItem(step.__name__, tuple(p.stem for p in paths), text, code) for paths in sources]
    tasks = [(item, (step, list(paths)), str(folder)) for item, paths in zip(items, sources, strict=True)]
    report = build_set(cache / f"{name}.jsonl", tasks, make_derived, sharing, say, unit=name)
    return [path for item in items if (path := folder / f"{item.name}.npz").exists()], report


def read_sources(path: Path) -> list[str]:
    """Stems of the names of the files that a file was made from."""
    about: dict[str, Any] = json.loads(archive.read(path, "cached item", only=["about"])["about"].tobytes())
    sources: list[str] = about["sources"]
    return sources


def read_derived(path: Path) -> dict[str, Array]:
    """The arrays of a file, but for what it says about itself."""
    arrays = archive.read(path, "cached item")
    del arrays["about"]
    return arrays
