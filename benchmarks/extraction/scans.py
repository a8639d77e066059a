"""Cases of the benchmark of the extraction; their scans are made once and kept, each with what is true about it."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from topomerge.datasets.core.physical import physical_building
from topomerge.datasets.simulation.floor_truth import Truth, in_frame
from topomerge.datasets.simulation.scanner import moved

from topomerge.io.atomic import replacing
from topomerge.types import Array, PointCloud, Sim3, TrueRoom, VoxelGrid

SCAN_FORMAT = 3  # raise it when the same case gives other bytes


@dataclass(frozen=True)
class Case:
    """One map that is made.

    Args:
        set: the row of the tables that it belongs to.
        source: procedural; r2v, campus, mall, rmf, ipa-plan (plans that are erected and scanned); ifc (models, scanned); ipa, gdc
            (grids, raised); home (vacuum robots' maps); file (anything that can be read; nothing is true about it).
        building: kind of procedural building, or name of the plan, model, grid or file.
        seed: of the building and of the walk.
        rooms: rooms to visit; 0: all.
        difficulty: what differs from the defaults.
        spoil: what is done to the points: sparse, noise, below2, drift.
        day: 1 and 2 are two sessions in one building that have 60 % of their rooms in common; 0: there is one only.
        spacing: m between points; 0: the sensor's.
        thin: m, as which spacing the cloud is given; 0: as it is.
        turn: degrees by which the cloud is turned about the vertical.
        shuffle: are its points given in another order?
        voxel: m, edge of the cells.
        shades: colour or intensity, of a scan that is painted.
    """

    set: str
    source: str
    building: str
    sensor: str = ""
    seed: int = 0
    storeys: int = 1
    rooms: int = 0
    difficulty: tuple[tuple[str, float], ...] = ()
    spoil: str = ""
    day: int = 0
    spacing: float = 0.0
    thin: float = 0.0
    turn: float = 0.0
    shuffle: bool = False
    voxel: float = 0.1
    shades: str = ""

    @property
    def place(self) -> str:
        """The physical building that it is a map of: what intervals are drawn over."""
        made = f"{self.building}-{self.seed}" if self.source == "procedural" else self.building
        return physical_building(self.source, made)

    @property
    def name(self) -> str:
        """For people and file names."""
        *above, plan = Path(self.building).parts
        plan = plan if self.source != "r2v" else f"{above[-1][-6:]}_{plan}"
        words = [
            self.set,
            self.source if self.source != "procedural" else "",
            plan,
            self.seed or "",
            self.sensor,
            self.spoil,
            self.shades,
        ]
        words += [f"{k}{getattr(self, k):g}" for k in ("day", "thin", "turn", "shuffle") if getattr(self, k)]
        words += [f"voxel{self.voxel:g}"] if self.voxel != 0.1 else []
        return re.sub(r"[^\w.-]+", "_", "-".join(str(w) for w in words if w))

    @property
    def key(self) -> str:
        """Hash of what the bytes of the scan depend on."""
        same = {"set": "", "thin": 0.0, "turn": 0.0, "shuffle": False, "voxel": 0.0}
        inputs = {**asdict(self), **same, "format": SCAN_FORMAT}
        if not self.shades:  # files from before there were any
            del inputs["shades"]
        return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:20]


@dataclass(frozen=True, eq=False)
class Scan:
    """A cloud and what is true about it (None: nothing is), with the true rooms in the building's frame."""

    cloud: PointCloud
    truth: Truth | None
    rooms: tuple[TrueRoom, ...]


def load(case: Case, folder: Path, data: Path | None) -> Scan:
    """The scan of a case, from the cache where it has it, in the order, frame and density that the case wants."""
    path = folder / f"{case.key}.npz"
    if not path.exists():
        from benchmarks.extraction.sources import make

        folder.mkdir(parents=True, exist_ok=True)
        made = make(case, data)
        with replacing(path) as beside, open(beside, "wb") as file:
            np.savez(file, allow_pickle=False, **_arrays(made))
    with np.load(path, allow_pickle=False) as file:
        return varied(_scan(dict(file)), case)


def varied(scan: Scan, case: Case) -> Scan:
    """The scan thinned, shuffled and turned as the case wants it."""
    cloud, truth = scan.cloud, scan.truth
    rows = np.arange(len(cloud))
    if case.thin:
        cells = np.floor(cloud.points / case.thin).astype(np.int64)
        cells -= cells.min(axis=0)
        size = cells.max(axis=0) + 1
        rows = np.unique((cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2], return_index=True)[1]
    if case.shuffle:
        rows = np.random.default_rng(0).permutation(rows)
    if len(rows) < len(cloud) or case.shuffle:
        pose_of = None if cloud.pose_of is None else cloud.pose_of[rows]
        colors = None if cloud.colors is None else cloud.colors[rows]
        cloud = replace(cloud, points=cloud.points[rows], pose_of=pose_of, colors=colors)
    if case.turn:
        frame = Sim3(float(np.radians(case.turn)))
        cloud, truth = moved(cloud, frame), None if truth is None else in_frame(truth, frame)
    return replace(scan, cloud=cloud, truth=truth)


def _arrays(scan: Scan) -> dict[str, Array]:
    cloud, truth = scan.cloud, scan.truth
    out: dict[str, Array] = {"points": cloud.points, "shift": cloud.shift, "source": np.array(cloud.source)}
    if cloud.poses is not None and cloud.pose_of is not None:
        out |= {"poses": cloud.poses, "pose_of": cloud.pose_of}
    if cloud.colors is not None:
        out["colors"] = cloud.colors
    if cloud.free is not None:
        out |= {"free": cloud.free.cells, "free_origin": cloud.free.origin, "free_edge": np.array(cloud.free.edge)}
    if truth is not None:
        out |= {f"truth.{name}": np.asarray(value) for name, value in vars(truth).items()}
    rooms = [{**asdict(r), "polygon": np.round(r.polygon, 4).tolist()} for r in scan.rooms]
    return out | {"rooms": np.array(json.dumps(rooms))}


def _scan(arrays: dict[str, Array]) -> Scan:
    free = None
    if "free" in arrays:
        free = VoxelGrid.from_cells(arrays["free"], arrays["free_origin"], float(arrays["free_edge"]))
    cloud = PointCloud(
        arrays["points"],
        colors=arrays.get("colors"),
        shift=arrays["shift"],
        poses=arrays.get("poses"),
        pose_of=arrays.get("pose_of"),
        free=free,
        source=str(arrays["source"]),
    )
    truth = {k.removeprefix("truth."): v for k, v in arrays.items() if k.startswith("truth.")}
    rooms = tuple(TrueRoom(**{**r, "polygon": np.array(r["polygon"])}) for r in json.loads(str(arrays["rooms"])))
    return Scan(cloud, Truth(**truth) if truth else None, rooms)
