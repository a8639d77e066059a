"""WiFi of five storeys of one mall (location-competition/indoor-location-competition-20): for development, not for evaluation.

People walked with phones between surveyed way points; places of scans are good to 1 or 2 m. Storeys F1 to F4 share a frame, to a
few metres; B1 has its own. Walks of one storey, parted in two sets and each set in a frame of its own, are two maps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.types import STOREY_DTYPE, Array, Landmarks, Sim3, TopometricMap, VoxelGrid, build_landmarks, move_landmarks
from topomerge.types.topometric_map import EDGE_DTYPE, ROOM_DTYPE

WIFI_FOLDER = "wifi_malls"  # within the real data
WIFI_STOREYS = ("B1", "F1", "F2", "F3", "F4")
ALIGNED = ("F1", "F2", "F3", "F4")  # lowest first, in one frame
HELD_HIGH = 1.2  # m above the floor, phone
FLOOR_CELL = 1.0  # m
FRAMES_APART = 40.0  # m


@dataclass(frozen=True, eq=False)
class WifiStorey:
    """Walks on one storey.

    Args:
        name: one of `WIFI_STOREYS`.
        landmarks: readings; `group` counts scans.
        walk: (n,) number of the walk of each scan.
        position: (n, 3) m, of scans.
    """

    name: str
    landmarks: Landmarks
    walk: Array
    position: Array

    def select_walks(self, walks: Array) -> Landmarks:
        """Return the readings of some walks."""
        return self.landmarks.select(np.isin(self.walk, walks)[self.landmarks.table["group"]])


def read_wifi_storey(folder: Path, name: str) -> WifiStorey:
    """Read a storey.

    Args:
        folder: of all real data.

    Raises:
        InputError: its file is missing or damaged.
    """
    path = folder / WIFI_FOLDER / f"site1_{name}.npz"
    try:
        with np.load(path, allow_pickle=False) as data:
            xy, walk = data["scan_xy"].astype(float), data["scan_walk"]
            scan, ap, rssi = (data[f"obs_{key}"] for key in ("scan", "ap", "rssi"))
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: can't be read ({error}); TOPOMERGE_DATA must name the folder of the real data") from error
    position = np.column_stack([xy, np.full(len(xy), HELD_HIGH)])
    landmarks = build_landmarks(
        "radio", [f"ap{k}" for k in ap], f"{WIFI_FOLDER}/{name}", position[scan], sigma=1.5, number=rssi.astype(float), group=scan
    )
    return WifiStorey(name, landmarks, walk, position)


def split_walks(storey: WifiStorey, seed: int, walks: int = 0) -> tuple[TopometricMap, TopometricMap, Sim3]:
    """Split the walks of a storey into two maps without a common frame.

    Args:
        walks: of each map; 0: half of all.

    Returns:
        Both maps, and the pose that takes the second into the first.
    """
    rng = np.random.default_rng(seed)
    order = rng.permutation(np.unique(storey.walk))
    count = walks or len(order) // 2
    frame = Sim3(float(rng.uniform(-np.pi, np.pi)), (*rng.uniform(-FRAMES_APART, FRAMES_APART, 2).tolist(), 0.0))
    a, b = storey.select_walks(order[:count]), storey.select_walks(order[count : 2 * count])
    return build_walk_map(a), build_walk_map(move_landmarks(b, frame)), frame.inverse()


def build_walk_map(landmarks: Landmarks) -> TopometricMap:
    """Build the map of walks alone: floor where somebody stood, no rooms."""
    position = landmarks.table["position"]
    low = np.floor(position.min(axis=0)) if len(position) else np.zeros(3)
    cells = np.unique(np.floor((position - low) / FLOOR_CELL).astype(np.int64), axis=0)
    grid = VoxelGrid.from_cells(cells, low, FLOOR_CELL)
    none = np.full(len(grid), -1, np.int32)
    floor = float(position[:, 2].min()) - HELD_HIGH if len(position) else 0.0
    storeys = np.array([(floor, floor + 3.0, float(len(grid)))], STOREY_DTYPE)
    map = TopometricMap(grid, none, grid, none, np.zeros(0, ROOM_DTYPE), np.zeros(0, EDGE_DTYPE), storeys)
    return replace(map, landmarks=landmarks, source=WIFI_FOLDER)
