"""Pose graphs of g2o, which GTSAM, Ceres' examples and SE-Sync read, too: joined, and the maps of a merge as such a graph.

Vertices are moved into the joined frame. Measurements between them are relative and stay as they are written, to the letter.
Edges hold sessions together. Source: https://github.com/RainerKuemmerle/g2o/wiki/File-Format
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from topomerge.errors import InputError
from topomerge.io.native import Doubt, Source, Tally, find_nearest_links, refuse_missing
from topomerge.io.piece import build_damage_error
from topomerge.io.trajectory import UNIT_TOLERANCE, build_pose_matrices
from topomerge.types import Array

KIND = "a pose graph of g2o"
LARGEST_GRAPH = 1 << 30  # bytes
LARGEST_ID = 2**53
FLAT, SPATIAL = "VERTEX_SE2", "VERTEX_SE3:QUAT"
VERTICES = {FLAT: 3, SPATIAL: 7, "VERTEX_XY": 2, "VERTEX_TRACKXYZ": 3}  # and their numbers
EDGES = {  # vertices, parameters and numbers of each
    "EDGE_SE2": (2, 0, 9), "EDGE_SE3:QUAT": (2, 0, 28), "EDGE_SE2_XY": (2, 0, 5), "EDGE_SE3_TRACKXYZ": (2, 1, 9),
}  # fmt: skip
PARAMETERS = {"PARAMS_SE3OFFSET": 7}
BEYOND = 1e30


@dataclass(frozen=True, eq=False)
class Vertex:
    """A vertex: its tag, and a pose (4, 4); of a landmark only the place means anything."""

    tag: str
    pose: Array

    @property
    def posed(self) -> bool:
        """Is it a pose, and no landmark?"""
        return self.tag in (FLAT, SPATIAL)


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Vertices by their number; edges as (tag, vertices, parameters, text of the numbers); parameters and fixed vertices."""

    vertices: dict[int, Vertex] = field(default_factory=dict)
    edges: list[tuple[str, tuple[int, ...], tuple[int, ...], str]] = field(default_factory=list)
    parameters: dict[int, tuple[str, str]] = field(default_factory=dict)
    fixed: list[int] = field(default_factory=list)

    @property
    def flat(self) -> bool:
        """Are all poses those of a plane?"""
        return any(vertex.tag == FLAT for vertex in self.vertices.values())


def read_pose_graph(path: Path) -> PoseGraph:
    """Read a file of g2o.

    Raises:
        InputError: a line is damaged or of a kind that is not known, with its number; or it is too large.
    """
    refuse_missing(path)
    if path.stat().st_size > LARGEST_GRAPH:
        raise InputError(f"{path}: has more than {LARGEST_GRAPH >> 30} GB, too many for a pose graph; cut it")
    graph = PoseGraph()
    with path.open(encoding="utf-8", errors="replace") as stream:
        for number, line in enumerate(stream, 1):
            fields = line.split("#", 1)[0].split()
            if fields:
                try:
                    _parse_line(graph, fields)
                except (ValueError, OverflowError) as error:
                    raise InputError(f"{path}: line {number}: {str(error)[:120]}; export the graph again") from error
    if not graph.vertices:
        raise build_damage_error(path, KIND, "it has no vertices")
    kinds = {vertex.tag for vertex in graph.vertices.values() if vertex.posed}
    if len(kinds) > 1:
        raise InputError(f"{path}: has vertices of SE2 and of SE3; export the graph as one of them")
    for tag, ends, parameters, _ in graph.edges:
        if not all(end in graph.vertices for end in ends) or not all(p in graph.parameters for p in parameters):
            raise build_damage_error(path, KIND, f"{tag} of {ends} names a vertex or a parameter that does not exist")
    return graph


