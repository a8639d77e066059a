"""Small valid files of every format that a stranger may hand us, and what reads each."""

from __future__ import annotations

import io
import json
import shutil
import tarfile
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from tests import samples
from tests.scenes_map import building
from topomerge.edits.journal import Edit
from topomerge.errors import InputError
from topomerge.types import TopometricMap, clean_landmarks

MOST_TAKEN = 5_000_000  # points that are taken of a file; the rest of a large surface is no danger, as it comes in portions


OWN_PAIRS = """\
captures:
  - {file: pairs.yaml, building: home, storey: 1, frame: survey, sensor: tls}
  - {name: b, file: pairs.yaml, building: home, frame: survey, read: {up: y}}
  - {name: c, file: pairs.yaml, building: home}
  - {name: d, file: pairs.yaml, building: other}
pairs:
  - {a: pairs, b: c, transform: {x: 1.5, y: -2, z: 0, yaw_deg: 30, scale: 1}}
  - {a: b, b: c, rooms: [[0, 3], [2, 5]]}
  - {a: c, b: d, different: true}
split: {train: 0.6, val: 0.2, test: 0.2, seed: 0}
negatives: 0.25
"""
PARTNERS = {"plan.yaml": "plan.pgm", "embedder.onnx": "embedder.card.json", "embedder.card.json": "embedder.onnx"}


def read_cloud(path: Path) -> int:
    """Read points as a command does, portion by portion."""
    from topomerge.io import read_chunks

    image = path.suffix in (".pgm", ".png", ".jpg", ".tif", ".bmp")
    found = 0
    for chunk in read_chunks(path, resolution=0.1 if image else None, spacing=2.0, chunk=1 << 19):
        found += len(chunk)
        if found > MOST_TAKEN:
            break
    return found


def read_las(path: Path) -> int:
    """Read points, and write them elsewhere with all else that the file says of them."""
    from topomerge.io.transformed_points import save_transformed_points

    found = read_cloud(path)
    with tempfile.TemporaryDirectory() as folder:
        save_transformed_points(path, Path(folder) / f"moved{path.suffix}", lambda points: points, np.zeros(3))
    return found


def read_native(path: Path) -> int:
    """Write a file of another program again, moved, and joined with itself where its format holds several."""
    from topomerge.io.native import Motion, Source, find_format, save_joined, usdz
    from topomerge.types import Sim3

    usdz.compute_in_subprocess = lambda _module, _kind, _path, task, *_: usdz.compute_in_process(task)

    form = find_format(path)
    if form is None:
        raise InputError(f"{path}: can't be written again")
    moved = Source(path, Motion(Sim3(0.5, (1.0, 2.0, 3.0)).matrix))
    with tempfile.TemporaryDirectory() as folder:
        tally = save_joined(form, [Source(path), moved] if form.joins else [moved], Path(folder) / f"out{path.suffix}")
    return sum(after for _, after in tally.counts.values())


def read_bag(path: Path) -> int:
    """Read points of a bag in this process: one of its own takes seconds."""
    from topomerge.io import bag

    bag.read_in_subprocess = lambda _module, _kind, path, options, **_: bag.read_in_process(path, options)
    return read_cloud(path)


def read_usdz(path: Path) -> int:
    """Read a scene in this process, after the checks that come before."""
    from topomerge.io import usdz

    usdz.read_in_subprocess = lambda _module, _kind, path, options, *_: usdz.read_in_process(path, options)
    return read_cloud(path)


def read_plan(path: Path) -> int:
    """Read a plan in this process, a page without the network."""
    from tests.io.cad_plans import parse_dark_lines
    from topomerge.io import drawing, dxf, pdf, svg

    drawing.parse_drawing = parse_dark_lines
    drawing.load_text_reader = lambda **_: None
    here = {"dxf": dxf, "pdf": pdf, "svg": svg}
    for module in here.values():
        module.read_in_subprocess = lambda name, _kind, path, options, *_: here[name].read_in_process(path, options)
    return read_cloud(path)


