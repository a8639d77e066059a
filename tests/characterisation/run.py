"""What topomerge makes of some thirty inputs, as hashes: has a change of the code changed a result?

    python tests/characterisation/run.py                       compare with expected.json; status 1 and a line for each difference
    python tests/characterisation/run.py --only merge,export   some inputs (what they are made of is made, too)
    python tests/characterisation/run.py --write               take what comes out now as what is expected

Only the faces that users have are used: the command line, the names of ``import topomerge``, ``train.py``, ``evaluate.py``
and the builder of data sets. Archives are read with NumPy.

Left out of the hashes: seconds, paths of this machine, `code` of an evaluation (a digest of the source), `key` and `made_of` of
an atlas (hashes of files that hold seconds).
Rounded to 6 digits: descriptors of rooms and what a training writes (they come from BLAS, with one thread here). All else is
hashed to the last bit. expected.json says on which machine: on another kind of processor last bits may differ.

Real data: the folder that TOPOMERGE_DATA names (/work/shared/data if it does not); without it those inputs are skipped.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any

# Before NumPy is imported: sums must not depend on how many processors there are.
THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "2"}
os.environ |= THREADS | {"PYTHONHASHSEED": "0", "MPLBACKEND": "agg", "TQDM_DISABLE": "1"}

import numpy as np  # noqa: E402

import topomerge as tm  # noqa: E402

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
EXPECTED = HERE / "expected.json"
DATA = Path(os.environ.get("TOPOMERGE_DATA") or "/work/shared/data")
LEFT_OUT = {"seconds", "key", "made_of", "rooms_per_second", "waiting"}  # keys of JSON, at any depth
DESCRIPTORS = ("learned", "engineered", "shapedna", "feather")
FORMATS = "graphml,geojson,indoorgml,dsg,ros,ply,las,ifc"

Found = dict[str, str]
INPUTS: dict[str, Callable[[], Found]] = {}
WORK = Path(tempfile.gettempdir())  # set in main
HERE_ALONE = Lock()  # for what runs in this process: matplotlib and Numba do not like two threads


# ------------------------------------------------------------------------------------------------------------------- hashes


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def cleaned(text: str) -> str:
    """Text without the paths of this machine."""
    for path, name in ((WORK, "WORK"), (WORK.resolve(), "WORK"), (DATA, "DATA"), (DATA.resolve(), "DATA"), (ROOT, "ROOT")):
        text = text.replace(str(path), name)
    return text


def array(values: Any, digits: int | None = None) -> str:
    """Type, shape and hash of an array; columns of a table one after another, so that padding does not count."""
    values = np.asarray(values)
    if values.dtype.names:
        return f"table{list(values.shape)} " + digest("".join(array(values[n]) for n in values.dtype.names).encode())
    if digits is not None and values.dtype.kind == "f":
        values = np.round(values, digits) + 0.0  # no -0
    return f"{values.dtype.str}{list(values.shape)} {digest(np.ascontiguousarray(values).tobytes())}"


def plain(value: Any, digits: int | None = None) -> Any:
    """JSON without what differs from run to run."""
    if isinstance(value, dict):
        return {k: plain(v, digits) for k, v in value.items() if k not in LEFT_OUT}
    if isinstance(value, list):
        return [plain(v, digits) for v in value]
    if isinstance(value, float) and digits is not None:
        return round(value, digits) + 0.0
    return cleaned(value) if isinstance(value, str) else value


def listing(text: str | bytes, digits: int | None = None) -> Found:
    """JSON, a hash for each key at the top."""
    told = plain(json.loads(text), digits)
    found = {k: digest(json.dumps(v, ensure_ascii=False).encode()) for k, v in told.items()}
    return {"keys": ",".join(told), **found}


def named(prefix: str, found: Found) -> Found:
    return {f"{prefix}/{k}": v for k, v in found.items()}


def map_file(path: Path) -> Found:
    """Every array of a .tmap; tables column by column."""
    found: Found = {}
    with np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            values = archive[name]
            if name == "about":
                found |= named("about", listing(values.item()))
            elif values.dtype.names:
                found |= {f"{name}.{column}": array(values[column]) for column in values.dtype.names}
            else:
                found[name] = array(values)
    return found


def text_file(path: Path) -> str:
    return digest(cleaned(path.read_bytes().decode("latin-1")).encode())


def picture(path: Path) -> str:
    from PIL import Image

    with Image.open(path) as image:
        return array(np.asarray(image))


def cloud(value: Any, name: str = "") -> Found:
    """Every field of a point cloud (or of a dataclass in it)."""
    found: Found = {}
    for field in fields(value):
        inner, key = getattr(value, field.name), f"{name}{field.name}"
        if inner is None or (isinstance(inner, tuple | dict | str) and not inner):
            continue
        if is_dataclass(inner):
            found |= cloud(inner, f"{key}.")
        elif isinstance(inner, np.ndarray):
            found[key] = array(inner)
        elif isinstance(inner, dict):
            found |= {f"{key}.{k}": array(v) for k, v in inner.items()}
        elif isinstance(inner, tuple) and is_dataclass(inner[0]):
            found[key] = digest(repr([sorted(cloud(one).items()) for one in inner]).encode())
        else:
            found[key] = digest(cleaned(repr(inner)).encode())
    return found


def merged(folder: Path) -> Found:
    """The folder of a merge. Its report holds seconds; see `pages`."""
    told = json.loads((folder / "merge.json").read_text())
    rooms = f"{len(told['matches'])} matches"
    found = {"verdict": f"{told['status']} {told['probability']:.3f}, {rooms}", "files": " ".join(files(folder))}
    found |= named("merge.json", listing(json.dumps(told)))
    if (folder / "map.tmap").exists():
        found |= named("map.tmap", map_file(folder / "map.tmap")) | {"merged.ply": text_file(folder / "merged.ply")}
    return found


def files(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


# ----------------------------------------------------------------------------------------------------------------- commands


class Done:
    """What a command said."""

    def __init__(self, words: list[str], status: int, out: str, err: str) -> None:
        self.words, self.status, self.out, self.err = words, status, out, err

    def said(self) -> Found:
        """Exit status and its own lines on stderr (not those of libraries)."""
        lines = [line for line in cleaned(self.err).splitlines() if line.startswith("topomerge:")]
        return {"status": str(self.status), "warnings": digest("\n".join(lines).encode()) if lines else "none"}


def python(*words: Any, cwd: Path | None = None, status: tuple[int, ...] = (0,)) -> Done:
    texts = [str(w) for w in words]
    done = subprocess.run([sys.executable, *texts], cwd=cwd or WORK, capture_output=True, text=True)
    if done.returncode not in status:
        raise RuntimeError(f"status {done.returncode} of {' '.join(texts)}\n{done.stderr[-2000:]}")
    return Done(texts, done.returncode, done.stdout, done.stderr)


def command(*words: Any) -> Done:
    """topomerge ... in the temporary folder; relative paths are in it."""
    return python("-m", "topomerge", *words, status=(0, 2))


LOCKS: dict[Any, Lock] = {}
LOCKS_ALONE = Lock()


def once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Made when first asked for, by one thread; the others wait."""
    kept = cache(function)

    def call(*args: Any) -> Any:
        with LOCKS_ALONE:
            lock = LOCKS.setdefault((function, args), Lock())
        with lock:
            return kept(*args)

    return call


