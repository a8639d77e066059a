"""Robots that map at the same time: one map each that grows, joined when it is believed, parted when evidence turns.

Memory is bounded: of a robot's scans one point a cell is held, and of its places those where it moved on. What is known is
written into a folder, from which a later start goes on.
"""

from __future__ import annotations

import json
import logging
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from topomerge import archive
from topomerge.archive import convert_to_plain, replace_on_success
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.fusion.atlas.folder import hold_folder
from topomerge.io.maps import save_map
from topomerge.landmarks.settle import find_observations
from topomerge.matching.poses import wrap_yaw
from topomerge.registration.pipeline import Registration, register
from topomerge.registration.prepared import Prepared, prepare
from topomerge.types import Array, PointCloud, Sim3, TopometricMap

log = logging.getLogger(__name__)
STATE_FILE, STATE_FORMAT = "bridge.json", 1
KEY_REACH = 1 << 20  # cells to all sides of the first scan
LONGEST_NAME = 60


@dataclass(frozen=True)
class LiveSettings:
    """Settings of joining maps while robots drive.

    Args:
        cell: m, of which one point is held.
        most_points: of a robot; what comes later is left out, and told.
        most_robots: at most.
        step, turn: m and rad that a robot moves on between scans that are taken.
        reach: m; what a scan shows farther away is left out.
        least_points: of a robot, before its map is made.
        join: probability from which on two maps are joined; `keep`: below which they are parted again.
        open: … above which the next observation is named that would settle it.
        moved: m; a join whose pose moves by more is another one.
    """

    cell: float = 0.05
    most_points: int = 1_500_000
    most_robots: int = 8
    step: float = 0.25
    turn: float = float(np.radians(15.0))
    reach: float = 30.0
    least_points: int = 500
    join: float = 0.9
    keep: float = 0.5
    open: float = 0.15
    moved: float = 1.0


LIVE = LiveSettings()


@dataclass(eq=False)
class GrowingMap:
    """The map that grows while a robot drives: one point a cell.

    Args:
        frame: of its poses, as its messages name it.
        points: (n, 3) float32 in that frame, m; `pose_of`: (n,) from which of `poses` (k, 3).
        keys: (n,) of the cells, ascending.
        grid: a map that the robot made by itself, in place of points.
        changed: since its map was made.
        left_out: points that had no room any more.
    """

    frame: str
    settings: LiveSettings = LIVE
    points: Array = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    pose_of: Array = field(default_factory=lambda: np.zeros(0, np.int32))
    poses: Array = field(default_factory=lambda: np.zeros((0, 3)))
    keys: Array = field(default_factory=lambda: np.zeros(0, np.int64))
    grid: PointCloud | None = None
    changed: bool = False
    left_out: int = 0
    last: tuple[Array, float] | None = None

    def add_scan(self, points: Array, pose: Array) -> bool:
        """Take in points (n, 3) of the sensor at a pose (4, 4); False where it has not moved on since the last one."""
        place, yaw = pose[:3, 3], float(np.arctan2(pose[1, 0], pose[0, 0]))
        if self.last is not None:
            near = float(np.linalg.norm(place - self.last[0])) < self.settings.step
            if near and abs(wrap_yaw(yaw - self.last[1])) < self.settings.turn:
                return False
        with np.errstate(invalid="ignore"):
            fine = np.linalg.norm(points, axis=1) < self.settings.reach  # not nan, either
        seen = points[fine] @ pose[:3, :3].T + place
        cells = np.floor(seen / self.settings.cell).astype(np.int64)
        inside = (np.abs(cells) < KEY_REACH).all(axis=1)
        cells, seen = cells[inside] + KEY_REACH, seen[inside]
        keys, first = np.unique((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2], return_index=True)
        at = np.searchsorted(self.keys, keys)
        new = self.keys[np.minimum(at, len(self.keys) - 1)] != keys if len(self.keys) else np.ones(len(keys), bool)
        room = max(self.settings.most_points - len(self.keys), 0)
        self.left_out += max(int(new.sum()) - room, 0)
        keys, first, at = keys[new][:room], first[new][:room], at[new][:room]
        self.last = place.copy(), yaw
        if not len(keys):
            return True
        self.poses = np.concatenate([self.poses, place[None]])
        self.keys = np.insert(self.keys, at, keys)
        self.points = np.insert(self.points, at, seen[first].astype(np.float32), axis=0)
        self.pose_of = np.insert(self.pose_of, at, np.int32(len(self.poses) - 1))
        self.changed = True
        return True

    def build_cloud(self) -> PointCloud:
        """Build the cloud of what was seen."""
        if self.grid is not None:
            return self.grid
        poses = np.tile(np.eye(4), (len(self.poses), 1, 1))
        poses[:, :3, 3] = self.poses
        return PointCloud(self.points, poses=poses, pose_of=self.pose_of, upright=True)