def read_map(path: Path) -> int:
    """Read a map, what `topomerge info` prints of it, and how the maps that it was joined of were bent."""
    from topomerge.fusion.result import read_bends
    from topomerge.io.listing import convert_map_to_json, format_json, format_map
    from topomerge.io.maps import load_map

    found = load_map(path)
    format_map(found)
    format_json(convert_map_to_json(found))
    read_bends(found)
    return len(found.rooms)


def read_plans(path: Path) -> int:
    """Read a file of floor plans of a data set."""
    from topomerge.datasets.plans.floorplans import Refusal, iter_plans

    found = [plan for _, plan in iter_plans(path)]
    refused = [plan.reason for plan in found if isinstance(plan, Refusal)]
    if len(refused) == len(found):
        raise InputError(f"{path}: {'; '.join(refused)[:300]}")
    return len(found) - len(refused)


def read_atlas(path: Path) -> int:
    """Read the listing of an atlas."""
    from topomerge.fusion.atlas.folder import read_atlas

    return len(read_atlas(path.parent).entries)


def read_embedder(path: Path) -> int:
    """Read an embedder whose card or network is damaged. Its checksum is made to fit: whoever means harm can do that."""
    from topomerge.embedding.learned import load_embedder
    from topomerge.networks.network import write_card

    if path.suffix == ".onnx":
        write_card(path, json.loads(path.with_name("embedder.card.json").read_text()))
    return len(load_embedder(path.parent)(building(1)))


def read_own_pairs(path: Path) -> int:
    """Read what lists somebody's captures."""
    from topomerge.datasets.pairs.pairs_file import read_pairs_file

    return len(read_pairs_file(path).pairs)


def read_landmarks(path: Path) -> int:
    """Read landmarks of a table, GeoJSON or IndoorGML."""
    from topomerge.io.room_names import load_landmark_source

    return len(load_landmark_source(path))


def read_radio(path: Path) -> int:
    """Read readings of radio beside a walk."""
    from topomerge.io.landmarks import read_radio_csv
    from topomerge.io.trajectory import Trajectory

    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 20.0
    return len(clean_landmarks(read_radio_csv(path, Trajectory(poses, np.array([0.0, 10.0])))))


def read_edits(path: Path) -> int:
    """Read a journal of edits, and apply it."""
    from topomerge.edits.apply import apply_edits
    from topomerge.edits.journal import read_journal

    done = apply_edits(_building(), read_journal(path).edits)
    return len(done.map.rooms) + len([str(refused) for refused in done.refused])


@cache
def _building() -> TopometricMap:
    return building(2, 2)


READERS: dict[str, Callable[[Path], int]] = {  # by name or suffix; all others are clouds
    "a.edits.jsonl": read_edits,
    "a.landmarks.csv": read_landmarks,
    "landmarks.csv": read_landmarks,
    "a.radio.csv": read_radio,
    "rooms.geojson": read_landmarks,
    "rooms.gml": read_landmarks,
    "plan.xml": read_plans,
    "plan.building.yaml": read_plans,
    "plan.vectormap.json": read_plans,
    "plans.tar.xz": read_plans,
    "atlas.json": read_atlas,
    "embedder.card.json": read_embedder,
    "embedder.onnx": read_embedder,
    "pairs.yaml": read_own_pairs,
    **dict.fromkeys(("native.db", "native.json", "native.e57", "native.ply", "native.pcd", "native.pbstream"), read_native),
    **dict.fromkeys(("native.g2o", "native.tum", "native.csv", "native.usdz", "native.rr", "native.home.json"), read_native),
    ".las": read_las,
    ".laz": read_las,
    ".usdz": read_usdz,
    ".tmap": read_map,
    **dict.fromkeys((".bag", ".db3", ".mcap"), read_bag),
    **dict.fromkeys((".dxf", ".pdf", ".svg"), read_plan),
}