@once
def simulated(name: str, *words: str) -> str:
    """The folder of a simulated pair."""
    command("simulate", *words, "-q", "-o", name)
    return name


@once
def extracted(scan: str, name: str, *words: str) -> tuple[str, Found]:
    """A map of a file, and what the command said."""
    done = command("extract", scan, "-o", f"{name}.tmap", "-q", *words)
    return f"{name}.tmap", done.said()


def small(sensors: str, seed: int = 3, building: str = "house", rooms: int = 4, *more: str) -> str:
    """A simulated pair of a small building; the same seed gives the same building."""
    name = "_".join([building, str(seed), str(rooms), sensors.replace(",", "_"), *(w.strip("-") for w in more)])
    words = ("--building", building, "--seed", str(seed), "--rooms", str(rooms), "--sensors", sensors, *more)
    return str(simulated(name, *words))


def house() -> str:
    return small("tls,depth", 3, "house", 4, "--overlap", "0.5")


def slice_pair() -> str:
    return small("tls,laser2d", 3, "house", 4, "--overlap", "0.6")


def house_map(which: str) -> str:
    """Maps of one house, each in its own frame: a (tls), b (depth), c (a slice); s is a stranger."""
    folder = {"c": slice_pair, "s": lambda: strangers("other-building")}.get(which, house)()
    return str(extracted(f"{folder}/{'b' if which in 'cs' else which}.ply", f"house_{which}")[0])


def strangers(kind: str) -> str:
    return small("tls,depth", 3, "office", 4, "--hard", kind)


@cache
def real(path: str) -> str:
    return str(DATA / path)