def _parse_line(graph: PoseGraph, columns: list[str]) -> None:
    tag, rest = columns[0], columns[1:]
    if tag in VERTICES:
        number, values = _parse_id(rest[0] if rest else ""), _parse_numbers(tag, rest[1:], VERTICES[tag])
        if number in graph.vertices:
            raise ValueError(f"vertex {number} stands there twice")
        graph.vertices[number] = Vertex(tag, _build_pose(tag, values))
    elif tag in EDGES:
        ends, parameters, count = EDGES[tag]
        ids = [_parse_id(word) for word in rest[: ends + parameters]]
        _parse_numbers(tag, rest[ends + parameters :], count)
        graph.edges.append((tag, tuple(ids[:ends]), tuple(ids[ends:]), " ".join(rest[ends + parameters :])))
    elif tag in PARAMETERS:
        _parse_numbers(tag, rest[1:], PARAMETERS[tag])
        graph.parameters[_parse_id(rest[0])] = tag, " ".join(rest[1:])
    elif tag == "FIX":
        graph.fixed.extend(map(_parse_id, rest))
    else:
        raise ValueError(f"{tag[:40]} is not known, only {', '.join([*VERTICES, *EDGES, *PARAMETERS, 'FIX'])}")


def _parse_id(word: str) -> int:
    number = int(word)
    if not 0 <= number <= LARGEST_ID:
        raise ValueError(f"{word} is no number of a vertex")
    return number


def _parse_numbers(tag: str, columns: list[str], count: int) -> Array:
    if len(columns) != count:
        raise ValueError(f"{tag} has {len(columns)} numbers, not {count}")
    values = np.array([float(word) for word in columns])
    if not (np.abs(values) < BEYOND).all():
        raise ValueError(f"{tag} has a number that is not finite")
    return values


def _build_pose(tag: str, values: Array) -> Array:
    pose = np.eye(4)
    if tag == SPATIAL:
        if abs(float(np.linalg.norm(values[3:])) - 1) > UNIT_TOLERANCE:
            raise ValueError("a vertex without a unit quaternion")
        return np.asarray(build_pose_matrices(values[None, :3], values[None, 3:])[0])
    if tag == FLAT:
        c, s = np.cos(values[2]), np.sin(values[2])
        pose[:2, :2] = (c, -s), (s, c)
        values = values[:2]
    pose[: len(values), 3] = values
    return pose


def _build_place(place: Array) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose


def join(sources: Sequence[Source], target: Path, doubt: Doubt) -> Tally:
    """Write all graphs as one.

    Raises:
        InputError: one is damaged, some are flat and others not, or a flat one would be tilted.
    """
    graphs = [read_pose_graph(source.path) for source in sources]
    _check_dimensions(sources, graphs)
    joined = PoseGraph()
    warnings = []
    nodes: list[list[int]] = []
    for source, graph in zip(sources, graphs, strict=True):
        step = max(joined.vertices, default=-1) + 1
        parameter = max(joined.parameters, default=-1) + 1
        numbers = list(graph.vertices)
        moved = source.motion.move_poses(np.array([graph.vertices[k].pose for k in numbers]))
        places = source.motion.move_points(np.array([graph.vertices[k].pose[:3, 3] for k in numbers]))
        for k, pose, place in zip(numbers, moved, places, strict=True):
            vertex = graph.vertices[k]
            joined.vertices[k + step] = Vertex(vertex.tag, pose if vertex.posed else _build_place(place))
        for tag, ends, used, text in graph.edges:
            joined.edges.append((tag, tuple(e + step for e in ends), tuple(u + parameter for u in used), text))
        joined.parameters.update({k + parameter: value for k, value in graph.parameters.items()})
        if nodes and graph.fixed:
            warnings.append(f"{source.path}: its fixed vertices are free now: edges hold them to the first graph")
        joined.fixed.extend(graph.fixed if not nodes else ())
        nodes.append([k + step for k in numbers if graph.vertices[k].posed])
    count = len(joined.edges)
    for a, i, b, j in find_nearest_links([np.array([joined.vertices[k].pose[:3, 3] for k in own]) for own in nodes]):
        joined.edges.append(_build_edge(joined, nodes[a][i], nodes[b][j], doubt))
    target.write_text(format_pose_graph(joined), encoding="utf-8")
    reread = read_pose_graph(target)
    vertices = sum(len(graph.vertices) for graph in graphs)
    counts = {"nodes": (vertices, len(reread.vertices)), "links": (len(joined.edges), len(reread.edges))}
    between = len(joined.edges) - count
    return Tally(counts | {"links between sessions": (between, between)}, tuple(warnings))


