"""Counts that do not depend on the machine: how often points are read, networks run, modules are imported. Signatures that are
compiled are counted in `tests/kernels/test_ahead.py`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.cli.processes import process
from tests.scenes import Scene, two_rooms
from topomerge.cli.main import main
from topomerge.extraction import cleaning, walls
from topomerge.extraction.convolution import Kernel, convolve
from topomerge.extraction.elevations.doorways import classify_places
from topomerge.extraction.elevations.elevation import WALL_NETWORK_FILE, Elevations
from topomerge.extraction.extract import JOINED_LOOKS, extract
from topomerge.extraction.plans.plan_network import GRID_NETWORK_FILE, LOOKS, PLAN_NETWORK_FILE
from topomerge.fusion import fuse
from topomerge.io import piece, ply
from topomerge.io.points import read_chunks
from topomerge.io.rooms_ply import assign_room_colours
from topomerge.kernels import occupied_cells
from topomerge.networks.network import Network
from topomerge.types import PointCloud, Sim3, VoxelGrid

MOST_MODULES = {
    "import topomerge": 120,
    "import topomerge.io.points": 290,
    "import topomerge.kernels": 620,
    "import topomerge.extraction.extract": 1020,
}


def write_cloud(path: Path, points: np.ndarray) -> None:
    from plyfile import PlyData, PlyElement

    rows = np.zeros(len(points), [(name, "f4") for name in "xyz"])
    for k, name in enumerate("xyz"):
        rows[name] = points[:, k]
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Points that were read of each file."""
    count: Counter[str] = Counter()

    def note(path: Path, options: Any) -> Any:
        for found in before(path, options):
            count[path.name] += len(found.points)
            yield found

    before = ply.read
    monkeypatch.setattr(ply, "read", note)
    return count


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Runs of each network."""
    count: Counter[str] = Counter()

    def note(self: Network, *words: Any, **inputs: Any) -> Any:
        count[self.path.name] += 1
        return before(self, *words, **inputs)

    before = Network.__call__
    monkeypatch.setattr(Network, "__call__", note)
    return count


def test_each_point_is_read_once(tmp_path: Path, read: Counter[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ply, "BLOCK_POINTS", 10_000)
    points = two_rooms().points()
    write_cloud(tmp_path / "a.ply", points)
    extract(read_chunks(tmp_path / "a.ply", chunk=15_000))
    assert read == {"a.ply": len(points)} and len(points) > 3 * ply.BLOCK_POINTS and piece.BLOCK_POINTS > ply.BLOCK_POINTS
    write_cloud(tmp_path / "b.ply", points[::2] + np.float32(0.3))
    read.clear()
    words = [str(tmp_path / name) for name in ("a.ply", "b.ply")]
    assert main(["merge", *words, "-o", str(tmp_path / "merged"), "--jobs", "1", "-q", "--force"]) in (0, 2)
    assert read == {"a.ply": len(points), "b.ply": len(points[::2])}


def test_each_point_is_laid_into_cells_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells of 10 cm are made of those of 5 cm that walls are looked at in."""
    laid: Counter[float] = Counter()
    before = occupied_cells._count_in_bricks

    def note(points: np.ndarray, shift: np.ndarray, edge: float, *words: Any) -> Any:
        laid[edge] += len(points)
        return before(points, shift, edge, *words)

    monkeypatch.setattr(occupied_cells, "_count_in_bricks", note)
    points = two_rooms().points().astype(np.float32)
    extract(PointCloud(part) for part in np.array_split(points, 3))
    assert laid == {0.05: len(points)}


def test_what_is_asked_for_again_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neighbours of the occupied cells, the floor proper of a volume, and the colours of rooms."""
    counted: list[int] = []
    found: list[tuple[int, ...]] = []

    def count(grid: VoxelGrid, kernel: Kernel) -> np.ndarray:
        counted.append(len(grid))
        return convolve(grid, kernel)

    def find(self: VoxelGrid, cells: np.ndarray) -> np.ndarray:
        if len(cells) == len(self) and (cells == self.cells - (0, 0, 1)).all():
            found.append((len(cells), *self.cells.sum(axis=0).tolist()))
        return contains(self, cells)

    contains = VoxelGrid.contains
    monkeypatch.setattr(cleaning, "convolve", count)
    monkeypatch.setattr(VoxelGrid, "contains", find)
    map = extract(two_rooms().points().astype(np.float32))
    assert len(counted) == 1
    assert 0 < len(found) == len(set(found))
    assert assign_room_colours(map) is assign_room_colours(map)


def test_networks_run_once_a_look_and_once_a_strip(runs: Counter[str], monkeypatch: pytest.MonkeyPatch) -> None:
    strips: list[int] = []

    def note(elevations: Elevations) -> np.ndarray:
        strips.append(len(elevations.faces))
        return classify_places(elevations)

    monkeypatch.setattr(walls, "classify_places", note)
    extract(two_rooms().points().astype(np.float32))
    assert len(strips) == 1 and strips[0] > 5
    assert runs == {PLAN_NETWORK_FILE: LOOKS, WALL_NETWORK_FILE: strips[0]}


def test_a_merge_extracts_each_cloud_once_and_looks_once_at_what_is_joined(
    runs: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two halves of a hall: their border is looked at, once, and no wall is read again."""
    points = Scene().shell(0, 0, 12, 6).points().astype(np.float32)
    halves = [extract(points[side], name="half") for side in (points[:, 0] < 6.1, points[:, 0] > 5.9)]
    assert runs == {GRID_NETWORK_FILE: len(halves) * LOOKS}
    runs.clear()
    monkeypatch.setattr(fuse, "extract", lambda *_: pytest.fail("extracted again"))
    fuse.fuse(halves, [(0, Sim3()), (1, Sim3())])
    assert sum(runs.values()) == JOINED_LOOKS == 1


@pytest.mark.parametrize("code", MOST_MODULES)
def test_few_modules_are_imported(code: str) -> None:
    done = process(code=f"{code}; import sys; print(len(sys.modules))")
    assert done.returncode == 0 and int(done.stdout) <= MOST_MODULES[code], done.stderr
