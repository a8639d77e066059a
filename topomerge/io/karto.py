"""Pose graphs of slam_toolbox (`.posegraph`, with its `.data` beside it): scans of a laser where the graph puts them, as slices.

Both are binary archives of Boost. What comes after the graph is read only to write it again.
Source: `lib/karto_sdk/include/karto_sdk/{Karto,Mapper}.h` of slam_toolbox (ROS 1 Melodic to ROS 2 Jazzy).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from topomerge.errors import InputError
from topomerge.io.boost_archive import END, SIGNATURE, ArchiveLayout, BinaryArchive, Members
from topomerge.io.piece import BLOCK_POINTS, Piece, ReadOptions, build_damage_error
from topomerge.types import Array, transform_points

KIND = "a pose graph of slam_toolbox"
LARGEST = 1 << 32  # bytes of a file
MOST_READINGS = 1 << 16  # of a scan
ADVICE = "save the map as a grid (`ros2 run nav2_map_server map_saver_cli`), or give a bag of the scans"
ABSTRACT = (
    "AbstractParameter",
    "Object",
    "Sensor",
    "CustomData",
    "GraphTraversal",
)  # only what derives from them is behind a pointer
SCAN = "LocalizedRangeScan"
CLASSES = {  # members in their order, `name:type`; without a name: a base. What follows the graph is left out.
    "NonCopyable": "",
    "EdgeLabel": "",
    "Module": "Object",
    "SensorData": "state:i4 id:i4 sensor:Name time:f8 custom:vector<CustomData*> Object",
    "Name": "name:str scope:str",
    "Object": "NonCopyable parameters:ParameterManager* name:Name",
    "ParameterManager": "NonCopyable list:vector<AbstractParameter*> lookup:map<str,AbstractParameter*>",
    "AbstractParameter": "name:str about:str",
    "ParameterEnum": "Parameter<int32s> names:map<str,i4>",
    "Parameter<bool>": "AbstractParameter value:bool",
    "Parameter<double>": "AbstractParameter value:f8",
    "Parameter<int32u>": "AbstractParameter value:u4",
    "Parameter<int32s>": "AbstractParameter value:i4",
    "Parameter<Pose2>": "AbstractParameter value:Pose2",
    "Parameter<std::string>": "AbstractParameter value:str",
    "Vector2<double>": "x:f8 y:f8",
    "Vector2<int>": "x:i4 y:i4",
    "Size2<int>": "w:i4 h:i4",
    "Pose2": "place:Vector2<double> heading:f8",
    "Rectangle2<int>": "place:Vector2<int> size:Size2<int>",
    "BoundingBox2": "low:Vector2<double> high:Vector2<double>",
    "CoordinateConverter": "size:Size2<int> scale:f8 offset:Vector2<double>",
    "Grid<u1>": "w:i4 h:i4 step:i4 converter:CoordinateConverter* cells:u1[step*h]",
    "Grid<f8>": "w:i4 h:i4 step:i4 converter:CoordinateConverter* cells:f8[step*h]",
    "CorrelationGrid": "Grid<u1> smear:f8 side:i4 kernel:u1[side*side] roi:Rectangle2<int>",
    "LookupArray": "capacity:u4 size:u4 cells:i4[capacity]",
    "GridIndexLookup": "grid:Grid<u1>* capacity:u4 size:u4 angles:vector<f8> arrays:LookupArray*[capacity]",
    "ScanMatcher": (
        "mapper:Mapper* grid:CorrelationGrid* odds:Grid<f8>* lookup:GridIndexLookup* xs:vector<f8> ys:vector<f8> "
        "middle:Pose2 step:f8 turns:u4 again:f8 penalize:bool found:pair<f8,Pose2>[xs*ys*turns]"
    ),
    "LaserRangeScan": "count:u4 SensorData ranges:f8[count]",
    SCAN: (
        "odometry:Pose2 pose:Pose2 middle:Pose2 points:vector<Vector2<double>> all_points:vector<Vector2<double>> "
        "box:BoundingBox2 dirty:bool LaserRangeScan"
    ),
    "Matrix3": "rows:f8[3][3]",
    "LinkInfo": "EdgeLabel a:Pose2 b:Pose2 difference:Pose2 covariance:Matrix3",
    "Vertex": "scan:LocalizedRangeScan* edges:vector<Edge*>",
    "Edge": "a:Vertex* b:Vertex* link:EdgeLabel*",
    "Sensor": "Object offset:Parameter<Pose2>*",
    "LaserRangeFinder": (
        "Sensor low:Parameter<double>* high:Parameter<double>* step:Parameter<double>* nearest:Parameter<double>* "
        "farthest:Parameter<double>* threshold:Parameter<double>* kind:ParameterEnum* count:u4"
    ),
    "Dataset": "lasers:map<Name,Sensor*> data:map<i4,Object*>",
    "MapperGraph": "Graph",
    "Mapper": "Module ready:bool matcher:ScanMatcher* graph:MapperGraph*",
}
ALIASES = {
    "Parameter<unsignedint>": "Parameter<int32u>",
    "Parameter<uint32_t>": "Parameter<int32u>",
    "Parameter<int>": "Parameter<int32s>",
}
_GRAPHS = ("map<i4,Vertex*>", "vector<Vertex*>")  # since 2019, and before
_SCANS = (f"scans:map<i4,{SCAN}*>", f"scans:vector<{SCAN}*>")


def _build_layout(more: dict[str, str]) -> ArchiveLayout:
    return ArchiveLayout({**CLASSES, **more}, ABSTRACT, ALIASES, (" ", "karto::", "kt_"), (SCAN, "LinkInfo", "Edge"))


LAYOUTS = tuple(_build_layout({"Graph": f"edges:vector<Edge*> vertices:map<Name,{of}>"}) for of in _GRAPHS)
WHOLE = tuple(  # with what follows the graph; parameters are those that the module lists, once more
    _build_layout(
        {
            "Graph": layout.classes["Graph"],
            "MapperGraph": "Graph mapper:Mapper* matcher:ScanMatcher* walk:GraphTraversal*",
            "GraphTraversal": "graph:Graph*",
            f"BreadthFirstTraversal<{SCAN}>": "GraphTraversal",
            "ScanManager": f"{scans} running:vector<{SCAN}*> last:{SCAN}* most:u4 longest:f8 next:u4",
            "MapperSensorManager": f"managers:map<Name,ScanManager*> most:u4 longest:f8 next:i4 {scans}",
            "MapperListener": "",
            "Mapper": (
                f"{CLASSES['Mapper']} manager:MapperSensorManager* listeners:vector<MapperListener*> "
                f"settings:AbstractParameter*[{END}]"
            ),
            "Dataset": f"{CLASSES['Dataset']} devices:vector<Object*> info:DatasetInfo*",
        }
    )
    for layout, scans in zip(LAYOUTS, _SCANS, strict=True)
)


@dataclass(frozen=True, eq=False)
class KartoGraph:
    """Scans of a pose graph and what links them.

    Args:
        scans: members of those that are in the graph, by their number.
        links: (n, 2) numbers of scans.
        lasers: by their name.
        archives: of the pose graph and of its data, for their bytes.
        roots: what they hold, a Mapper and a Dataset.
    """

    scans: dict[int, Members]
    links: Array
    lasers: dict[str, Members]
    archives: tuple[BinaryArchive, BinaryArchive]
    roots: tuple[Members, Members]

    def place_scans(self) -> Array:
        """Place (n, 3) robots of the scans: x, y, heading."""
        return np.array([get_pose(scan["pose"]) for scan in self.scans.values()]).reshape(-1, 3)

    def find_largest_part(self) -> list[int]:
        """Find the numbers of the scans that links join, of the largest such part."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        numbers = np.array(list(self.scans))
        rows = np.searchsorted(numbers, self.links)
        shape = (len(numbers), len(numbers))
        _, part = connected_components(coo_matrix((np.ones(len(rows)), (rows[:, 0], rows[:, 1])), shape), directed=False)
        chosen: list[int] = numbers[part == np.bincount(part).argmax()].tolist()
        return chosen


