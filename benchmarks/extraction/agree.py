"""How alike two maps of one place cut it into rooms: two sessions, or one scan turned, thinned and so on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.simulation.floor_truth import TRUTH_CELL, Truth

from topomerge.io.atomic import replacing
from topomerge.metrics import consistency
from topomerge.types import Array

LEAST_COMMON_AREA = 1.0  # m2 of a room, on what both saw
REFERENCE = "reference"
Row = dict[str, Any]


def keep(path: Path, columns: Array, truth: Truth) -> None:
    """Write what a map says, and where the scan saw rooms that were visited, in the building's frame."""
    path.parent.mkdir(parents=True, exist_ok=True)
    visited = (truth.raster >= 0) & np.append(truth.visited, False)[truth.raster]
    with replacing(path) as beside, open(beside, "wb") as file:
        np.savez_compressed(file, columns=columns.astype(np.int16), visited=visited)


def agreement(a: Path, b: Path) -> tuple[float, float]:
    """Consistency of two maps on the floor of the rooms that both visited and saw, of the rooms assigned to each other and of
    all; 0 where one of them failed."""
    if not a.exists() or not b.exists():
        return 0.0, 0.0
    with np.load(a, allow_pickle=False) as first, np.load(b, allow_pickle=False) as second:
        both = first["visited"] & second["visited"]
        labels, least = (first["columns"][both], second["columns"][both]), round(LEAST_COMMON_AREA / TRUTH_CELL**2)
        return consistency(*labels, least, every=False), consistency(*labels, least)


def with_agreement(rows: list[Row], out: Path) -> list[Row]:
    """The rows, with `agreement` and `agreement_all` of those that have a partner.

    It is the reference of the same scan, or the first session.
    """
    partner: dict[tuple[Any, ...], Row] = {}
    for row in rows:
        if row["set"] == REFERENCE:
            partner[row["scan"], row["preset"]] = row
        elif row["day"] == 1:
            partner[row["set"], row["place"], row["preset"]] = row
    done = []
    for row in rows:
        key = (row["set"], row["place"], row["preset"]) if row["day"] == 2 else (row["scan"], row["preset"])
        other = partner.get(key)
        alike = None
        if other is not None and other is not row and not row.get("missing"):
            alike = agreement(out / "said" / f"{other['key']}.npz", out / "said" / f"{row['key']}.npz")
        done.append(row if alike is None else {**row, "agreement": round(alike[0], 4), "agreement_all": round(alike[1], 4)})
    return done
