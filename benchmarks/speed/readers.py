"""Measure the cost of landmarks: `python -m benchmarks.speed.readers [PAGE]` reads recordings with their landmarks and without,
and counts what maps without landmarks load and call when they are merged; with a page, it writes the blocks `readers` and
`without` there.

Each recording is small, so that the costs of one picture, message or row are told. Seconds are of the processor, of all processes
that read, and the least of some runs; memory is the most that the reading process held. Each measurement is a process of its own.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from tests.fusion.atlas.atlas_scenes import office_map, truth
from tests.io.bags import walk_messages, write_bag
from tests.io.rtabmap_bases import packed, write_rtabmap
from tests.io.signs import walk_poses
from tests.io.test_bag_landmarks import corridor_messages, readings_messages
from tests.io.test_labelled_clouds import write_labelled_ply
from tests.io.test_read_rtabmap import scan_nodes
from tests.io.test_read_signs import write_corridor
from tests.io.test_rtabmap_landmarks import picture_nodes
from tests.io.walks import Walk, house_walk, write_tum
from topomerge.evaluation.documents import ROOT, build_stamp, write_blocks, write_table
from topomerge.extraction.landmarks import add_landmarks
from topomerge.io.maps import save_map
from topomerge.types import build_landmarks

COMMAND = "python -m benchmarks.speed.readers"
MODULES = ("topomerge.io.points", "topomerge.io.pictures", "topomerge.io.bag_landmarks", "topomerge.landmarks.evidence")
PICTURES = 14  # of the corridor of signs
ROWS = 100_000  # of a table
LAPS = 3  # of the walk through a house
POINTS = 1_000_000  # of a labelled cloud
PACKAGES = ("rapidocr_onnxruntime", "pupil_apriltags", "cv2", "rosbags")
READ = """
import json, resource, sys, time
from pathlib import Path
from topomerge.io.maps import load_map
from topomerge.io.points import read_points
path, options = Path(sys.argv[1]), json.loads(sys.argv[2])
usage = lambda: [resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
seconds = lambda: sum(u.ru_utime + u.ru_stime for u in usage())
began = seconds()
found = (load_map(path) if path.suffix == ".tmap" else read_points(path, **options)).landmarks
print(json.dumps([seconds() - began, max(u.ru_maxrss for u in usage()) / 1024, 0 if found is None else len(found)]))
"""
MERGE = """
import cProfile, json, pstats, sys, time
from pathlib import Path
from topomerge.fusion.pipeline import merge
from topomerge.io.maps import load_map
maps = [load_map(Path(sys.argv[1]) / f"{k}.tmap") for k in range(2)]
profile, began = cProfile.Profile(), time.process_time()
profile.runcall(merge, maps)
spent = time.process_time() - began
ours = [v for key, v in pstats.Stats(profile).stats.items() if "topomerge/landmarks/" in key[0]]
loaded = sum(name.startswith("topomerge.landmarks") for name in sys.modules)
packages = [name for name in PACKAGES if name in sys.modules]
calls, seconds = sum(v[1] for v in ours), sum(v[2] for v in ours)
print(json.dumps([len(sys.modules), loaded, ", ".join(packages) or "none", calls, f"{1000 * seconds:.1f}", f"{spent:.1f}"]))
""".replace("PACKAGES", repr(PACKAGES))


@dataclass(frozen=True)
class Recording:
    """A recording that is read with its landmarks and without.

    Args:
        what: it is, in words.
        write: writes it into a folder, with its landmarks or without; its path.
        unit: what costs are told of, and how many of these it holds; "": only the whole.
        text: does an option leave the landmarks out (``text=False``)? Else another file does.
    """

    what: str
    write: Callable[[Path, bool], Path]
    unit: tuple[str, int]
    text: bool = False


def write_table_beside(folder: Path, with_landmarks: bool) -> Path:
    """Write a cloud, and signs in a table beside it."""
    write_cloud(folder / "a.ply", "quality")
    if with_landmarks:
        rows = (f"text,{k % 1000}.{k},{k % 9},{k % 7},1.5" for k in range(ROWS))
        (folder / "a.landmarks.csv").write_text("\n".join(["kind,value,x,y,z", *rows]) + "\n")
    return folder / "a.ply"


def write_radio_beside(folder: Path, with_landmarks: bool) -> Path:
    """Write a cloud, and readings of radio and a trajectory beside it."""
    write_cloud(folder / "a.ply", "quality")
    times = np.arange(0, 1000.0)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = times / 100
    write_tum(folder / "a.poses.txt", poses, times)
    if with_landmarks:
        rows = (f"{k * 1000 / ROWS:.3f},aa:bb:cc:00:00:{k % 100:02d},{-40 - k % 50}" for k in range(ROWS))
        (folder / "a.radio.csv").write_text("\n".join(["time,bssid,rssi", *rows]) + "\n")
    return folder / "a.ply"


def write_cloud(path: Path, field: str) -> Path:
    """Write a cloud whose points have a class, in a field of that name."""
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0, 0), (20, 20, 2.5), (POINTS, 3)).astype(np.float32)
    classes = rng.integers(0, 3, POINTS)
    chairs = np.linalg.norm(points[:, :2] % 4 - 2, axis=1) < 0.4
    write_labelled_ply(path, points, np.where(chairs, 7, classes), field)
    return path


def write_classes(folder: Path, with_landmarks: bool) -> Path:
    """Write a cloud whose field is one of classes, or another one."""
    return write_cloud(folder / "a.ply", "label" if with_landmarks else "quality")


def write_bag_readings(folder: Path, with_landmarks: bool) -> Path:
    """Write a walk with WiFi, BLE and pressure at each scan, or without."""
    walk = repeat_walk()
    return write_bag(folder, "mcap", (readings_messages if with_landmarks else walk_messages)(walk))


def repeat_walk() -> Walk:
    """Return the walk through the house several times."""
    walk = house_walk()
    times = walk.times[0] + (walk.times[1] - walk.times[0]) * np.arange(LAPS * len(walk.scans))
    return Walk(walk.scans * LAPS, np.tile(walk.poses, (LAPS, 1, 1)), times)


def write_node_readings(folder: Path, with_landmarks: bool) -> Path:
    """Write a database of a laser with radio, pressure, labels and tags at each node, or without."""
    nodes = scan_nodes(repeat_walk(), "0.23.0")
    if with_landmarks:
        tag = np.eye(4)
        radio = packed(np.array([[-70.0, 6.0]]))
        more = {"sensors": [(1, -61.0, 5.0), (3, 1013.2, 5.1)], "user_data": radio, "tags": [(7, tag)]}
        nodes = [replace(node, label=f"place {k}", **more) for k, node in enumerate(nodes)]
    return write_rtabmap(folder / "a.db", nodes)


def write_map(folder: Path, with_landmarks: bool) -> Path:
    """Write a map, with landmarks or without."""
    map = office_map(0)
    at = np.random.default_rng(0).uniform(*map.grid.bounds, (ROWS, 3))
    signs = build_landmarks("text", [f"{k % 1000}.{k}" for k in range(ROWS)], "table", at)
    save_map(add_landmarks(map, signs) if with_landmarks else map, folder / "a.tmap")
    return folder / "a.tmap"


def write_pictures(folder: Path, with_landmarks: bool) -> Path:
    """Write pictures and depth of the corridor of signs as files."""
    return write_corridor(folder / "a", walk_poses(PICTURES))


def write_picture(folder: Path, with_landmarks: bool) -> Path:
    """Write one picture of them, for which the readers are loaded all the same."""
    return write_corridor(folder / "a", walk_poses(PICTURES)[:1])


def write_node_pictures(folder: Path, with_landmarks: bool) -> Path:
    """Write them as nodes of RTAB-Map."""
    return write_rtabmap(folder / "a.db", picture_nodes(walk_poses(PICTURES)))


def write_bag_pictures(folder: Path, with_landmarks: bool) -> Path:
    """Write them as topics of a bag."""
    return write_bag(folder, "mcap", corridor_messages(walk_poses(PICTURES), "images", True))


WALK = ("picture", PICTURES)
RECORDINGS = (
    Recording("signs and tags on pictures, RGB-D folder", write_pictures, WALK, True),
    Recording("the same, one picture: loading the readers", write_picture, ("picture", 1), True),
    Recording("signs and tags on pictures, RTAB-Map", write_node_pictures, WALK, True),
    Recording("signs and tags on pictures, bag", write_bag_pictures, WALK, True),
    Recording("WiFi, BLE and pressure, bag", write_bag_readings, ("scan", 0)),
    Recording("radio, pressure, labels and tags of nodes, RTAB-Map", write_node_readings, ("node", 0)),
    Recording("classes of points, PLY", write_classes, ("1,000 points", POINTS // 1000)),
    Recording("radio beside a trajectory, CSV", write_radio_beside, ("1,000 rows", ROWS // 1000)),
    Recording("table beside a scan, CSV", write_table_beside, ("1,000 rows", ROWS // 1000)),
    Recording("map of signs, .tmap", write_map, ("1,000 signs", ROWS // 1000)),
)


def run_alone(code: str, *words: str) -> list[Any]:
    """Run code in a process of its own that prints a list; a shell between, so that the memory of this one does not count."""
    command = ["sh", "-c", '"$@"; exit $?', "sh", sys.executable, "-c", code, *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    printed: list[Any] = json.loads(done.stdout.splitlines()[-1])
    return printed


def measure_reading(path: Path, options: dict[str, bool], repeat: int) -> tuple[float, float, int]:
    """Measure s of processor and MiB of reading a file, the better of some runs; and count its landmarks."""
    runs = [run_alone(READ, str(path), json.dumps(options)) for _ in range(repeat)]
    return min(r[0] for r in runs), min(r[1] for r in runs), int(runs[0][2])


def measure_readers(recordings: tuple[Recording, ...], repeat: int) -> str:
    """Measure recordings, each with its landmarks and without, as a table."""
    lines = []
    for recording in recordings:
        with TemporaryDirectory() as name:
            folders = [Path(name) / part for part in ("with", "without")]
            for folder in folders:
                folder.mkdir()
            with_landmarks = recording.write(folders[0], True)
            bare = with_landmarks if recording.text else recording.write(folders[1], False)
            without = measure_reading(bare, {"text": False} if recording.text else {}, repeat)
            own = measure_reading(with_landmarks, {}, repeat)
        unit, count = recording.unit
        count = count or len(repeat_walk().scans)
        costs = [f"{own[0] - without[0]:.2f}", f"{1000 * (own[0] - without[0]) / count:.2f}"]
        memory = [f"{without[1]:.0f}", f"{own[1] - without[1]:+.0f}"]
        lines.append([recording.what, count, unit, own[2], f"{without[0]:.2f}", *costs, *memory])
        print("#", *lines[-1], flush=True)
    heads = ["landmarks", "of", "each a", "found", "s without them", "s more", "ms each", "MiB without", "MiB more"]
    return write_table(heads, lines)


def measure_merges() -> str:
    """Measure merges of maps without landmarks and with one sign that both have, as a table."""
    lines, at = [], office_map(0).rooms["centroid"][:1] + (0, 0, 1.5)
    for words, signs in (("without landmarks", False), ("with a sign that both have", True)):
        with TemporaryDirectory() as name:
            for k in range(2):
                map, place = office_map(k), truth(0, k).inverse().apply(at)
                save_map(
                    add_landmarks(map, build_landmarks("text", ["2.113"], "hand", place)) if signs else map, f"{name}/{k}.tmap"
                )
            lines.append([words, *run_alone(MERGE, name)])
    heads = ["two maps", "modules loaded", "of these of landmarks", "packages that read signs", "calls of landmarks"]
    return write_table([*heads, "ms in these", "s of processor in all"], lines)


def main(page: str = "", most: int = len(RECORDINGS), repeat: int = 1) -> None:
    """Print the tables, of the first `most` recordings; write them into a page."""
    blocks = {"readers": measure_readers(RECORDINGS[:most], repeat), "without": measure_merges()}
    print("\n\n".join(blocks.values()))
    if page:
        write_blocks(Path(page), blocks, build_stamp(f"{COMMAND} {page}", MODULES))


if __name__ == "__main__":
    main(*sys.argv[1:2])
