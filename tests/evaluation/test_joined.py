"""Joined maps are judged where they truly are, and their table says what the rows say.

Cached descriptors belong to the code and the data that made them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from topomerge.datasets.simulation.floor_truth import NOT_JUDGED, OUTSIDE_ROOMS, FloorTruth, join_truths

from tests.package_copy import copied, edit
from tests.scenes_map import building
from topomerge.code_digest import compute_code_digest
from topomerge.evaluation import predict
from topomerge.evaluation.joined import tabulate
from topomerge.evaluation.predict import DescriptorCache
from topomerge.evaluation.tasks import TaskSettings
from topomerge.types import Sim3


def truth(raster: list[list[int]], anchors: np.ndarray, drift: np.ndarray, visited: list[bool]) -> FloorTruth:
    none = np.zeros((0, 5))
    return FloorTruth(
        np.array([raster]), np.zeros(2), np.array(visited), np.zeros(1), np.full(1, 2.5), none, np.zeros((0, 2), int), np.eye(4),
        anchors, drift, np.array(True),
    )  # fmt: skip


def test_places_of_a_joined_map_go_back_by_the_drift_that_merging_left():
    pose = Sim3(0.5, (3.0, 1.0, 0.0))
    a = truth([[0, NOT_JUDGED]], np.array([[0.0, 0, 1]]), np.array([[0.1, 0, 0]]), [True, False])
    b = truth([[NOT_JUDGED, 1]], np.array([[5.0, 0, 1]]), np.array([[0, 0.2, 0]]), [False, True])
    joined = join_truths(a, b, pose, (lambda p: p, lambda p: pose.apply(p) + (0.05, 0, 0)))
    assert joined.raster.tolist() == [[[0, 1]]] and joined.visited.tolist() == [True, True]
    assert np.allclose(joined.transform_to_building(np.array([[0.3, 0.1, 1.0]])), [[0.4, 0.1, 1.0]])
    there = pose.apply(np.array([[5.0, 0, 1]])) + (0.05, 0, 0)
    assert np.allclose(joined.transform_to_building(there), pose.apply(np.array([[5.0, 0.2, 1]])))
    first = replace(a, raster=np.array([[[OUTSIDE_ROOMS, NOT_JUDGED]]]))
    assert join_truths(first, b, pose, (lambda p: p, pose.apply)).raster.tolist() == [[[OUTSIDE_ROOMS, 1]]]


def row(name: str, iou: float, doubled: float) -> dict[str, object]:
    whole = {"iou": iou, "doors": 0.9, "doubled": doubled, "rooms": 9, "seconds": 1.0}
    single = {"iou": 0.9, "doors": 0.8}
    return {"name": name, "a": single, "b": {"iou": 0.8, "doors": float("nan")}, "rigid": {**whole, "iou": 0.8}, "bent": whole}


def test_the_table_has_a_line_for_each_way():
    text = tabulate([row("one", 0.95, 0.01), row("two", 0.85, 0.03)], TaskSettings())["joined"]
    rigid, bent = text.splitlines()[4:]
    assert rigid.split("|")[3:6] == [" 0.900 ", " 0.800 ", " 0 % "]
    assert bent.split("|")[4:6] == [" 0.900 ", " 50 % "] and bent.split("|")[8:10] == [" 2.0 % ", " 50 % "]


def other_scale(package: Path) -> None:
    with (package / "embedding" / "engineered.json").open("ab") as file:
        file.write(b" ")


def other_kernel(package: Path) -> None:
    edit(package / "kernels" / "voxels.py", "from __future__", "ANOTHER = 1\nfrom __future__")


def other_network(package: Path) -> None:
    edit(package / "embedding" / "network.py", "from __future__", "ANOTHER = 1\nfrom __future__")


@pytest.mark.parametrize(("change", "files"), [(other_scale, 2), (other_kernel, 2), (other_network, 1)])
def test_descriptors_of_other_code_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, change: Callable[[Path], None], files: int
) -> None:
    package = copied(tmp_path / "package")
    change(package)
    source = tmp_path / "a.tmap"
    source.write_bytes(b"the map")
    shelf = DescriptorCache(tmp_path / "shelf", source)
    first, _ = shelf.get_rows(building(), {"name": "engineered"}, 0)
    monkeypatch.setattr(predict, "compute_code_digest", partial(compute_code_digest, package=package))
    again, _ = shelf.get_rows(building(), {"name": "engineered"}, 0)
    assert len(list(shelf.folder.iterdir())) == files and (first == again).all()