def reader(path: Path) -> Callable[[Path], int]:
    """What reads a file of this name."""
    return READERS.get(path.name) or READERS.get(path.suffix, read_cloud)


def write_corpus(folder: Path) -> dict[str, Path]:
    """Name -> file of every format, in a folder."""
    found = write_plain(folder)
    return (
        found
        | write_native(folder, found)
        | write_walks(folder)
        | write_plans(folder)
        | write_embedder(folder)
        | write_atlas(folder)
    )


def write_plain(folder: Path) -> dict[str, Path]:
    """Name -> file, in a folder: those of `samples`, and pictures, a map and a folded scene."""
    from PIL import Image

    from tests.io.test_landmark_files import some_landmarks
    from tests.types.test_deformation import deformation
    from topomerge.edits.journal import append_edits
    from topomerge.extraction.landmarks import add_landmarks
    from topomerge.fusion.result import add_bends
    from topomerge.io.exports import save_export
    from topomerge.io.landmarks import format_landmark_table
    from topomerge.io.maps import save_map
    from topomerge.types import Placement, Sim3

    found = samples.write_all(folder)
    pgm = found["plan.yaml"].with_suffix(".pgm")
    found["plan.pgm"] = pgm
    pixels = Image.open(io.BytesIO(pgm.read_bytes()))
    for suffix in ("png", "jpg", "tif", "bmp"):
        found[f"image.{suffix}"] = folder / f"image.{suffix}"
        pixels.save(found[f"image.{suffix}"])
    found["text.pgm"] = folder / "text.pgm"
    found["text.pgm"].write_text("P2\n8 6\n255\n" + " ".join(str(v) for v in np.tile([0, 205, 254], 16)) + "\n")
    found["map.tmap"] = folder / "map.tmap"
    turn = deformation(np.tile([0.1, 0.0, 0.01, 0.0], (4, 1)))
    marked = add_landmarks(building(2, 2), some_landmarks())
    save_map(add_bends(marked, {1: Placement(Sim3(0.3), turn)}, ["a.ply", "b.ply"]), found["map.tmap"])
    found["a.landmarks.csv"] = folder / "a.landmarks.csv"
    found["a.landmarks.csv"].write_text(format_landmark_table(some_landmarks()))
    found["landmarks.csv"] = folder / "landmarks.csv"
    found["landmarks.csv"].write_text("\ufeffKind;Value;X;Y;Z;Confidence\ntext;2.113;3.2;-1;1.5;0.9\nobject;chair;;;;\n", "utf-8")
    found["a.radio.csv"] = folder / "a.radio.csv"
    found["a.radio.csv"].write_text("time,bssid,rssi\n" + "".join(f"{k / 2},aa:bb:0{k % 7},-{40 + k}\n" for k in range(30)))
    found["a.edits.jsonl"] = folder / "a.edits.jsonl"
    append_edits(found["a.edits.jsonl"], list_edits())
    for name, form in (("rooms.geojson", "geojson"), ("rooms.gml", "indoorgml")):
        found[name] = folder / name
        save_export(marked, form, found[name])
    found["plain.npz"] = folder / "plain.npz"
    np.savez(found["plain.npz"], points=samples.box_points(50), poses=np.eye(4)[None], pose_of=np.zeros(50, np.int32))
    found["pairs.yaml"] = folder / "pairs.yaml"
    found["pairs.yaml"].write_text(OWN_PAIRS)
    return found


