"""Where the rows of `realism` come from: simulated buildings and maps of the training split, and the real ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
from topomerge.datasets.buildings.erect import erect
from topomerge.datasets.buildings.procedural import BUILDING_KINDS, make_building
from topomerge.datasets.core.building import Building
from topomerge.datasets.core.plan import Plan
from topomerge.datasets.plans import splits
from topomerge.datasets.plans.floorplans import Refusal, iter_plans
from topomerge.datasets.real.sources import REAL_FOLDERS, pair_makers
from topomerge.datasets.reports import realism_measures
from topomerge.datasets.simulation.scanner import scan
from topomerge.datasets.simulation.sensors import SENSORS
from topomerge.datasets.simulation.session import session
from topomerge.datasets.simulation.walk import part

from topomerge.errors import InputError
from topomerge.io.points import read_points
from topomerge.types import Array, PointCloud, TrueRoom

SENSED = ("tls", "lidar", "depth", "tablet")
BUILDINGS_A_KIND = 10  # buildings of a kind whose rooms are counted
MAPS_A_KIND = 1  # buildings of a kind that each sensor scans
VISITED = 8  # rooms a map
SKIPPED = ("void", "lift")
REAL_PLANS = {"GDC floors 1–4": "utexas_gdc_floors", "IFC models": "ifc_buildings", "IPA grids": "grids_ipa_room_segmentation"}
IPAD, OCTOMAP = "ipad_lidar_rooms", "octomap_freiburg078/fr_078_tidyup.bt"
APARTMENT = "pair_libpointmatcher_apartment/libpointmatcher/icp_tutorial"
DRAWN_ROOMS = {  # rooms of clouds that show more than one: corners taken from a picture of the walls, to a decimetre
    "fr078": [(-8.3, -5.0), (1.7, -5.0), (1.7, 4.5), (-4.0, 4.2), (-8.8, 3.6)],
    "cloud_0": [(-0.5, -0.7), (2.4, -0.7), (2.4, 0.7), (1.3, 0.7), (1.3, 1.3), (-0.5, 1.3)],
    "cloud_1": [(-1.2, -0.6), (1.6, -1.2), (1.9, 0.3), (0.9, 0.6), (0.8, 1.25), (-0.9, 1.4)],
}
IPAD_HEIGHT = 3.0  # m from the ceiling to the floor of the iPad's rooms: no cloud shows both well, 470 does a little of its floor

Row = tuple[str, Mapping[str, float]]


def plan_rows(folder: Path, fast: bool = False) -> Iterator[Row]:
    """Rooms and doors: of procedural buildings, of the plans that train, and of real buildings."""
    for kind in BUILDING_KINDS[:3] if fast else BUILDING_KINDS:
        yield kind, _of_buildings([make_building(kind, seed, 2) for seed in range(3 if fast else BUILDINGS_A_KIND)])
    for source, name in splits.FOLDERS.items():
        if (folder / name).is_dir():
            taken = set(splits.members("train", source)[: 20 if fast else None])
            yield f"plans: {source}", _of_plans([p for n, p in iter_plans(folder / name) if n in taken])
    for title, name in REAL_PLANS.items():
        if (folder / name).is_dir():
            yield f"real: {title}", _of_plans([p for _, p in iter_plans(folder / name)])


def _of_buildings(buildings: list[Building]) -> dict[str, float]:
    storeys, widths = [], []
    for b in buildings:
        for k in range(len(b.storeys)):
            storeys.append([_area(r.polygon) for r in b.rooms if r.storey == k and r.kind not in SKIPPED])
        widths += b.doors["width"][(b.doors["rooms"] >= 0).all(axis=1)].tolist()
    return realism_measures.rooms_and_doors(storeys, widths)


def _of_plans(results: list[Plan | Refusal]) -> dict[str, float]:
    plans = [p for p in results if isinstance(p, Plan)]
    storeys = [[_area(r.polygon) for r in p.rooms if r.kind not in SKIPPED] for p in plans]
    widths = [float(np.hypot(*np.subtract(o.start, o.end))) for p in plans for o in p.openings if o.kind in ("door", "opening")]
    return realism_measures.rooms_and_doors([s for s in storeys if s], widths)


def _area(polygon: Array) -> float:
    return float(shapely.Polygon(polygon).area)


def map_rows(folder: Path, fast: bool = False) -> Iterator[Row]:
    """Surfaces: simulated maps by kind and sensor, all kinds together by sensor, then the real ones."""
    buildings = list(_buildings(folder, fast))
    of: dict[str, list[Mapping[str, float]]] = {}
    for kind, building in buildings:
        for sensor in SENSED:
            of.setdefault(f"{kind}, {sensor}", []).append(simulated(building, sensor, len(of)))
    for sensor in SENSED:
        of[f"**simulated, {sensor}**"] = [r for name, rows in of.items() if name.endswith(f", {sensor}") for r in rows]
    yield from ((name, mean(rows)) for name, rows in of.items())
    yield from ((f"real: {name}", row) for name, row in real_maps(folder, fast))


def _buildings(folder: Path, fast: bool) -> Iterator[tuple[str, Building]]:
    for kind in BUILDING_KINDS[:3] if fast else BUILDING_KINDS:
        yield from ((kind, make_building(kind, 100 + seed, 1)) for seed in range(1 if fast else MAPS_A_KIND))
    for source, name in {} if fast else splits.FOLDERS.items():
        names = splits.members("train", source)
        if (folder / name).is_dir():
            taken = {n: p for n, p in iter_plans(folder / name) if isinstance(p, Plan) and n in names and _usual(p)}
            for n in sorted(taken)[:: max(len(taken) // MAPS_A_KIND, 1)][:MAPS_A_KIND]:
                yield f"plan {source}", erect([taken[n]], rng=0, name=n)


def _usual(plan: Plan) -> bool:
    areas = [_area(r.polygon) for r in plan.rooms]
    return len(areas) >= 5 and 45 <= sum(areas) <= 4000 and max(areas) < 500


def simulated(building: Building, sensor: str, seed: int = 0) -> dict[str, float]:
    """A part of a building as a session finds it, scanned. Surfaces are measured without drift, which would move them off the
    true rooms; thickness is measured with it."""
    rng = np.random.default_rng(seed)
    place, visited = session(building, rng=rng), part(building, VISITED, rng)
    straight = scan(place, replace(SENSORS[sensor], drift=0.0, tilt=0.0), visited, seed)
    bent = scan(place, sensor, visited, seed)
    return of_rooms(straight, visited) | realism_measures.thickness(bent.points)


def of_rooms(cloud: PointCloud, rooms: Array | list[int]) -> dict[str, float]:
    """Surfaces of some of a cloud's true rooms, by the points that carry their label."""
    points, labels = cloud.points.astype(float) + cloud.shift, cloud.labels
    assert labels is not None
    rows = [realism_measures.surfaces(points[labels == i], realism_measures.space_of(cloud.rooms[i])) for i in rooms]
    return realism_measures.together(rows)