def extraction(scan: str, name: str, *words: str) -> Found:
    path, said = extracted(scan, name, *words)
    return said | map_file(WORK / path)


def entry(function: Callable[[], Found]) -> Callable[[], Found]:
    INPUTS[function.__name__] = function
    return function


# --------------------------------------------------------------------------------------------------------- made by hand here


def box(count: int = 600) -> tuple[np.ndarray, np.ndarray]:
    """Points on a box of 4 x 3 x 2.5 m, and colours."""
    rng = np.random.default_rng(0)
    points, axis = rng.uniform(0, 1, (count, 3)), rng.integers(0, 3, count)
    points[np.arange(count), axis] = rng.integers(0, 2, count)
    return (points * (4, 3, 2.5)).astype(np.float32), rng.integers(0, 256, (count, 3)).astype(np.uint8)


@cache
def house_points() -> np.ndarray:
    with HERE_ALONE:
        return np.asarray(tm.read_points(WORK / house() / "a.ply").points)


def write_pcd(path: Path, points: np.ndarray, colors: np.ndarray, kind: str) -> None:
    packed = (colors.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(axis=1).astype(np.uint32).view(np.float32)
    rows = np.column_stack([points.astype(np.float32), packed])
    header = "VERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    header += f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0.5 0 1 1 0 0 0\nPOINTS {len(rows)}\nDATA {kind}\n"
    if kind == "ascii":
        body = "".join(" ".join(f"{v:.9g}" for v in row) + "\n" for row in rows).encode()
    elif kind == "binary":
        body = rows.tobytes()
    else:  # LZF of literals only
        raw = rows.T.tobytes()
        runs = b"".join(bytes([len(raw[i : i + 32]) - 1]) + raw[i : i + 32] for i in range(0, len(raw), 32))
        body = np.array([len(runs), len(raw)], "<u4").tobytes() + runs
    path.write_bytes(header.encode() + body)


def write_ply(path: Path, points: np.ndarray, colors: np.ndarray, ascii: bool) -> None:
    header = f"ply\nformat {'ascii' if ascii else 'binary_big_endian'} 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property {'float' if ascii else 'double'} {a}\n" for a in "xyz")
    header += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    rows = np.zeros(len(points), [(a, ">f8") for a in "xyz"] + [(c, "u1") for c in "rgb"])
    for i in range(3):
        rows["xyz"[i]], rows["rgb"[i]] = points[:, i], colors[:, i]
    table = zip(points.tolist(), colors.tolist(), strict=True)
    lines = "".join(" ".join(map(str, [*p, *c])) + "\n" for p, c in table)
    path.write_bytes(header.encode() + (lines.encode() if ascii else rows.tobytes()))


