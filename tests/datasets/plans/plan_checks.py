"""What the tests of plans ask of a plan, and how each format is written."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shapely
from topomerge.datasets.core.building import Plan
from topomerge.datasets.plans.floorplans import Refusal, iter_plans, read_plans

from tests.datasets.plans import plan_files as write
from topomerge.errors import InputError


def areas(plan: Plan) -> list[float]:
    return [shapely.Polygon(room.polygon).area for room in plan.rooms]


def door(plan: Plan) -> tuple[list[float], float]:
    """Middle and width of the only door."""
    (opening,) = (o for o in plan.openings if o.kind in ("door", "opening"))
    start, end = np.array(opening.start), np.array(opening.end)
    return ((start + end) / 2).tolist(), float(np.hypot(*(end - start)))


def reason(path: Path) -> str:
    """Why the only plan of a file is refused, told the same way by both verbs."""
    ((_, result),) = iter_plans(path)
    assert isinstance(result, Refusal), result
    with pytest.raises(InputError) as caught:
        read_plans(path)
    assert "\n" not in str(caught.value) and str(caught.value).endswith(result.reason)
    return result.reason


def pack(path: Path, members: dict[str, bytes]) -> Path:
    with tarfile.open(path, "w:xz") as archive:
        for name, data in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    return path


MAKERS: dict[str, Callable[[Path], Path]] = {
    "r2v": lambda folder: write.r2v(folder / "a.txt"),
    "campus": lambda folder: write.campus(folder / "a.xml"),
    "rmf": lambda folder: write.rmf(folder / "a.building.yaml"),
    "mall": lambda folder: write.mall(folder / "F1"),
    "amrl": lambda folder: write.amrl(folder / "a.vectormap.json"),
    "bwi": lambda folder: write.bwi(folder / "1"),
    "ipa": write.ipa,
    "valetudo": write.valetudo,
}
