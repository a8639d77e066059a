"""Pose graphs of slam_toolbox in the joined frame: those of one laser as one graph, others moved.

What moves is written anew where it stands: poses of scans, their points and the ends of their links. What is relative stays:
odometry, ranges, differences of links and their covariance. Graphs are joined as objects then, and written with new numbers.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.boost_archive import BinaryArchive, Members, write_archive
from topomerge.io.karto import (
    LAYOUTS,
    SCAN,
    WHOLE,
    KartoGraph,
    build_planar_pose,
    get_pose,
    parse_karto_graph,
    read_karto_graph,
)
from topomerge.io.native import NATIVE, Doubt, Motion, Source, Tally, find_nearest_links
from topomerge.types import Array

LASER = ("low", "high", "step", "nearest", "farthest", "threshold", "kind")


def find_group(path: Path) -> str:
    """Find what graphs must have in common to be joined: the laser, and the layout of their files.

    slam_toolbox takes the first laser of a file for all of its scans. A graph of several, one without links, or one in which what
    follows the graph is of a version that is not known, is joined with no other.

    Raises:
        InputError: it can't be read.
    """
    graph = read_karto_graph(path)
    try:
        graph = _parse_whole(path, [archive.data for archive in graph.archives])
    except InputError:
        return str(path)
    mapper, data = graph.roots
    of_lasers = graph.lasers, data["lasers"], data["devices"], mapper["graph"]["vertices"], mapper["manager"]["managers"]
    if any(len(of) != 1 for of in of_lasers) or not {"Edge", "LinkInfo"} <= graph.archives[0].counted.keys():
        return str(path)
    (laser,) = graph.lasers.values()
    values = [*(laser[name]["value"] for name in LASER), *get_pose(laser["offset"]["value"]), laser["count"]]
    return json.dumps([_find_layout(graph), values])


def _find_layout(graph: KartoGraph) -> int:
    return [layout.classes["Graph"] for layout in LAYOUTS].index(graph.archives[0].layout.classes["Graph"])


def _parse_whole(path: Path, files: Sequence[bytes]) -> KartoGraph:
    return parse_karto_graph(path, files, WHOLE)


def join(sources: Sequence[Source], target: Path, doubt: Doubt) -> Tally:
    """Write pose graphs of one group (`find_group`) as one, and the data beside it; a single one is moved.

    Raises:
        InputError: one is damaged, or its map is tilted.
    """
    graphs, files = [], []
    for source in sources:
        if not source.motion.level:
            raise InputError(f"{source.path}: is a pose graph in a plane, and its map is tilted; it can't be written truly")
        graphs.append(read_karto_graph(source.path))
        still = source.motion.still
        files.append([a.data if still else _move_archive(a, source.motion) for a in graphs[-1].archives])
    scans, links, between = (sum(map(len, of)) for of in ([g.scans for g in graphs], [g.links for g in graphs], []))
    if len(sources) > 1:
        wholes = [_parse_whole(source.path, file) for source, file in zip(sources, files, strict=True)]
        between = _join_graphs(wholes, doubt)
        files = [[write_archive(wholes[0].roots[k], [whole.archives[k] for whole in wholes]) for k in (0, 1)]]
    for data, path in zip(files[0], (target, target.with_suffix(NATIVE["karto"].companion)), strict=True):
        path.write_bytes(data)
    written = parse_karto_graph(target, files[0])
    counts = {"scans": (scans, len(written.scans)), "links": (links + between, len(written.links))}
    return Tally(counts | ({"links between sessions": (between, between)} if len(sources) > 1 else {}))


def _join_graphs(graphs: Sequence[KartoGraph], doubt: Doubt) -> int:
    """Put the scans and links of all graphs into the first one; how many links between them were added."""
    first, vertices, places = graphs[0], [], []
    for k, graph in enumerate(graphs):
        own = [v for _, of in graph.roots[0]["graph"]["vertices"] for v in _list_values(of) if v and v["scan"]]
        vertices.append(own)
        places.append(np.array([[*get_pose(v["scan"]["pose"])[:2], 0.0] for v in own]).reshape(-1, 3))
        if k:
            _renumber(graph, first)
            _put_in(graph, first)
    links = 0
    for a, i, b, j in find_nearest_links(places):
        _add_link(first, vertices[a][i], vertices[b][j], doubt)
        links += 1
    return links


def _list_values(of: Sequence[Any]) -> list[Any]:
    """List the values of a list, or of a map by number."""
    return [entry[1] if isinstance(entry, tuple) else entry for entry in of]


def _renumber(graph: KartoGraph, first: KartoGraph) -> None:
    """Give the scans of a graph numbers that those of the first one do not have, and the name of its laser."""
    manager = first.roots[0]["manager"]
    step = max(manager["next"], len(manager["scans"]), 1 + max(int(scan["id"]) for scan in _list_scans(first)))
    state = max(1 + int(scan["state"]) for scan in _list_scans(first))
    for _, of in manager["managers"]:
        state = max(state, of["next"], len(of["scans"]))
    ((name, _),) = first.roots[1]["lasers"]
    for scan in _list_scans(graph):
        scan["id"] += step
        scan["state"] += state
        scan["sensor"] |= {"name": name["name"], "scope": name["scope"]}


def _list_scans(graph: KartoGraph) -> list[Members]:
    """Return the scans of both files: each has its own."""
    return [scan for archive in graph.archives for scan in archive.found[SCAN]]


def _put_in(graph: KartoGraph, first: KartoGraph) -> None:
    """Put renumbered scans, and their links, into the lists of the first graph."""
    (mapper, data), (own, own_data) = first.roots, graph.roots
    mapper["graph"]["edges"] += own["graph"]["edges"]
    ((_, vertices),) = mapper["graph"]["vertices"]
    _extend(vertices, [v for _, of in own["graph"]["vertices"] for v in _list_values(of) if v], lambda v: int(v["scan"]["state"]))
    ((_, of),) = mapper["manager"]["managers"]
    scans = [scan for scan in _list_values(own["manager"]["scans"]) if scan]
    _extend(of["scans"], scans, lambda scan: int(scan["state"]))
    _extend(mapper["manager"]["scans"], scans, lambda scan: int(scan["id"]))
    of["next"] = 1 + max(int(scan["state"]) for scan in _list_scans(graph))
    mapper["manager"]["next"] = 1 + max(int(scan["id"]) for scan in _list_scans(graph))
    data["data"] += [(int(scan["id"]), scan) for _, scan in own_data["data"] if scan]


def _extend(of: list[Any], entries: Sequence[Any], get_number: Any) -> None:
    """Put entries into a map of numbers; a list, as before 2019, has each at its number."""
    if of and isinstance(of[0], tuple):
        of += [(get_number(entry), entry) for entry in entries]
        return
    for entry in entries:
        of += [None] * (get_number(entry) - len(of) + 1)
        of[get_number(entry)] = entry


def _add_link(graph: KartoGraph, a: Members, b: Members, doubt: Doubt) -> None:
    """Add a link between two scans, as Karto's LinkInfo: the covariance is that of the second one in the first one's frame."""
    ends = [get_pose(vertex["scan"]["pose"]) for vertex in (a, b)]
    relative = np.linalg.inv(build_planar_pose(*ends[0])) @ build_planar_pose(*ends[1])
    turn = float(np.arctan2(relative[1, 0], relative[0, 0]))
    poses = [_build_pose(*end) for end in (*ends, (float(relative[0, 3]), float(relative[1, 3]), turn))]
    covariance = {"class": "Matrix3", "rows": np.diag([doubt.place**2, doubt.place**2, doubt.turn**2])}
    info = {"class": "LinkInfo", **dict(zip(("a", "b", "difference"), poses, strict=True)), "covariance": covariance}
    edge = {"class": "Edge", "a": a, "b": b, "link": info}
    for edges in (a["edges"], b["edges"], graph.roots[0]["graph"]["edges"]):
        edges.append(edge)


def _build_pose(x: float, y: float, heading: float) -> Members:
    return {"class": "Pose2", "place": {"class": "Vector2<double>", "x": x, "y": y}, "heading": heading}


def _move_archive(archive: BinaryArchive, motion: Motion) -> bytes:
    data = bytearray(archive.data)
    for scan in archive.found[SCAN]:
        step = _move_pose(data, scan["pose"], motion)
        _write_numbers(data, scan["middle"]["place"]["@x"][0], _move_points(step, get_pose(scan["middle"])[:2])[0])
        for name in ("points", "all_points"):
            if len(scan[name]):
                moved = _move_points(step, scan[name])
                _write_numbers(data, scan[f"@{name}"][1] - moved.nbytes, moved.ravel())
        box = np.array([[scan["box"][end]["x"], scan["box"][end]["y"]] for end in ("low", "high")])
        if (box[0] <= box[1]).all():
            seen = scan["points"] if len(scan["points"]) else box
            ends = _move_points(step, np.concatenate([seen, [get_pose(scan["pose"])[:2]]]))
            for end, corner in (("low", ends.min(axis=0)), ("high", ends.max(axis=0))):
                _write_numbers(data, scan["box"][end]["@x"][0], corner)
    for link in archive.found["LinkInfo"]:
        for end in "ab":
            _move_pose(data, link[end], motion)
    return bytes(data)


def _move_pose(data: bytearray, pose: Members, motion: Motion) -> Array:
    """Move a Pose2 where it stands; the step (4, 4) that takes what was seen from there along."""
    before = build_planar_pose(*get_pose(pose))
    after = motion.move_poses(before[None])[0]
    turn = float(np.arctan2(after[1, 0], after[0, 0]))
    heading = pose["heading"] + (turn - pose["heading"] + np.pi) % (2 * np.pi) - np.pi
    _write_numbers(data, pose["place"]["@x"][0], after[:2, 3])
    _write_numbers(data, pose["@heading"][0], [heading])
    moved: Array = build_planar_pose(float(after[0, 3]), float(after[1, 3]), turn) @ np.linalg.inv(before)
    return moved


def _move_points(step: Array, points: Array | Sequence[float]) -> Array:
    """Move (n, 2) points of a plane; those that are not finite stay."""
    flat = np.atleast_2d(np.asarray(points, float))
    with np.errstate(invalid="ignore"):
        moved = flat @ step[:2, :2].T + step[:2, 3]
    return np.where(np.isfinite(flat).all(axis=1, keepdims=True), moved, flat)


def _write_numbers(data: bytearray, at: int, values: Array | Sequence[float]) -> None:
    struct.pack_into(f"<{len(values)}d", data, at, *values)