def get_pose(pose: Members) -> tuple[float, float, float]:
    """Return x, y and heading of a Pose2."""
    return pose["place"]["x"], pose["place"]["y"], pose["heading"]


def read_karto_graph(path: Path) -> KartoGraph:
    """Read a pose graph and the data beside it.

    Raises:
        InputError: one is missing, damaged, of a version that is not known, or they do not belong together.
    """
    companion = path.with_suffix(".data")
    if not companion.is_file():
        raise InputError(
            f"{path}: {companion.name} is not beside it, which knows the laser; copy both files that slam_toolbox saved"
        )
    return parse_karto_graph(path, [_read_bytes(file) for file in (path, companion)])


def _read_bytes(path: Path) -> bytes:
    if path.stat().st_size > LARGEST:
        raise InputError(f"{path}: has more than {LARGEST >> 30} GB, too many for {KIND}; {ADVICE}")
    data = path.read_bytes()
    if not data.startswith(SIGNATURE):
        raise InputError(f"{path}: is not {KIND}: no binary archive of Boost for 64 bits; check the file, or {ADVICE}")
    return data


def parse_karto_graph(path: Path, files: Sequence[bytes], layouts: Sequence[ArchiveLayout] = LAYOUTS) -> KartoGraph:
    """Parse a pose graph and its data.

    Args:
        layouts: `WHOLE`, with what follows the graph.

    Raises:
        InputError: as `read_karto_graph`.
    """
    companion = path.with_suffix(".data")
    graph, mapper = _parse_archive(path, files[0], "Mapper", layouts)
    data, dataset = _parse_archive(companion, files[1], "Dataset", layouts)
    scans = {int(scan["id"]): scan for scan in graph.found[SCAN]}
    lasers = {get_name(name): laser for name, laser in dataset["lasers"] if laser and laser["class"] == "LaserRangeFinder"}
    if len(scans) != len(graph.found[SCAN]) or not scans:
        raise build_damage_error(path, KIND, "it has no scans, or two of one number")
    ends = [(e["a"]["scan"]["id"], e["b"]["scan"]["id"]) for e in graph.found["Edge"] if _is_whole(e)]
    for scan in scans.values():
        laser = lasers.get(get_name(scan["sensor"]))
        if laser is None or laser["count"] != len(scan["ranges"]) or laser["count"] > MOST_READINGS:
            raise InputError(f"{path}: {companion.name} does not know the laser of its scans; copy both files of one saving")
        if not np.isfinite(get_pose(scan["pose"])).all():
            raise build_damage_error(path, KIND, "a pose that is none")
    return KartoGraph(
        dict(sorted(scans.items())), np.array(ends, np.int64).reshape(-1, 2), lasers, (graph, data), (mapper, dataset)
    )