def write_las(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    import laspy

    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [1e-4] * 3, np.floor(points.min(axis=0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.asarray(points, float).T
    las.red, las.green, las.blue = colors.astype(np.uint16).T * 257
    las.write(str(path))


def write_e57(path: Path, points: np.ndarray, stations: np.ndarray) -> None:
    """Scans of the points that are nearest to each station, in frames turned by 0.4, 0.8, ..."""
    import pye57

    nearest = np.linalg.norm(points[:, None, :2] - stations[None, :, :2], axis=2).argmin(axis=1)
    file = pye57.E57(str(path), mode="w")
    for k, station in enumerate(stations):
        angle = 0.4 * (k + 1)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        own = (points[nearest == k] - station) @ turn
        data = {f"cartesian{a}": np.ascontiguousarray(own[:, i], float) for i, a in enumerate("XYZ")}
        quaternion = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
        file.write_scan_raw(data, rotation=quaternion, translation=np.asarray(station, float))
    file.close()


def flat_mesh() -> Any:
    """Four rooms with doors, floor and ceiling, of boxes; z up."""
    import trimesh

    def block(x0: float, y0: float, z0: float, x1: float, y1: float, z1: float) -> Any:
        low, high = np.array([x0, y0, z0]), np.array([x1, y1, z1])
        made = trimesh.creation.box(high - low)
        made.apply_translation((low + high) / 2)
        return made

    parts = [block(0, 0, -0.2, 9.2, 7.2, 0), block(0, 0, 2.6, 9.2, 7.2, 2.8)]
    parts += [block(0, 0, 0, 9.2, 0.1, 2.6), block(0, 7.1, 0, 9.2, 7.2, 2.6)]
    parts += [block(0, 0, 0, 0.1, 7.2, 2.6), block(9.1, 0, 0, 9.2, 7.2, 2.6)]
    for y0, y1 in ((0, 1.4), (2.3, 5), (5.9, 7.2)):  # doors between west and east
        parts.append(block(4, y0, 0, 4.1, y1, 2.6))
    for x0, x1 in ((0, 1.5), (2.4, 9.2)):  # one between south and north, in the west
        parts.append(block(x0, 3.5, 0, x1, 3.6, 2.6))
    parts += [block(4, 1.4, 2.1, 4.1, 2.3, 2.6), block(4, 5, 2.1, 4.1, 5.9, 2.6), block(1.5, 3.5, 2.1, 2.4, 3.6, 2.6)]
    parts += [block(6, 1, 0, 7.4, 1.8, 0.75), block(0.4, 5.5, 0, 0.9, 7, 1.9)]
    return trimesh.util.concatenate(parts)


# ------------------------------------------------------------------------------------------------------------------- inputs


@entry
def read() -> Found:
    """One small file of every format, by `read_points`, and one by `read_chunks`."""
    import trimesh

    folder = WORK / "read"
    folder.mkdir()
    points, colors = box()
    write_ply(folder / "ascii.ply", points, colors, ascii=True)
    write_ply(folder / "big.ply", points, colors, ascii=False)
    for kind in ("ascii", "binary", "binary_compressed"):
        write_pcd(folder / f"{kind}.pcd", points, colors, kind)
    np.savetxt(folder / "table.xyz", points, fmt="%.6f")
    columns = np.hstack([points, colors])
    np.savetxt(folder / "table.csv", columns, fmt="%.6f", delimiter=",", header="x,y,z,r,g,b", comments="")
    np.savez(folder / "array.npz", points=points, colors=colors)
    np.save(folder / "array.npy", points)
    np.save(folder / "far.npy", points.astype(float) + (456_789.0, 5_432_100.0, 80.0))
    np.save(folder / "holes.npy", np.where(np.arange(1800).reshape(600, 3) % 97, points, np.nan))
    write_las(folder / "cloud.las", points, colors)
    write_las(folder / "cloud.laz", points, colors)
    write_e57(folder / "cloud.e57", points, np.array([[1.0, 1, 1], [3, 2, 1.5]]))
    mesh = trimesh.creation.box((4, 3, 2.5))
    for suffix in ("ply", "obj", "stl", "glb"):
        mesh.export(str(folder / f"mesh.{suffix}"))
    tree = b"# Octomap OcTree binary file\n#\nid OcTree\nsize 22\nres 0.1\ndata\n" + b"\x03\x00" * 15 + b"\x6a\x81"
    (folder / "tree.bt").write_bytes(tree)
    pixels = np.full((30, 40), 205, np.uint8)
    pixels[5:25, 5:35], pixels[6:24, 6:34] = 0, 254
    (folder / "plan.pgm").write_bytes(b"P5\n40 30\n255\n" + pixels.tobytes())
    yaml = "image: plan.pgm\nresolution: 0.1\norigin: [-2.0, -1.0, 0.3]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    (folder / "plan.yaml").write_text(yaml)
    command("export", house_map("a"), "--to", "ifc,las,ply", "-o", "read/out/", "-q")
    options: dict[str, dict[str, Any]] = {
        "plan.pgm": {"resolution": 0.05, "ceiling": True, "extrude": 2.2},
        "mesh.obj": {"up": "y", "spacing": 0.1},
        "mesh.stl": {"unit": "ft", "scale": 1.5},
        "array.npy": {"up": "-x", "unit": "cm", "scale": 100},
    }
    found: Found = {}
    with HERE_ALONE:
        for name in files(folder):
            found |= named(name, cloud(tm.read_points(folder / name, **options.get(name, {}))))
        doors = tm.read_points(next((folder / "out").glob("*.ifc")), doors=True, spacing=0.1)
        found |= named("doors.ifc", cloud(doors))
        for name in ("big.ply", "cloud.las", "table.csv"):
            chunks = [chunk.points for chunk in tm.read_chunks(folder / name, chunk=170)]
            found[f"chunks/{name}"] = f"{len(chunks)} {array(np.concatenate(chunks))}"
    return found


@entry
def simulate() -> Found:
    """Clouds, truth and picture of simulated pairs, one of each kind."""
    found: Found = {}
    kinds = {"pair": house(), "slice": slice_pair(), "free": free_pair(), "storeys": storeys()}
    kinds |= {kind: strangers(kind) for kind in ("other-building", "other-storey", "twin-wing")}
    for name, folder in kinds.items():
        for file in files(WORK / folder):
            path = WORK / folder / file
            if path.suffix == ".ply":
                found[f"{name}/{file}"] = digest(path.read_bytes())
            elif path.suffix == ".png":
                found[f"{name}/{file}"] = picture(path)
            else:
                found |= named(f"{name}/{file}", listing(path.read_text()))
    return found


@entry
def extract_ply() -> Found:
    """A simulated scan: the map, its listing, its cells, its figure, its report."""
    words = ("--json", "ply.json", "--ply", "ply_rooms.ply", "--figure", "ply.png", "--report", "ply.html")
    found = extraction(f"{house()}/a.ply", "ply", *words)
    found |= named("json", listing((WORK / "ply.json").read_text()))
    info = command("info", "ply.tmap")
    found["info"] = digest(info.out.partition("\nseconds")[0].encode())
    found |= named("info.json", listing(command("info", "ply.tmap", "--json").out))
    found |= {"ply": digest((WORK / "ply_rooms.ply").read_bytes()), "figure": picture(WORK / "ply.png")}
    with HERE_ALONE:
        map = replace(tm.load_map(WORK / "ply.tmap"), seconds={})
        tm.save_report(map, WORK / "timeless.html")
        tm.save_map(map, WORK / "timeless.tmap")
        grid = tm.voxelise(tm.read_points(WORK / house() / "a.ply"), 0.15)
        found |= {"report": text_file(WORK / "timeless.html"), "saved": digest((WORK / "timeless.tmap").read_bytes())}
        found |= named("voxelise", cloud(grid))
        coarse = tm.extract(grid, name="coarse")
        found["coarse"] = digest(json.dumps(plain(tm.map_to_json(coarse)), default=str).encode())
    return found


@entry
def extract_thesis() -> Found:
    return extraction(f"{house()}/a.ply", "thesis", "--preset", "thesis")


@entry
def extract_depth() -> Found:
    """A depth camera, cells of 0.15 m."""
    return extraction(f"{house()}/b.ply", "depth", "--voxel-size", "0.15")


@entry
def extract_storeys() -> Found:
    """Two storeys with stairs, by a lidar that is carried."""
    return extraction(f"{storeys()}/a.ply", "storeys")


def storeys() -> str:
    return small("lidar", 5, "house", 8, "--storeys", "2")


@entry
def extract_slice() -> Found:
    """A 2D laser."""
    return extraction(f"{slice_pair()}/b.ply", "house_c")


@entry
def extract_e57() -> Found:
    """Two scans with their poses."""
    path = WORK / "two.e57"
    points = house_points()[::2]
    middle, side = points.mean(axis=0), points.std(axis=0)
    write_e57(path, points, np.array([middle - side * (1, 0, 0), middle + side * (1, 0, 0)]))
    return extraction("two.e57", "e57")


@entry
def extract_pcd() -> Found:
    """Centimetres, y up."""
    points = house_points() * 100
    write_pcd(WORK / "cm.pcd", points[:, [0, 2, 1]] * (1, 1, -1), np.zeros((len(points), 3), np.uint8), "binary")
    return extraction("cm.pcd", "pcd", "--unit", "cm", "--up", "y")


@entry
def extract_mesh() -> Found:
    """glTF (y up) and STL in millimetres of the same four rooms."""
    mesh = flat_mesh()
    turned = mesh.copy()
    turned.apply_transform(np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]]))
    turned.export(str(WORK / "flat.glb"))
    mesh.apply_scale(1000)
    mesh.export(str(WORK / "flat.stl"))
    found = named("glb", extraction("flat.glb", "glb"))
    return found | named("stl", extraction("flat.stl", "stl", "--unit", "mm", "--spacing", "0.08"))


