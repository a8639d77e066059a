"""STEP files (ISO 10303-21), which IFC models are: what refers to what, checked before a native library follows it.

The library calls itself along the references and ends the process where they run in a circle or too deep.
"""

from __future__ import annotations

import re
from array import array
from pathlib import Path

import numpy as np

from topomerge.io.piece import damaged
from topomerge.types import Array

NOT_SAID = re.compile(rb"'[^']*'|/\*.*?\*/", re.DOTALL)  # strings and comments
STATEMENT = re.compile(rb"#(\d+)\s*=([^;]*)")
ENTITY_REFERENCE = re.compile(rb"#(\d+)")
DEEPEST = 250  # references one behind the other; models of buildings have 15


def check_references(path: Path) -> None:
    """Refuse a file whose entities refer to themselves, directly or around, or too deep.

    Raises:
        InputError: it does.
    """
    owners, targets, count = references(path.read_bytes())
    waiting = np.bincount(owners, minlength=count)
    order = np.argsort(targets, kind="stable")
    ends = np.searchsorted(targets[order], np.arange(count + 1))
    free, left = np.flatnonzero(waiting == 0), count
    for _ in range(DEEPEST):  # in each round goes what refers to nothing that is left
        left -= len(free)
        if not len(free):
            break
        edges = np.concatenate([order[ends[i] : ends[i + 1]] for i in free])
        freed, times = np.unique(owners[edges], return_counts=True)
        waiting[freed] -= times
        free = freed[waiting[freed] == 0]
    if left:
        raise damaged(path, "an IFC model", f"{left:,} entities refer to themselves, or are nested deeper than {DEEPEST}")


def references(text: bytes) -> tuple[Array, Array, int]:
    """(m,) rows that refer, (m,) rows that they refer to, and the number of entities; what does not exist is left out."""
    text = NOT_SAID.sub(b"", text)
    statements = [(match[1], ENTITY_REFERENCE.findall(match[2])) for match in STATEMENT.finditer(text)]
    row = {name: i for i, (name, _) in enumerate(statements)}
    owners, targets = array("q"), array("q")
    for name, others in statements:
        existing = [row[other] for other in others if other in row]
        owners.extend([row[name]] * len(existing))
        targets.extend(existing)
    return np.array(owners, np.int64), np.array(targets, np.int64), len(statements)
