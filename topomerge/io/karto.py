"""Pose graphs of slam_toolbox (`.posegraph`, with its `.data` beside it): scans of a laser where the graph puts them, as slices.

Both are binary archives of Boost: the members of an object in their order, without names. Where a class comes first, it is told
whether its objects are counted, and in which version. An object behind a pointer has the number of its class, and is written
where it is first met. So all that comes before the graph has to be known; what comes after it is read only to write it again.
Source: `lib/karto_sdk/include/karto_sdk/{Karto,Mapper}.h` of slam_toolbox (ROS 1 Melodic to ROS 2 Jazzy), and
`basic_oarchive.cpp` of Boost.Serialization (tried: 1.74).
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.piece import BLOCK_POINTS, Piece, ReadOptions, build_damage_error
from topomerge.types import Array, transform_points

KIND = "a pose graph of slam_toolbox"
SIGNATURE = (22).to_bytes(8, "little") + b"serialization::archive"
LIBRARY = (12, 20)  # versions of the archive that are written alike
SIZES = bytes([4, 8, 4, 8, 1, 0, 0, 0])  # of int, long, float and double, and the order of bytes
LARGEST = 1 << 32  # bytes of a file
MOST_ITEMS = 1 << 23  # of a list of objects
MOST_READINGS = 1 << 16  # of a scan
ADVICE = "save the map as a grid (`ros2 run nav2_map_server map_saver_cli`), or give a bag of the scans"
END = "end"  # as size: an array to the end of the file
NUMBERS = {"bool": "?", "u1": "B", "i4": "<i4", "u4": "<u4", "f8": "<f8"}
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
LAYOUTS = (  # since 2019, and before
    {"Graph": "edges:vector<Edge*> vertices:map<Name,map<i4,Vertex*>>"},
    {"Graph": "edges:vector<Edge*> vertices:map<Name,vector<Vertex*>>"},
)
_SCANS = (f"scans:map<i4,{SCAN}*>", f"scans:vector<{SCAN}*>")
WHOLE = tuple(  # with what follows the graph; parameters are those that the module lists, once more
    {
        **layout,
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
    for layout, scans in zip(LAYOUTS, _SCANS, strict=True)
)
ALIASES = {
    "Parameter<unsignedint>": "Parameter<int32u>",
    "Parameter<uint32_t>": "Parameter<int32u>",
    "Parameter<int>": "Parameter<int32s>",
}
Members = dict[str, Any]
Passing = Generator[Any, Any, Any]


@cache
def _split(text: str) -> tuple[str, ...]:
    """The arguments of a template."""
    parts, depth, start = [], 0, 0
    for k, letter in enumerate(text):
        depth += (letter == "<") - (letter == ">")
        if letter == "," and depth == 0:
            parts.append(text[start:k])
            start = k + 1
    return (*parts, text[start:])


class BinaryArchive:
    """A binary archive of Boost that is read or written from its start: what it says of classes, and its objects.

    One description of the classes serves both ways, as Boost's `archive & member` does: what is written is passed in as `value`.

    Args:
        data: of the file.
        layout: classes that differ between versions.
        like: writes, in place of reading: descriptions of classes are those of these archives, the head is that of the first.
    """

    def __init__(self, data: bytes, layout: Mapping[str, str], like: Sequence[BinaryArchive] = ()) -> None:
        self.data, self.at, self.out = data, len(SIGNATURE), bytearray()
        self.layout, self.like = layout, like
        self.members = {**CLASSES, **layout}
        self.numbers: dict[str, int] = {}  # of classes, in the order in which they were met
        self.counted: dict[str, bool] = {}  # of those that were described: are its objects counted?
        self.names: dict[str, str] = {}  # of classes, as the archive writes them
        self.objects: list[Any] = []
        self.entered: dict[tuple[int, str], int] = {}  # numbers of objects that were written
        self.found: dict[str, list[Members]] = {SCAN: [], "LinkInfo": [], "Edge": []}

    def read(self, kind: str) -> Members:
        """Read the object with which the archive begins.

        Raises:
            ValueError: it is damaged, of another layout, or another kind of archive.
        """
        library = self._move_number("<u2")
        if not LIBRARY[0] <= library <= LIBRARY[1]:
            raise ValueError(f"an archive of version {library} of Boost")
        if self._take(len(SIZES)) != SIZES:
            raise ValueError("an archive of another kind of machine")
        return self._run(kind)

    def _run(self, kind: str, value: Members | None = None) -> Members:
        """Go through an object; graphs are deeper than Python's stack."""
        stack = [self._move_object(kind, value)]
        value = None
        while stack:
            try:
                stack.append(stack[-1].send(value))
                value = None
            except StopIteration as done:
                stack.pop()
                value = done.value
        assert isinstance(value, dict)
        return value

    def _take(self, count: int) -> bytes:
        if count < 0 or self.at + count > len(self.data):
            raise ValueError("it is cut short, or of another layout")
        self.at += count
        return self.data[self.at - count : self.at]

    def _move_block(self, form: str, count: int, values: Any = None) -> Array:
        """Numbers that lie behind each other."""
        kind = np.dtype(form)
        if self.like:
            self.out += np.asarray(values, kind).tobytes()
            return np.asarray(values)
        return np.frombuffer(self._take(count * kind.itemsize), kind)

    def _move_number(self, form: str, value: Any = None) -> Any:
        return self._move_block(form, 1, value if value is None else [value])[0].item()

    def _move_count(self, value: int, most: int = MOST_ITEMS) -> int:
        count = int(self._move_number("<u8", value))
        if not self.like and count > min(most, len(self.data) - self.at):
            raise ValueError(f"a list of {count:,} entries")
        return count

    def _move_text(self, value: str | None) -> str:
        data = (value or "").encode(errors="surrogateescape")
        count = self._move_count(len(data), 1 << 20)
        if self.like:
            self.out += data
            return value or ""
        return self._take(count).decode(errors="surrogateescape")

    def _register(self, kind: str) -> None:
        self.numbers.setdefault(kind, len(self.numbers))

    def _describe(self, kind: str) -> bool:
        """Say of a class, where it comes first, whether its objects are counted."""
        if kind not in self.counted:
            known = next((archive.counted[kind] for archive in self.like if kind in archive.counted), False)
            counted, version = self._move_number("u1", known), self._move_number("<u4", 0)
            if counted > 1 or version:
                raise ValueError(f"version {version} of {kind}")
            self.counted[kind] = bool(counted)
        return self.counted[kind]

    def _enter(self, kind: str, value: Any) -> tuple[int, bool]:
        """The number of an object, and whether it is new."""
        held = len(self.objects)
        number = int(self._move_number("<u4", self.entered.get((id(value), kind), held)))
        if number > held:
            raise ValueError(f"object {number:,} before its time")
        if number == held:
            self.objects.append(value)
            self.entered[id(value), kind] = held
        return number, number == held

    def _move(self, kind: str, value: Any) -> Passing:
        """A member of any type."""
        if kind in NUMBERS:
            return self._move_number(NUMBERS[kind], value)
        if kind == "str":
            return self._move_text(value)
        if kind.endswith("*"):
            return (yield self._move_pointer(kind[:-1], value))
        return (yield self._move_object(kind, value))

    def _move_class(self, value: Members | None) -> str | None:
        """The class of what is behind a pointer."""
        kind = "" if value is None else value["class"]
        number = self._move_number("<i2", self.numbers.get(kind, len(self.numbers)) if value is not None else -1)
        if number == -1:
            return None
        if number != len(self.numbers):
            if not 0 <= number < len(self.numbers):
                raise ValueError(f"an object of class {number}")
            return list(self.numbers)[number]
        text = self._move_text(next((archive.names[kind] for archive in self.like if kind in archive.names), None))
        name = text.replace(" ", "").replace("karto::", "").replace("kt_", "")
        kind = ALIASES.get(name, name)
        if kind not in self.members or kind in self.numbers:
            raise ValueError(f"an object of class {name[:60]!r}")
        self.names[kind] = text
        self._register(kind)
        return kind

    def _move_pointer(self, static: str, value: Members | None) -> Passing:
        if static not in ABSTRACT:
            self._register(static)
        kind, number = self._move_class(value), None
        if kind is None:
            return None
        if self._describe(kind):
            number, new = self._enter(kind, value)
            if not new:
                return self.objects[number]
        return (yield self._fill(kind, number, value))

    def _move_object(self, kind: str, value: Any) -> Passing:
        self._register(kind)
        if kind == "vector<f8>":  # lists of numbers are not described
            return self._move_block("<f8", self._move_count(0 if value is None else len(value)), value)
        number = None
        if self._describe(kind):
            number, new = self._enter(kind, value)
            if not new:
                raise ValueError(f"{kind} twice")
        return (yield self._fill(kind, number, value))

    def _fill(self, kind: str, number: int | None, value: Any) -> Passing:
        """The content of an object, a pair or a list."""
        head, _, rest = kind.partition("<")
        inner = _split(rest[:-1]) if head in ("vector", "map", "pair") else ()
        if head == "vector":
            return (yield self._move_list(inner[0], value))
        if head == "map":
            return (yield self._move_list(f"pair<{inner[0]},{inner[1]}>", value))
        if head == "pair":
            first = yield self._move(inner[0], value and value[0])
            return first, (yield self._move(inner[1], value and value[1]))
        members: Members = value if self.like else {"class": kind}
        if number is not None:
            self.objects[number] = members
        for member in self.members[kind].split():
            name, _, of = member.rpartition(":")
            at = self.at
            if not name:
                base = yield self._move(of, value)
                members |= {} if self.like else {k: v for k, v in base.items() if k != "class"}
            elif of.endswith("]"):
                members[name] = yield self._move_array(of, members, members.get(name))
            else:
                members[name] = yield self._move(of, members.get(name))
                members[f"@{name}"] = at, self.at
        if kind in self.found:
            self.found[kind].append(members)
        return members

    def _move_list(self, kind: str, values: Any) -> Passing:
        count = self._move_count(0 if values is None else len(values))
        if self._move_number("<u4", 0):
            raise ValueError(f"another version of {kind}")
        if kind != "Vector2<double>" or not count:
            return (yield self._move_all(kind, count, values))
        self._register(kind)
        if self._describe(kind):
            raise ValueError(f"{kind} is counted")
        return self._move_block("<f8", 2 * count, values).reshape(-1, 2)

    def _move_all(self, kind: str, count: int, values: Any) -> Passing:
        out = []
        for k in range(count):
            out.append((yield self._move(kind, None if values is None else values[k])))
        return out

    def _move_array(self, kind: str, members: Members, values: Any) -> Passing:
        """An array, whose length other members tell, or the end of the file."""
        of, *sizes = kind.replace("]", "").split("[")
        if of == "f8" and sizes == ["3", "3"]:
            rows = range(self._move_count(3, 3))
            return np.array(
                [self._move_block("<f8", self._move_count(3, 3), values if values is None else values[k]) for k in rows]
            )
        if sizes == [END]:
            out: list[Any] = []
            while self.at < len(self.data) if values is None else len(out) < len(values):
                out.append((yield self._move(of, None if values is None else values[len(out)])))
            return out
        count = 1
        for size in sizes[0].split("*"):
            count *= len(members[size]) if hasattr(members[size], "__len__") else int(members[size])
        if of in NUMBERS:
            return self._move_block(NUMBERS[of], count, values)
        if not 0 <= count <= MOST_ITEMS:
            raise ValueError(f"an array of {count:,} entries")
        return (yield self._move_all(of, count, values))


def write_archive(value: Members, like: Sequence[BinaryArchive]) -> bytes:
    """Write an object as an archive, whose classes are described as in others, of one layout.

    Raises:
        ValueError: these describe a class in two ways.
    """
    for archive in like[1:]:
        if any(like[0].counted.get(kind, counted) != counted for kind, counted in archive.counted.items()):
            raise ValueError("they were written by different builds of slam_toolbox")
    writer = BinaryArchive(b"", like[0].layout, like)
    writer._run(value["class"], value)
    return like[0].data[: len(SIGNATURE) + 2 + len(SIZES)] + bytes(writer.out)


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


def parse_karto_graph(path: Path, files: Sequence[bytes], layouts: Sequence[Mapping[str, str]] = LAYOUTS) -> KartoGraph:
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


def _parse_archive(path: Path, data: bytes, kind: str, layouts: Sequence[Mapping[str, str]]) -> tuple[BinaryArchive, Members]:
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