@entry
def extract_grid() -> Found:
    """map_server: the pgm and yaml that `export --to ros` makes."""
    return extraction(drawing(), "grid", "--ceiling")


@once
def drawing() -> str:
    command("export", house_map("a"), "--to", "ros", "-o", "drawn/", "-q")
    return "drawn/" + next(f for f in files(WORK / "drawn") if f.endswith(".yaml"))


@entry
def extract_laz_real() -> Found:
    return extraction(real("scans_real_3d/atrium_two_storeys_2cm.laz"), "atrium")


@entry
def extract_ifc_real() -> Found:
    return extraction(real("ifc_buildings/ExampleHOM.ifc"), "ifc")


@entry
def extract_octomap_real() -> Found:
    return extraction(real("octomap_freiburg078/fr_078_tidyup.bt"), "octomap")


@entry
def extract_tablet_real() -> Found:
    """On its side, without a floor."""
    return extraction(real("ipad_lidar_rooms/user/807-60.ply"), "tablet", "--up", "y")


@entry
def extract_png_real() -> Found:
    """A robot's map and a drawing of one apartment."""
    return named("map", extraction(*apartment("01"))) | named("drawing", extraction(*apartment("layout")))


def apartment(which: str) -> tuple[str, str, str, str]:
    folder = "halmstad_robot_maps/maps/HIH/"
    file = "layout/HIH_layout.png" if which == "layout" else f"pseudo_occupancy/HIH_{which}.png"
    return real(folder + file), f"apartment_{which}", "--resolution", "0.02"