def list_edits() -> list[Edit]:
    """An edit of each kind, with what may be left out."""
    from topomerge.edits.draft import find_room_place
    from topomerge.edits.journal import build_edit

    at = [find_room_place(_building(), r).tolist() for r in range(3)]
    x, y, _ = at[0]
    eye = np.eye(4).tolist()
    edits = [
        build_edit("split_room", at=at[0], line=[[x - 3, y], [x, y + 0.1], [x + 3, y]]),
        build_edit("join_rooms", at=at[1:]),
        build_edit("add_door", at=[x + 2.05, y, at[0][2]], width=0.8, open=None, between=at[:2]),
        build_edit("move_door", at=_building().edges["centre"][0], to=at[0], between=at[:2]),
        build_edit("set_door", at=_building().edges["centre"][1], width=1.0, open=False),
        build_edit("delete_door", at=_building().edges["centre"][2]),
        build_edit("move_opening", at=at[0], to=at[1]),
        build_edit("set_opening", at=at[0], width=1.0, sill=0.9, head=2.0),
        build_edit("delete_opening", at=at[0]),
        build_edit("rename_room", at=at[0], name="Kitchen"),
        build_edit("set_room", at=at[1], kind="office", outside=False, looked_into=True),
        build_edit("assign_area", at=at, area="ward"),
        build_edit("add_landmark", at=at[0], kind="tag", value="tag36h11:7"),
        build_edit("delete_landmark", at=at[0], kind="tag", value="tag36h11:7"),
        build_edit("match_rooms", maps=[0, 1], at=at[:2], sources=["a.tmap", "b.tmap"]),
        build_edit("accept_merge", maps=[0, 1], matrix=eye),
        build_edit("reject_merge", maps=[0, 1]),
        build_edit("place_map", map=1, matrix=eye),
    ]
    edits = [replace(edit, id=f"{k:016x}", time="2026-11-27T17:30:25+00:00") for k, edit in enumerate(edits)]
    return [*edits, Edit("undo", {"edit": edits[1].id}, "u"), Edit("redo", {"edit": edits[1].id}, "r")]


def write_walks(folder: Path) -> dict[str, Path]:
    """Bags of either version of ROS, a full OctoMap, recordings of depth cameras, maps in JSON and an octree."""
    from tests.io.bags import walk_messages, write_bag
    from tests.io.octrees import room_tree, write_copc
    from tests.io.rgbd import camera_poses, write_sens
    from tests.io.rtabmap_bases import write_rtabmap
    from tests.io.scene_graphs import write_scene_graph
    from tests.io.test_read_rtabmap import depth_nodes, scan_nodes
    from tests.io.test_read_valetudo import saved, two_rooms
    from tests.io.walks import room_walk

    found = {"full.ot": folder / "full.ot"}
    nodes = [samples.full_node(0.4, 1)] * 15 + [samples.full_node(0.4, 7)] + [samples.full_node(odds, 0) for odds in (1, -1, 2)]
    found["full.ot"].write_bytes(samples.FULL_OCTOMAP_HEADER + b"".join(nodes))
    found["home.json"] = saved(folder, two_rooms())
    found["scene.json"] = write_scene_graph(folder / "scene.json")
    found["cloud.copc.laz"] = write_copc(folder / "cloud.copc.laz", room_tree())
    found["room.sens"] = write_sens(folder / "room.sens", camera_poses())
    found["scans.db"] = write_rtabmap(folder / "scans.db", scan_nodes(room_walk()))
    found["depth.db"] = write_rtabmap(
        folder / "depth.db",
        [
            replace(node, label="Lab", sensors=[(3, 1013.0, 1.0)], tags=[(3, np.eye(4))])
            for node in depth_nodes(camera_poses()[:1])
        ],
    )
    for kind in ("bag", "db3", "mcap") if find_spec("rosbags") else ():
        found[f"walk.{kind}"] = write_bag(folder / kind, kind, walk_messages(room_walk())).rename(folder / f"walk.{kind}")
    return found


