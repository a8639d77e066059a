"""Building models against scans of them: the rays are simulated, the walls they meet are the model's own.

The scanner walks through the spaces and doors of the model, as `plans.ifc` reads them, and its rays are cast at the model's
triangles: every built element but the door leaves. The other map is the model itself, its surfaces sampled all round.
Floors that the model lacks are added to both.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from topomerge.datasets.buildings.construction import build_building
from topomerge.datasets.core.building import SURFACES, THING_DTYPE, Building
from topomerge.datasets.pairs.flat_maps import find_rooms
from topomerge.datasets.pairs.pairs import Pair, draw_frames, find_common_rooms
from topomerge.datasets.pairs.parts import compute_dice
from topomerge.datasets.plans.floorplans import Refusal, iter_plans, remove_dead_flights
from topomerge.datasets.simulation.scanner import scan_building, transform_cloud
from topomerge.datasets.simulation.walk import sample_part

from topomerge.errors import InputError
from topomerge.io.points import read_points
from topomerge.types import Array, PointCloud

MODELS = {"duplex": ("depth", 0.6), "Office_A_20110811": ("tls", 0.4)}  # sensor, and share of the rooms that it visits
IFC_LABELS = {"IfcSlab": "floor", "IfcCovering": "ceiling", "IfcStair": "stair", "IfcStairFlight": "stair", "IfcColumn": "column"}
LEFT_OUT = ("IfcDoor", "IfcFeatureElement", "IfcVirtualElement")  # doors stand open
IFC_SPACING = 0.08  # m between the points sampled on the model
UNDER_CEILING = 0.15  # m under its floor that a point may lie


def iter_pairs(folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of a pair for each of `MODELS`."""
    for name in MODELS:
        yield f"{name}-scan", partial(_load_pair, folder / f"{name}.ifc")


def _load_pair(path: Path) -> Pair:
    sensor, visits = MODELS[path.stem]
    rng = np.random.default_rng(zlib.crc32(path.stem.encode()))
    building = load_model_building(path)
    inside = [i for i, r in enumerate(building.rooms) if r.kind != "lift"]
    visited = sample_part(building, max(round(visits * len(inside)), 1), rng)
    frames = draw_frames(2, False, rng)
    a = transform_cloud(_sample_model(path, building), frames[0])
    b = scan_building(building, sensor, visited, rng, frame=frames[1])
    return Pair(
        name=f"{path.stem}-scan",
        a=a,
        b=b,
        truth=frames[0] @ frames[1].inverse(),
        shared=find_common_rooms(a, b),
        overlap=compute_dice(visited.tolist(), inside),
        sensors=("model", sensor),
        source="ifc",
        building=path.stem,
        visited=(tuple(inside), tuple(visited.tolist())),
        frames=(frames[0], frames[1]),
    )


def load_model_building(path: Path) -> Building:
    """Return the model's own triangles, with the rooms, doors and stairs of its plans, in the model's frame but for the height:
    the lowest floor is at 0.

    Raises:
        InputError: what `plans.ifc` and the reader of IFC refuse; floors of the plans that are not at the model's heights.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the folder")
    plans = [plan for _, plan in iter_plans(path) if not isinstance(plan, Refusal)]  # a roof has no rooms
    drawn = build_building(remove_dead_flights(plans), name=path.stem, kind="model")
    corners, labels = _load_triangles(path)
    corners = corners - [0.0, 0.0, find_ground(path, drawn)]
    floor = drawn.labels == SURFACES.index("floor")  # some models hold walls and ceilings only; elsewhere it lies on the slab
    corners = np.concatenate([corners, drawn.vertices[drawn.triangles[floor]]])
    labels = np.concatenate([labels, drawn.labels[floor]])
    return replace(
        drawn,
        vertices=corners.reshape(-1, 3).astype(np.float32),
        triangles=np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3),
        labels=labels,
        thing_of=np.full(len(corners), -1, np.int32),
        things=np.empty(0, THING_DTYPE),
    )


def _load_triangles(path: Path) -> tuple[Array, Array]:
    """Return (t, 3, 3) corners in metres of all that is built, and (t,) uint8 index into `SURFACES`."""
    import ifcopenshell
    from topomerge.datasets.plans.ifc import ElementSolids

    model = ifcopenshell.open(str(path))
    solids, corners, labels = ElementSolids(model), [], []
    for element in model.by_type("IfcElement"):
        triangles = None if any(element.is_a(kind) for kind in LEFT_OUT) else solids.triangulate(element)
        if triangles is not None:
            kind = next((label for name, label in IFC_LABELS.items() if element.is_a(name)), "wall")
            corners.append(triangles)
            labels.append(np.full(len(triangles), SURFACES.index(kind), np.uint8))
    if not corners:
        raise InputError(f"{path}: has no building elements with a shape; export it with its geometry")
    return np.concatenate(corners), np.concatenate(labels)


def find_ground(path: Path, building: Building) -> float:
    """Find the height of the building's lowest floor in the model, m."""
    floors = {room.name: room.floor for room in _read_model(path).rooms}
    shifts = [floors[r.name.split()[0]] - r.floor for r in building.rooms if r.name.split()[0] in floors]
    if not shifts or np.ptp(shifts) > 0.3:
        raise InputError(f"{path}: its spaces lie at other heights than its storeys; no walk can be planned in it")
    return float(np.median(shifts))


@lru_cache(maxsize=1)  # asked for thrice a pair
def _read_model(path: Path) -> PointCloud:
    return read_points(path, spacing=IFC_SPACING)


def _sample_model(path: Path, building: Building) -> PointCloud:
    """Sample points on the model, in the building's frame and with its rooms."""
    cloud = _read_model(path)
    points = cloud.points.astype(np.float64) + cloud.shift - [0.0, 0.0, find_ground(path, building)]
    labels = np.full(len(points), -1, np.int32)
    bounds = np.append(building.storeys["floor"] - UNDER_CEILING, np.inf)
    for k in range(len(building.storeys)):
        here = np.array([i for i, r in enumerate(building.rooms) if r.storey == k])
        rows = np.flatnonzero((points[:, 2] >= bounds[k]) & (points[:, 2] < bounds[k + 1]))
        nearest = find_rooms(points[rows, :2], [building.rooms[i] for i in here])
        labels[rows] = np.where(nearest >= 0, here[nearest], -1)
    return PointCloud(points.astype(np.float32), labels=labels, rooms=building.rooms, source=path.name)