def mean(rows: list[Mapping[str, float]]) -> dict[str, float]:
    """Means of several maps, and the number of their rooms."""
    keys = {key for row in rows for key in row}
    out = {key: float(np.nanmean(values)) for key in keys if np.isfinite(values := [r.get(key, np.nan) for r in rows]).any()}
    return out | {"seen": sum(r["seen"] for r in rows)}


def real_maps(folder: Path, fast: bool = False) -> Iterator[Row]:
    """Surfaces of the real maps; a folder that is missing is left out."""
    for title, cloud, floor, ceiling in real_clouds(folder):
        points = cloud.points.astype(float)
        drawn = DRAWN_ROOMS.get(title.split()[-1])
        space = realism_measures.outline_of(points, floor, ceiling)
        if drawn is not None:
            space = realism_measures.space_of(TrueRoom(title, np.array(drawn), floor, ceiling))
        yield title, realism_measures.together([realism_measures.surfaces(points, space)]) | realism_measures.thickness(points)
    yield from _grids(folder)
    if not fast:
        yield from _models(folder)


def real_clouds(folder: Path) -> Iterator[tuple[str, PointCloud, float, float]]:
    """Title, cloud, and heights of floor and ceiling of the clouds without true rooms.

    The iPad's clouds show no floor, the octree map no ceiling: the other one is 3.0 m below, or 2.7 m above.
    """
    for path in sorted((folder / IPAD).glob("*/*.ply")):
        cloud = read_points(path, up="y" if path.parent.name == "user" else None)
        ceiling = level(cloud.points, top=True)
        yield f"iPad {path.parent.name} {path.stem}", cloud, ceiling - IPAD_HEIGHT, ceiling
    if (folder / OCTOMAP).is_file():
        cloud = read_points(folder / OCTOMAP)
        floor = level(cloud.points, top=False)
        yield "octomap fr078", cloud, floor, floor + 2.7
    for path in sorted((folder / APARTMENT).glob("*.vtk")):
        cloud = read_vtk(path)
        yield f"apartment {path.stem}", cloud, level(cloud.points, top=False), level(cloud.points, top=True)


def level(points: Array, top: bool) -> float:
    """Height of the level of most columns of 0.1 m in the upper or lower third, m."""
    cells = np.unique(np.floor(points / [0.1, 0.1, 0.05]).astype(np.int64), axis=0)
    low, high = np.quantile(points[:, 2], [0.001, 0.999])
    bounds = (2 * high + low) / 3, (high + 2 * low) / 3
    heights, count = np.unique(cells[:, 2], return_counts=True)
    z = (heights + 0.5) * 0.05
    return float(z[np.argmax(np.where(z > bounds[0] if top else z < bounds[1], count, -1))])


def read_vtk(path: Path) -> PointCloud:
    """The points of a VTK file of libpointmatcher (version 3, ASCII).

    Raises:
        InputError: missing or damaged.
    """
    try:
        words = path.read_text(encoding="ascii").split("POINTS", 1)[1].split()
        count = int(words[0])
        points = np.array(words[2 : 2 + 3 * count], np.float32).reshape(count, 3)
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{path}: is not an ASCII VTK file with points ({error}); copy it again") from error
    return PointCloud(points, source=path.name)


def _grids(folder: Path) -> Iterator[Row]:
    """Robot grids: what is free or occupied within the true rooms is seen; there are no heights."""
    for name, make in pair_makers("utexas", folder) if (folder / REAL_FOLDERS["utexas"]).is_dir() else ():
        if not name.endswith("-lines"):
            continue
        cloud = make().a
        row = of_rooms(cloud, list(range(len(cloud.rooms))))
        yield f"GDC {name.removesuffix('-lines')}", {k: row[k] for k in ("seen", "floor") if k in row}


def _models(folder: Path) -> Iterator[Row]:
    """Building models, scanned from inside."""
    for name, make in pair_makers("ifc", folder) if (folder / REAL_FOLDERS["ifc"]).is_dir() else ():
        pair = make()
        row = of_rooms(pair.b, list(pair.visited[1]))
        yield f"IFC {name}, {pair.sensors[1]}", row | realism_measures.thickness(pair.b.points)