@entry
def embed() -> Found:
    """Each descriptor, with and without context."""
    found: Found = {}
    for name in DESCRIPTORS:
        for k in (0, 1):
            command("embed", house_map("a"), "--descriptor", name, "--k", k, "-o", f"{name}{k}.npy", "-q")
            found[f"{name}_k{k}"] = array(np.load(WORK / f"{name}{k}.npy"), 6)
    return found


@entry
def match() -> Found:
    """Each method and each descriptor, unknown scale, and the table."""
    a, b = house_map("a"), house_map("b")
    found: Found = {"table": digest(command("match", a, b).out.encode())}
    for method in ("consistent", "growing", "assignment"):
        found |= named(method, listing(command("match", a, b, "--json", "--method", method).out, 6))
    for descriptor in DESCRIPTORS[1:]:
        found |= named(descriptor, listing(command("match", a, b, "--json", "--descriptor", descriptor).out, 6))
    found |= named("free", listing(command("match", a, b, "--json", "--scale", "free", "--k", "1").out, 6))
    return found


@entry
def match_thesis() -> Found:
    """The method of the thesis, on coarse maps: its descriptor takes long."""
    a, b = (extracted(f"{house()}/{side}.ply", f"coarse_{side}", "--voxel-size", "0.2")[0] for side in "ab")
    return listing(command("match", a, b, "--json", "--method", "thesis").out, 6)


def merge_of(name: str, *words: Any) -> Found:
    done = command("merge", *words, "-o", f"merge_{name}", "-q")
    return done.said() | merged(WORK / f"merge_{name}")


@entry
def merge() -> Found:
    """A laser scanner and a depth camera."""
    return merge_of("house", house_map("a"), house_map("b"))


@entry
def merge_clouds() -> Found:
    """The same from clouds, with coarse cells, another descriptor and unknown scale."""
    folder = house()
    words = ("--scale", "free", "--voxel-size", "0.12", "--descriptor", "engineered", "--threshold", "0.3")
    return merge_of("clouds", f"{folder}/a.ply", f"{folder}/b.ply", *words)


@entry
def merge_rooms() -> Found:
    """Poses of matched rooms, as in the thesis."""
    return merge_of("rooms", house_map("a"), house_map("b"), "--poses", "rooms")


@entry
def merge_free() -> Found:
    """A monocular camera of unknown scale."""
    folder = free_pair()
    return merge_of("free", f"{folder}/a.ply", f"{folder}/b.ply", "--scale", "free", "--threshold", "0.5")


def free_pair() -> str:
    return small("tls,mono", 3, "house", 4, "--overlap", "0.6", "--scale", "free")


@entry
def merge_slice() -> Found:
    """A slice and a scan: heights are assumed."""
    return merge_of("slice", house_map("a"), house_map("c"))


@entry
def merge_drawing() -> Found:
    """A drawing and a scan; not believed, but written."""
    return merge_of("drawing", extracted(drawing(), "drawing")[0], house_map("b"), "--force")


@entry
def merge_strangers() -> Found:
    """Two offices, two storeys of one, twin wings: to be refused."""
    found: Found = {}
    for kind in ("other-building", "other-storey", "twin-wing"):
        found |= named(kind, merge_of(kind, f"{strangers(kind)}/a.ply", f"{strangers(kind)}/b.ply"))
    return found


@entry
def merge_three() -> Found:
    return merge_of("three", *(house_map(k) for k in "abcs"))


@entry
def merge_maps_real() -> Found:
    """Maps of an apartment by a robot, and its drawing, which is not to scale."""
    maps = {k: extracted(*apartment(k))[0] for k in ("01", "02", "layout")}
    found = named("robots", merge_of("robots", maps["02"], maps["01"]))
    return found | named("drawing", merge_of("layout", maps["01"], maps["layout"], "--scale", "free"))