def write_native(folder: Path, found: dict[str, Path]) -> dict[str, Path]:
    """Files that are written again, each under a name of its own, and those of the formats that only their readers know."""
    from tests.io import test_native as native
    from tests.io.test_native_graphs import flat_graph
    from tests.io.test_native_robot_maps import home
    from tests.io.test_native_rtabmap import write_session
    from tests.io.test_read_valetudo import rr_file, rr_pixels

    poses = native.random_poses(8)
    turns = native.quaternions(poses)
    made = {f"native.{kind}": folder / f"native.{kind}" for kind in ("db", "json", "e57", "ply", "pcd", "g2o", "tum", "csv")}
    write_session(made["native.db"])
    made["native.json"].write_text(json.dumps(flat_graph((0, 1))))
    for kind, source in (("e57", "cloud.e57"), ("ply", "little.ply"), ("pcd", "binary.pcd")):
        if source in found:
            shutil.copy(found[source], made[f"native.{kind}"])
    made["native.g2o"].write_text(native.GRAPH)
    native.write_lines(made["native.tum"], np.column_stack([np.arange(8.0), poses[:, :3, 3], turns]))
    rows = np.column_stack([1.4e18 + np.arange(8.0), poses[:, :3, 3], turns[:, [3, 0, 1, 2]], np.zeros((8, 3))])
    native.write_lines(made["native.csv"], rows, "%.9f", ",", "#timestamp\n")
    made["home.rr"] = rr_file(folder / "home.rr", rr_pixels(), packed=False)
    made["native.rr"] = rr_file(folder / "native.rr", rr_pixels(), packed=False)
    made["native.home.json"] = home(folder / "native.home.json")
    if find_spec("google.protobuf"):
        from tests.io import cartographer_states as carto

        for name, spatial in (("native.pbstream", False), ("flat.pbstream", False), ("space.pbstream", True)):
            made[name] = carto.write_messages(folder / name, carto.state(2, spatial=spatial))
    if find_spec("pxr"):
        from tests.io.test_usdz import roomplan

        made["room.usdz"] = roomplan(folder / "room.usdz")
        made["native.usdz"] = roomplan(folder / "native.usdz")
    return {name: path for name, path in made.items() if path.is_file()}


def write_plans(folder: Path) -> dict[str, Path]:
    """Plans of four data sets."""
    from tests.datasets.plans import plan_files

    found = {name: folder / name for name in ("plan.xml", "plan.building.yaml", "plan.vectormap.json", "plans.tar.xz")}
    plan_files.campus(found["plan.xml"])
    plan_files.rmf(found["plan.building.yaml"])
    plan_files.amrl(found["plan.vectormap.json"])
    if all(find_spec(name) for name in ("ezdxf", "pypdfium2", "resvg_py")):
        from tests.io import cad_plans
        from tests.io import test_read_pages as pages

        found["flat.dxf"] = cad_plans.write_flat(folder / "flat.dxf")
        found["flat.pdf"] = pages.write_pdf(folder / "flat.pdf", [pages.draw_flat(pages.AREAS)])
        found["flat.svg"] = pages.write_svg(folder / "flat.svg")
    with tarfile.open(found["plans.tar.xz"], "w:xz") as archive:
        archive.add(plan_files.r2v(folder / "flat.txt"), "flat.txt")
    return found


def write_embedder(folder: Path) -> dict[str, Path]:
    """The embedder that ships, and its card."""
    from topomerge.embedding.learned import find_embedder
    from topomerge.networks.network import card_of

    return {path.name: Path(shutil.copy(path, folder)) for path in (find_embedder(), card_of(find_embedder()))}


def write_atlas(folder: Path) -> dict[str, Path]:
    """The listing of an atlas of one map."""
    from topomerge.fusion.atlas.store import add

    add(folder / "atlas", [("house", building(2, 2))], lambda *_, **__: "")
    shutil.copy(folder / "atlas" / "atlas.json", folder / "atlas.json")
    return {"atlas.json": folder / "atlas.json"}


def beside(name: str, corpus: Path, folder: Path) -> None:
    """Put what a file of this name needs into the folder where its mutants are written."""
    if name in PARTNERS:
        shutil.copy(corpus / PARTNERS[name], folder / PARTNERS[name])