def _is_whole(edge: Members) -> bool:
    return all(edge[end] is not None and edge[end]["scan"] is not None for end in "ab")


def get_name(name: Members) -> str:
    """Return a Name as text."""
    return f"{name['scope']}/{name['name']}"


def _parse_archive(path: Path, data: bytes, kind: str, layouts: Sequence[ArchiveLayout]) -> tuple[BinaryArchive, Members]:
    """Read an archive in the first layout that fits.

    Raises:
        InputError: in none.
    """
    reasons = []
    for layout in layouts:
        archive = BinaryArchive(data, layout)
        try:
            return archive, archive.read(kind)
        except (ValueError, KeyError, TypeError) as error:
            reasons.append((archive.at, str(error)))
    raise InputError(f"{path}: is damaged, or of a version of slam_toolbox that is not read ({max(reasons)[1][:120]}); {ADVICE}")


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Yield the points of the scans, at the height of the laser, in the frame of the map."""
    graph = read_karto_graph(path)
    chosen = graph.find_largest_part()
    lost = len(graph.scans) - len(chosen)
    warnings = (
        (f"{path}: {lost:,} of its {len(graph.scans):,} scans are joined with the others by no link; left out",) if lost else ()
    )
    poses, points = [], []
    for number in chosen:
        scan = graph.scans[number]
        laser = graph.lasers[get_name(scan["sensor"])]
        pose = build_planar_pose(*get_pose(scan["pose"])) @ build_planar_pose(*get_pose(laser["offset"]["value"]))
        ranges, about = scan["ranges"], [laser[name]["value"] for name in ("low", "step", "nearest", "threshold")]
        seen = np.isfinite(ranges) & (ranges >= about[2]) & (ranges <= about[3])
        angle = about[0] + about[1] * np.flatnonzero(seen)
        flat = np.column_stack([ranges[seen] * np.cos(angle), ranges[seen] * np.sin(angle), np.zeros(len(angle))])
        poses.append(pose)
        points.append(transform_points(pose, flat))
    first = np.cumsum([0, *map(len, points)])
    owner = np.repeat(np.arange(len(points), dtype=np.int32), np.diff(first))
    every = np.concatenate(points)
    for k in range(0, max(len(every), 1), BLOCK_POINTS):
        rows, head = slice(k, k + BLOCK_POINTS), k == 0
        placed = np.stack(poses) if head else None
        done = min((k + BLOCK_POINTS) / max(len(every), 1), 1.0)
        yield Piece(every[rows], poses=placed, pose_of=owner[rows], warnings=warnings if head else (), done=done)


def build_planar_pose(x: float, y: float, heading: float) -> Array:
    """Build (4, 4) of a pose in the plane."""
    pose = np.eye(4)
    c, s = np.cos(heading), np.sin(heading)
    pose[:2, :2], pose[:2, 3] = ((c, -s), (s, c)), (x, y)
    return pose