@dataclass(frozen=True)
class LiveLink:
    """Two robots whose maps are joined.

    Args:
        pose: takes points of the second one's frame into that of the first.
    """

    robots: tuple[str, str]
    pose: Sim3
    probability: float


def check_folder(folder: Path) -> None:
    """Check that a folder holds a state, or may hold one.

    Raises:
        InputError: it can't.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; give the name of a folder")
    if not os.access(next(place for place in (folder, *folder.absolute().parents) if place.exists()), os.W_OK):
        raise InputError(f"{folder}: can't be written; give a folder that is yours")
    empty = not folder.exists() or all(path.name.startswith(".") for path in folder.iterdir())
    if not empty and not (folder / STATE_FILE).exists():
        raise InputError(f"{folder}: holds something else, and no {STATE_FILE}; give a new folder")


@contextmanager
def hold_state(folder: Path) -> Iterator[None]:
    """Keep the state in a folder for this process: two that go on with one state would each overwrite what the other one saw.

    Raises:
        InputError: another process keeps it, or the folder can't hold a state.
    """
    check_folder(folder)
    with hold_folder(folder, "is kept by another bridge or ROS node that runs; end that, or give another folder"):
        yield


@dataclass(eq=False)
class LiveMerger:
    """The robots and what is believed of their maps.

    Args:
        folder: where the state is kept, made when there is something to keep; a state that is there is gone on with.

    Raises:
        InputError: the state is damaged, or the folder holds something else or can't be written.
    """

    folder: Path
    settings: LiveSettings = LIVE
    robots: dict[str, GrowingMap] = field(default_factory=dict)
    links: dict[tuple[str, str], LiveLink] = field(default_factory=dict)
    maps: dict[str, TopometricMap] = field(default_factory=dict)
    prepared: dict[str, Prepared] = field(default_factory=dict)
    asked: dict[tuple[str, str], tuple[Any, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._kept: dict[str, tuple[Any, ...]] = {}
        self._warned = False
        check_folder(self.folder)
        if (self.folder / STATE_FILE).exists():
            self._load()

    def get_robot(self, name: str, frame: str = "") -> GrowingMap:
        """Return the map of a robot, a new one of a new robot or in another frame.

        Raises:
            InputError: there are too many, or the name can't be that of a file.
        """
        if name not in self.robots:
            good = 0 < len(name) <= LONGEST_NAME and all(c.isalnum() or c in "-_" for c in name)
            if not good:
                raise InputError(f"robot {name[:80]!r}: a name may have letters, digits, - and _")
            if len(self.robots) >= self.settings.most_robots:
                raise InputError(f"robot {name}: is one too many; at most {self.settings.most_robots} are kept")
            self.robots[name] = GrowingMap(frame or name, self.settings)
        if frame and frame != self.robots[name].frame:
            self.robots[name] = GrowingMap(frame, self.settings)
        return self.robots[name]

    def set_grid(self, name: str, cloud: PointCloud, frame: str = "") -> None:
        """Take the map that a robot made by itself, in place of the one before."""
        robot = self.get_robot(name, frame)
        robot.grid, robot.changed = cloud, True

    def take_changed(self) -> dict[str, PointCloud]:
        """Take the clouds of the robots that moved on since the last time; nothing that comes later changes them."""
        taken = {}
        for name, robot in self.robots.items():
            if robot.changed and (robot.grid is not None or len(robot.points) >= self.settings.least_points):
                robot.changed, taken[name] = False, robot.build_cloud()
        return taken

    def update(self, clouds: Mapping[str, PointCloud] | None = None) -> list[dict[str, Any]]:
        """Make the maps of robots that moved on, register them with the others, and tell what has changed.

        Args:
            clouds: of `take_changed`; None: takes them now.
        """
        taken = self.take_changed() if clouds is None else clouds
        changed = [name for name, cloud in taken.items() if self._build_map(name, cloud)]
        events: list[dict[str, Any]] = []
        for a, b in combinations(sorted(self.maps), 2):
            if a in changed or b in changed:
                events += self._register(a, b)
        return events

    def _build_map(self, name: str, cloud: PointCloud) -> bool:
        """Make the map of a robot; False where it shows too little."""
        try:
            map = extract(cloud, name=name)
            prepared = prepare(map)
        except InputError as error:
            log.info("%s: %s", name, error)
            return False
        self.maps[name], self.prepared[name] = map, prepared
        return True

    def _register(self, a: str, b: str) -> list[dict[str, Any]]:
        """Register two maps, and tell what has changed between them."""
        before = self.links.get((a, b))
        known = [before.pose] if before is not None else []
        found = register(self.prepared[a], self.prepared[b], proposed=known, rigid=True)
        if found.transform is None:
            return self._part(a, b, 0.0) if before is not None else []
        middle = self.prepared[b].middle[None]
        if before is not None:
            away = float(np.linalg.norm(found.transform.apply(middle) - before.pose.apply(middle)))
            if found.probability < self.settings.keep or (away > self.settings.moved and found.probability < self.settings.join):
                return self._part(a, b, found.probability)
            self.links[a, b] = LiveLink((a, b), found.transform, found.probability)
            return [self._tell("moved", a, b)] if away > self.settings.moved else []
        if found.probability >= self.settings.join:
            self.links[a, b] = LiveLink((a, b), found.transform, found.probability)
            self.asked.pop((a, b), None)
            return [self._tell("joined", a, b)]
        return self._ask(a, b, found)

    def _tell(self, event: str, a: str, b: str) -> dict[str, Any]:
        link = self.links[a, b]
        message = {
            "event": event,
            "robots": [a, b],
            "probability": round(link.probability, 4),
            "matrix": link.pose.matrix.round(5),
        }
        plain: dict[str, Any] = convert_to_plain(message)
        return plain

    def _part(self, a: str, b: str, probability: float) -> list[dict[str, Any]]:
        del self.links[a, b]
        return [{"event": "parted", "robots": [a, b], "probability": round(probability, 4)}]

    def _ask(self, a: str, b: str, found: Registration) -> list[dict[str, Any]]:
        """Name the observation that would settle two maps most, once."""
        if found.probability < self.settings.open or found.transform is None:
            return []
        observations = find_observations(self.maps[a], self.maps[b], found.transform, found.posterior, found.landmarks.witnesses)
        if not observations:
            return []
        best = observations[0]
        same = (best.action, best.map, *np.round(best.at).tolist())
        if self.asked.get((a, b)) == same:
            return []
        self.asked[a, b] = same
        goal = {"robot": (a, b)[best.map], **best.serialise(), "words": best.describe((a, b))}
        return [{"event": "settle", "robots": [a, b], "probability": round(found.probability, 4), "next": goal}]

    def list_transforms(self) -> list[tuple[str, str, Sim3]]:
        """List the frames of joined robots: parent, child and the pose of the child in it; each robot has one parent at most.

        The surest links hold; a robot that comes first by its name is the root of those that are joined with it. Where frames
        of robots have one name, they are listed as ``NAME/FRAME``.
        """
        tree: dict[str, list[tuple[str, Sim3]]] = {name: [] for name in self.robots}
        group = {name: name for name in self.robots}
        for link in sorted(self.links.values(), key=lambda link: (-link.probability, link.robots)):
            a, b = link.robots
            if a not in group or b not in group or group[a] == group[b]:
                continue
            tree[a].append((b, link.pose))
            tree[b].append((a, link.pose.inverse()))
            old, new = group[b], group[a]
            group = {name: new if of == old else of for name, of in group.items()}
        out, placed, frames = [], set(), self._name_frames()
        for root in sorted(tree):
            queue = [root] if root not in placed else []
            placed.add(root)
            for parent in queue:
                for child, pose in sorted(tree[parent], key=lambda edge: edge[0]):
                    if child not in placed:
                        placed.add(child)
                        queue.append(child)
                        out.append((frames[parent], frames[child], pose))
        return out

    def _name_frames(self) -> dict[str, str]:
        """Return the names of the robots' frames, no two alike."""
        number = Counter(robot.frame for robot in self.robots.values())
        alike = {name: f"{name}/{robot.frame}" for name, robot in self.robots.items() if number[robot.frame] > 1}
        if alike and self.links and not self._warned:
            self._warned = True
            log.warning("robots %s: their frames have one name; published as %s", ", ".join(alike), ", ".join(alike.values()))
        return {name: alike.get(name, robot.frame) for name, robot in self.robots.items()}

    def save(self) -> None:
        """Write what is new of the state and the maps, if anything came; a killed process leaves each file as before or after."""
        seen = {name: robot for name, robot in self.robots.items() if len(robot.points) or robot.grid is not None}
        if not seen:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, robot in seen.items():
            now = (robot.keys, robot.grid, self.maps.get(name))  # each is replaced, never changed
            before = self._kept.get(name, ())
            if len(before) == len(now) and all(a is b for a, b in zip(before, now, strict=True)):
                continue
            arrays = {"points": robot.points, "pose_of": robot.pose_of, "poses": robot.poses, "keys": robot.keys}
            if robot.grid is not None:
                arrays["grid"] = robot.grid.points
            archive.write(arrays, self.folder / f"{name}.npz", effort=1)
            if name in self.maps:
                save_map(self.maps[name], self.folder / f"{name}.tmap")
            self._kept[name] = now
        links = [
            {"robots": list(link.robots), "matrix": link.pose.matrix.tolist(), "probability": link.probability}
            for link in self.links.values()
        ]
        frames = {name: robot.frame for name, robot in seen.items()}
        state = {"format": STATE_FORMAT, "robots": frames, "cell": self.settings.cell, "links": links}
        with replace_on_success(self.folder / STATE_FILE) as temporary:
            temporary.write_text(json.dumps(state, indent=1) + "\n", encoding="utf-8")

    def _load(self) -> None:
        path = self.folder / STATE_FILE
        try:
            state = json.loads(path.read_text(encoding="utf-8"))
            if state["format"] != STATE_FORMAT or state["cell"] != self.settings.cell:
                raise InputError(f"{path}: of another version; give another folder with -o")
            for name, frame in state["robots"].items():
                robot = self.get_robot(str(name), str(frame))
                arrays = read_robot(self.folder / f"{name}.npz")
                robot.grid = PointCloud(arrays.pop("grid"), upright=True) if "grid" in arrays else None
                for key, array in arrays.items():
                    setattr(robot, key, array)
                robot.changed = True
            for listed in state["links"]:
                a, b = map(str, listed["robots"])
                pose = Sim3.from_matrix(np.array(listed["matrix"], float))
                if a in self.robots and b in self.robots:
                    self.links[a, b] = LiveLink((a, b), pose, float(listed["probability"]))
        except InputError:
            raise
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            reason = f"{type(error).__name__}: {error}"[:120]
            raise InputError(f"{path}: damaged ({reason}); give another folder with -o") from error