@entry
def pages() -> Found:
    """Reports of merges and atlases, by the package: without seconds."""
    found: Found = {}
    names = {k: house_map(k) for k in "abs"}
    with HERE_ALONE:
        maps = {k: replace(tm.load_map(WORK / name), seconds={}) for k, name in names.items()}
        for name, pair in (("merged", "ab"), ("refused", "as")):
            result = tm.merge([maps[k] for k in pair])
            joined = replace(result.map, seconds={}) if result.map is not None else None
            replace(result, seconds={}, map=joined).save(WORK / f"page_{name}")
            found |= {f"{name}/{f}": text_file(WORK / f"page_{name}" / f) for f in ("report.html", "merge.json")}
        result = tm.atlas([maps[k] for k in "abs"])
        joined_maps = {0: replace(result.joined(0), seconds={})}
        page = tm.atlas_html(replace(result, seconds=0.0), joined_maps)
        found |= {"atlas": digest(cleaned(page).encode()), "words": digest(result.words().encode())}
    return found


@entry
def atlas() -> Found:
    """Three maps and a stranger; one is taken out again."""
    found = named("add", command("atlas", "add", "atlas", *(house_map(k) for k in "abcs"), "-q").said())
    found["list"] = digest(command("atlas", "list", "atlas").out.encode())
    found |= named("atlas.json", listing(command("atlas", "list", "atlas", "--json").out))
    found["files"] = " ".join(files(WORK / "atlas"))
    found |= named("map_0", map_file(WORK / "atlas/map_0.tmap")) | {"ply": digest((WORK / "atlas/merged_0.ply").read_bytes())}
    found |= named("remove", command("atlas", "remove", "atlas", "house_b", "-q").said())
    found |= named("removed.json", listing(command("atlas", "list", "atlas", "--json").out))
    return found | named("removed_0", map_file(WORK / "atlas/map_0.tmap"))


@entry
def export() -> Found:
    """Every format, of one storey and of two; with an origin."""
    two = extracted(f"{storeys()}/a.ply", "storeys")[0]
    command("export", house_map("a"), "--to", FORMATS, "-o", "exported/one/", "-q")
    command("export", two, "--to", FORMATS, "-o", "exported/two/", "-q")
    command("export", two, "--to", "geojson,ros", "--storey", "1", "--origin", "52.52,13.405,12.5", "-o", "exported/upper/", "-q")
    return {name: text_file(WORK / "exported" / name) for name in files(WORK / "exported")}


def builder() -> str:
    """The module that builds data sets, wherever it lies: the one name here that is expected to move."""
    for name in ("topomerge.datasets.build", "topomerge.datasets.pairs.build"):
        with suppress(ModuleNotFoundError):
            if find_spec(name):
                return name
    raise RuntimeError("no builder of data sets; name its module in `builder`")


@entry
def train() -> Found:
    """One pair by the builder of data sets, and two epochs on it."""
    words = ("data=procedural", "data.pairs=1", "data.rooms=[4,5]", "cache=built")
    python("-m", builder(), *words, cwd=WORK)
    pairs = sorted((WORK / "built/pairs").iterdir())
    found: Found = {"pairs": str(len(pairs))}
    for k, line in enumerate((WORK / "built/procedural.jsonl").read_text().splitlines()):
        found |= named(f"manifest{k}", listing(line))
    for k, path in enumerate(pairs):
        with np.load(path, allow_pickle=False) as archive:
            found |= {f"pair{k}/{name}": array(archive[name]) for name in archive.files if name != "about"}
            found |= named(f"pair{k}/about", listing(archive["about"].tobytes()))
    found = {k: v for k, v in found.items() if not k.endswith("/file")}  # a name in the cache: a digest that may count code in
    common = ("experiment=gat_scalars", "validation=procedural", "tensorboard=false", "epochs=2", "name=x")
    python(ROOT / "train.py", *words[:3], f"cache={WORK / 'built'}", f"runs={WORK / 'runs'}", *common, cwd=WORK)
    for k, line in enumerate((WORK / "runs/x/metrics.jsonl").read_text().splitlines()):
        found |= named(f"epoch{k}", listing(line, 6))
    from safetensors.numpy import load_file

    weights = load_file(str(WORK / "runs/x/best/embedder.safetensors"))
    found |= {f"weights/{name}": array(values, 6) for name, values in weights.items()}
    command("export-embedder", "runs/x", "-o", "embedder")
    command("embed", house_map("a"), "--descriptor", "embedder", "-o", "trained.npy", "-q")
    return found | {"embed": array(np.load(WORK / "trained.npy"), 6)}


