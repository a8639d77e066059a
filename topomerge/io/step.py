"""STEP files (ISO 10303-21), which IFC models are: what refers to what, checked before a native library follows it.

The library calls itself along the references and ends the process where they run in a circle or too deep.
"""

from __future__ import annotations

import re
from array import array
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from topomerge.io.piece import damaged
from topomerge.types import Array

NOT_SAID = re.compile(rb"'[^']*'|/\*.*?\*/", re.DOTALL)  # strings and comments
STATEMENT = re.compile(rb"#(\d+)\s*=\s*([^;]*)")
ENTITY_REFERENCE = re.compile(rb"#(\d+)")
DEEPEST = 5000  # references one behind the other; models of buildings have 15
# The two sides of a wall name each other (CorrespondingBoundary): the schema's one circle, which no geometry follows.
PAIRED = re.compile(rb"IFCRELSPACEBOUNDARY2NDLEVEL\s*\(", re.IGNORECASE)


def check_references(path: Path) -> None:
    """Refuse a file whose entities refer to themselves, directly or around, or too deep.

    Raises:
        InputError: it does.
    """
    owners, targets, count = references(path.read_bytes())
    graph = csr_array((np.ones(len(owners), np.int8), (owners, targets)), shape=(count, count))
    _, circle = connected_components(graph, directed=True, connection="strong")
    in_circle = np.bincount(circle)[circle] > 1 if count else np.zeros(0, bool)
    in_circle[owners[owners == targets]] = True
    if in_circle.any():
        raise damaged(path, "an IFC model", f"{in_circle.sum():,} entities refer to themselves, directly or in a circle")
    deeper = _deeper(owners, targets, count)
    if deeper:
        raise damaged(path, "an IFC model", f"{deeper:,} entities are nested deeper than {DEEPEST:,}")


def _deeper(owners: Array, targets: Array, count: int) -> int:
    """Number of entities with more than DEEPEST references one behind the other below them."""
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
    return left


def references(text: bytes) -> tuple[Array, Array, int]:
    """(m,) rows that refer, (m,) rows that they refer to, and the number of entities.

    What does not exist is left out, and what boundaries of spaces say of each other.
    """
    text = NOT_SAID.sub(b"", text)
    statements = [(match[1], match[2]) for match in STATEMENT.finditer(text)]
    row = {name: i for i, (name, _) in enumerate(statements)}
    paired = {name for name, said in statements if PAIRED.match(said)}
    owners, targets = array("q"), array("q")
    for name, said in statements:
        left_out = paired if name in paired else ()
        existing = [row[other] for other in ENTITY_REFERENCE.findall(said) if other in row and other not in left_out]
        owners.extend([row[name]] * len(existing))
        targets.extend(existing)
    return np.array(owners, np.int64), np.array(targets, np.int64), len(statements)