def read_robot(path: Path) -> dict[str, Array]:
    """Read what a robot saw: `points`, `pose_of`, `poses` and `keys`; `grid` where it made one.

    Raises:
        InputError: damaged.
    """
    arrays = archive.read(path, "file of a robot")
    points, pose_of, poses, keys = (arrays.get(name, np.zeros(0)) for name in ("points", "pose_of", "poses", "keys"))
    shapes = points.ndim == 2 and points.shape[1:] == (3,) and poses.ndim == 2 and poses.shape[1:] == (3,)
    good = shapes and len(points) == len(pose_of) == len(keys) and pose_of.ndim == keys.ndim == 1
    good = good and bool(np.isfinite(points).all() and np.isfinite(poses).all() and (np.diff(keys) > 0).all())
    if not good or (len(pose_of) and not 0 <= int(pose_of.min()) <= int(pose_of.max()) < len(poses)):
        raise InputError(f"{path}: damaged; give another folder with -o")
    grid = arrays.get("grid", points)
    if grid.ndim != 2 or grid.shape[1:] != (3,) or not np.isfinite(grid).all():
        raise InputError(f"{path}: damaged; give another folder with -o")
    kinds = {"points": np.float32, "pose_of": np.int32, "poses": np.float64, "keys": np.int64, "grid": np.float32}
    return {name: arrays[name].astype(kind) for name, kind in kinds.items() if name in arrays}


def describe_event(event: Mapping[str, Any]) -> str:
    """Describe what has changed in a line."""
    if event["event"] == "full":
        name, points = event["robots"][0], event["points"]
        return f"{name}: its map is full ({points:,} points); what it sees elsewhere is left out: go on with it under a new name"
    a, b = event["robots"]
    text = f"{event['probability']:.2f}"
    if event["event"] == "settle":
        return f"{a} and {b} may belong together ({text}); {event['next']['words']}"
    names = {"joined": "joined", "moved": "lie otherwise now", "parted": "no longer believed to belong together"}
    return f"{a} and {b}: {names[event['event']]} ({text})"
