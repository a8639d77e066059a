"""A building model of the data folder, read and extracted once: three files of tests look at it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from topomerge.extraction.extract import extract
from topomerge.io import read_points
from topomerge.types import PointCloud, TopometricMap

SPACING = 0.1  # m


@cache
def duplex(data: Path) -> PointCloud:
    """Two flats of two storeys."""
    return read_points(data / "ifc_buildings" / "duplex.ifc", spacing=SPACING)


@cache
def duplex_map(data: Path) -> TopometricMap:
    """Its map."""
    return extract(duplex(data))