@entry
def evaluate() -> Found:
    """Scores of a descriptor on one pair; not the short tables, which hold seconds."""
    words = ("data=heldout_small", "data.pairs=1", "data.rooms=[4,5]", "only=[engineered]", "k=[0]", "context=[mean]")
    more = ("methods=[assignment,consistent]", f"cache={WORK / 'judged'}", f"folder={WORK / 'eval'}", "name=x", "rounds=50")
    python(ROOT / "evaluate.py", *words, *more, cwd=WORK)
    found: Found = {}
    for name in ("matches", "merges", "ranks", "scores"):
        with (WORK / f"eval/x/{name}.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if "second" not in row.get("metric", "")]
        for column in rows[0]:
            if "second" not in column and column != "code":
                found[f"{name}.{column}"] = f"{len(rows)} {digest(json.dumps([row[column] for row in rows]).encode())}"
    return found


# --------------------------------------------------------------------------------------------------------------------- main


def about() -> dict[str, str]:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    model = next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.processor())
    packages = ("numpy", "scipy", "numba", "shapely", "torch", "matplotlib", "networkx", "laspy", "ifcopenshell", "trimesh")
    found = {"python": platform.python_version(), "processor": model}
    for name in packages:
        try:
            found[name] = version(name)
        except Exception:  # not installed
            found[name] = "none"
    return found


def made(name: str) -> tuple[str, Found, float]:
    began = time.monotonic()
    try:
        found = INPUTS[name]()
    except Exception as error:  # the other inputs are to run
        found = {"error": f"{type(error).__name__}: {error}"}
    print(f"{time.monotonic() - began:6.1f} s  {name}{'  FAILED' if 'error' in found else ''}", file=sys.stderr, flush=True)
    return name, found, time.monotonic() - began


def main() -> int:
    global WORK
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write expected.json")
    parser.add_argument("--only", default="", metavar="NAME,NAME", help=f"of {' '.join(INPUTS)}")
    parser.add_argument("--jobs", type=int, default=2, help="commands at once (default 2)")
    args = parser.parse_args()
    names = [n for n in args.only.split(",") if n] or list(INPUTS)
    if unknown := set(names) - set(INPUTS):
        parser.error(f"no input {', '.join(sorted(unknown))}; there are {', '.join(INPUTS)}")
    if not DATA.is_dir():
        print(f"skipped, as {DATA} is not there: {' '.join(n for n in names if n.endswith('_real'))}", file=sys.stderr)
        names = [n for n in names if not n.endswith("_real")]
    if Path(str(tm.__file__)).resolve().parent.parent != ROOT:
        print(f"note: topomerge is that of {Path(str(tm.__file__)).parent}, not of {ROOT}", file=sys.stderr)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="characterisation") as folder:
        WORK = Path(folder).resolve()
        with ThreadPoolExecutor(args.jobs) as pool:
            found = {name: values for name, values, _ in pool.map(made, names)}
    print(f"{time.monotonic() - began:6.1f} s  all, of {Path(str(tm.__file__)).parent}", file=sys.stderr)
    failed = {n: v["error"] for n, v in found.items() if "error" in v}
    for name, words in failed.items():
        print(f"{name}: {words}")
    known = json.loads(EXPECTED.read_text()) if EXPECTED.exists() else {"about": {}, "results": {}}
    if args.write:
        if failed:
            return 1
        results = {**known["results"], **found} if args.only else found
        results = {name: dict(sorted(results[name].items())) for name in sorted(results)}
        EXPECTED.write_text(json.dumps({"about": about(), "results": results}, indent=1) + "\n")
        print(f"{sum(map(len, found.values()))} hashes of {len(found)} inputs -> {EXPECTED}")
        return 0
    return compared(found, known)


def compared(found: dict[str, Found], known: dict[str, Any]) -> int:
    if other := {k: v for k, v in about().items() if v != known["about"].get(k)}:
        print(f"note: expected.json is of another machine: {', '.join(f'here {k} {v}' for k, v in other.items())}")
    count = 0
    for name, values in found.items():
        expected = known["results"].get(name, {})
        for key in sorted(values.keys() | expected.keys()):
            if values.get(key) != expected.get(key):
                count += 1
                print(f"{name}/{key}: expected {expected.get(key, 'nothing')}, found {values.get(key, 'nothing')}")
    total = sum(map(len, found.values()))
    print(f"{count} of {total} differ" if count else f"all {total} hashes of {len(found)} inputs are as expected")
    return 1 if count else 0


if __name__ == "__main__":
    sys.exit(main())
