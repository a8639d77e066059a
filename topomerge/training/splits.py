"""Which buildings train, and which are watched or left out: no physical building is on both sides."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.datasets.core.physical import physical_building
from topomerge.errors import InputError
from topomerge.io import archive
from topomerge.training.packed import GraphPair
from topomerge.types import Array


def hold_out(pairs: Sequence[GraphPair]) -> tuple[list[GraphPair], list[GraphPair]]:
    """A tenth of the pairs, by whole physical buildings in the order of a hash of their names, is kept from training; at least
    one of them has rooms that match.

    Raises:
        InputError: no pair has any, or all that have are of one building.
    """
    buildings = [pair.buildings[0] for pair in pairs]
    held: set[str] = set()
    for name in sorted(set(buildings), key=lambda name: hashlib.sha256(name.encode()).digest()):
        watched = [p for p, of in zip(pairs, buildings, strict=True) if of in held]
        if 10 * len(watched) >= len(pairs) and any(len(p.matches) for p in watched):
            break
        held.add(name)
    parts = tuple([p for p, of in zip(pairs, buildings, strict=True) if (of in held) is which] for which in (False, True))
    if not all(any(len(p.matches) for p in part) for part in parts):
        raise InputError("too few pairs whose rooms match, to train on some buildings and watch others; make more of them")
    return parts[0], parts[1]


def number_buildings(names: Sequence[str]) -> Array:
    """(n,) number of each building, in the order in which they first come."""
    numbers: dict[str, int] = {}
    return np.array([numbers.setdefault(name, len(numbers)) for name in names], np.int64)


def mark_watched(buildings: Sequence[str], every: int) -> Array:
    """(n,) bool: the scans of every n-th building are watched."""
    return np.asarray(number_buildings(buildings) % every == 0)


def read_scan_building(path: Path) -> str:
    """The physical building of a cached scan (`pairs.scan_items`); each procedural one has a seed of its own.

    Raises:
        InputError: the file is damaged.
    """
    row = json.loads(archive.read(path, "cached scan", only=["about"])["about"].tobytes())
    return physical_building(row["source"], row["plan"]) if row["plan"] else f"procedural/{row['seed']}"


def name_building(row: Mapping[str, Any]) -> str:
    """The physical building of what is known about a pair of maps; of two buildings that of the first map."""
    return physical_building(str(row.get("source", "procedural")), str(row["building"]))