def _check_dimensions(sources: Sequence[Source], graphs: Sequence[PoseGraph]) -> None:
    for source, graph in zip(sources, graphs, strict=True):
        if graph.flat != graphs[0].flat:
            kinds = [f"{s.path} is of {'SE2' if g.flat else 'SE3'}" for s, g in ((sources[0], graphs[0]), (source, graph))]
            raise InputError(f"{source.path}: {' and '.join(kinds)}; export both as one of them")
        if graph.flat and not source.motion.level:
            raise InputError(f"{source.path}: is a graph in a plane, and its map is tilted; export it as SE3")


def build_pose_graph(poses: dict[int, Array], links: Sequence[tuple[int, int, Doubt]]) -> PoseGraph:
    """Build a graph in space: a vertex for each pose, an edge for each link; the first of what hangs together is fixed.

    Args:
        poses: number -> (4, 4).
        links: the two numbers, and how sure their relative pose is.
    """
    graph = PoseGraph({k: Vertex(SPATIAL, pose) for k, pose in sorted(poses.items())})
    first = {k: k for k in poses}
    for a, b, doubt in links:
        graph.edges.append(_build_edge(graph, a, b, doubt))
        low, high = sorted((first[a], first[b]))
        first = {k: low if v == high else v for k, v in first.items()}
    graph.fixed.extend(sorted(set(first.values())))
    return graph


def _build_edge(graph: PoseGraph, a: int, b: int, doubt: Doubt) -> tuple[str, tuple[int, ...], tuple[int, ...], str]:
    relative = np.linalg.inv(graph.vertices[a].pose) @ graph.vertices[b].pose
    text = _format_flat(relative) if graph.flat else _format_spatial(relative)
    tag = "EDGE_SE2" if graph.flat else "EDGE_SE3:QUAT"
    return tag, (a, b), (), f"{text} {_format_information(doubt, graph.flat)}"


def _format_information(doubt: Doubt, flat: bool) -> str:
    """Return the upper triangle of the inverse covariance; of SE3 the vector part of the quaternion counts, half of a turn."""
    information = doubt.build_information()
    if flat:
        information = information[np.ix_([0, 1, 5], [0, 1, 5])]
    else:
        information = information * np.outer([1, 1, 1, 2, 2, 2], [1, 1, 1, 2, 2, 2])
    return " ".join(_format_number(v) for v in information[np.triu_indices(len(information))])


def _format_number(value: float) -> str:
    return repr(float(value))


def _format_flat(pose: Array) -> str:
    return " ".join(_format_number(v) for v in (*pose[:2, 3], np.arctan2(pose[1, 0], pose[0, 0])))


def _format_spatial(pose: Array) -> str:
    return " ".join(_format_number(v) for v in (*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()))


def format_pose_graph(graph: PoseGraph) -> str:
    """Format a graph as g2o writes it: parameters, vertices, what is fixed, edges."""
    lines = [f"{tag} {k} {text}" for k, (tag, text) in graph.parameters.items()]
    for k, vertex in graph.vertices.items():
        place = " ".join(_format_number(v) for v in vertex.pose[: 2 if vertex.tag == "VERTEX_XY" else 3, 3])
        values = {FLAT: _format_flat, SPATIAL: _format_spatial}.get(vertex.tag, lambda _, place=place: place)(vertex.pose)
        lines.append(f"{vertex.tag} {k} {values}")
    lines += [f"FIX {k}" for k in graph.fixed]
    lines += [" ".join([tag, *map(str, ends), *map(str, used), text]) for tag, ends, used, text in graph.edges]
    return "\n".join(lines) + "\n"
