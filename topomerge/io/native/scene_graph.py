"""Scene graphs of Spark-DSG joined: all layers in one frame, what two graphs show of one thing once, its attributes kept.

An object of one class at one place, a place of free space, a room that shares its places, and the building are one node; its
metadata say which nodes of other graphs it stands for. Edges follow the nodes, a child keeps its first parent, and meshes lie
behind each other. Source: the JSON of spark-dsg 1.1 (https://github.com/MIT-SPARK/Spark-DSG).
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from topomerge.errors import InputError
from topomerge.io.json_map import is_scene_graph, load_json_map
from topomerge.io.native import Doubt, Motion, Source, Tally
from topomerge.io.piece import build_damage_error
from topomerge.types import Array

KIND = "a scene graph"
OBJECTS, PLACES, ROOMS, BUILDINGS = 2, 3, 4, 5
LAYERS = {"objects": OBJECTS, "places": PLACES, "rooms": ROOMS, "buildings": BUILDINGS}
LETTER = 56  # bits below the letter of a node's id
SAME_OBJECT, SAME_PLACE, SAME_ROOM = 0.5, 0.4, 1.0  # m, between nodes that are one
SHARED_PLACES = 0.5  # of a room's places, from which on it is the room that has their partners
UNIT = 0.05  # by which the length of a quaternion may miss 1
VERTEX_LISTS = ("mesh_connections", "pcl_mesh_connections", "pcl_boundary_connections")
TURNS = ("world_R_object", "orientation", "world_R_body")
POINT_LISTS = ("boundary", "dynamic_object_points", "trajectory_positions")
MESH_COLUMNS = {
    "colors": "has_colors",
    "labels": "has_labels",
    "stamps": "has_timestamps",
    "first_seen_stamps": "has_first_seen_stamps",
}
MERGED = "merged"  # in a node's metadata: ids of the nodes of later graphs that it stands for, by their file
Json = dict[str, Any]


def is_native(path: Path) -> bool:
    """Return whether a file of JSON begins as a scene graph does; maps of vacuum robots are none."""
    try:
        return is_scene_graph(load_json_map(path))
    except InputError:
        return False


@dataclass(frozen=True, eq=False)
class _Graph:
    """Nodes by id, edges by their ends, and the rest of the file."""

    about: Json
    nodes: dict[int, Json] = field(default_factory=dict)
    edges: dict[tuple[int, int], Json] = field(default_factory=dict)

    def list_nodes(self, layer: int) -> list[int]:
        """List the ids of the nodes of a layer, agents and other partitions left out."""
        return [k for k, node in self.nodes.items() if node["layer"] == layer and not node.get("partition", 0)]

    def get_places(self, ids: Sequence[int]) -> Array:
        """Return (n, 3) m."""
        return np.array([self.nodes[k]["attributes"]["position"] for k in ids], np.float64).reshape(-1, 3)

    def find_parents(self) -> dict[int, int]:
        """Map each child to its parent, of neighbouring layers."""
        parents: dict[int, int] = {}
        for a, b in self.edges:
            high, low = (a, b) if self.nodes[a]["layer"] > self.nodes[b]["layer"] else (b, a)
            if self.nodes[high]["layer"] != self.nodes[low]["layer"]:
                parents.setdefault(low, high)
        return parents


def join(sources: Sequence[Source], target: Path, doubt: Doubt) -> Tally:
    """Write all graphs as one.

    Raises:
        InputError: one is damaged, or of another version.
    """
    del doubt
    graphs = [read_scene_graph(source.path) for source in sources]
    versions = {str(graph.about.get("SPARK_DSG_header", {}).get("version", {}).get("major")) for graph in graphs}
    if len(versions) > 1:
        raise InputError(f"{sources[1].path}: is of another version of Spark-DSG than {sources[0].path}; save both with one")
    first = _move_graph(graphs[0], sources[0].motion)
    counts = {name: [0, 0] for name in LAYERS}
    joined, merged = first, 0
    for name, layer in LAYERS.items():
        counts[name][0] = sum(len(graph.list_nodes(layer)) for graph in graphs)
    edges = sum(len(graph.edges) for graph in graphs)
    for source, graph in zip(sources[1:], graphs[1:], strict=True):
        fresh = _renumber(_share_labels(_move_graph(graph, source.motion), joined), joined)
        pairs = find_same_nodes(joined, fresh)
        merged += len(pairs)
        joined = _unite(joined, fresh, pairs, source.path.name)
    target.write_text(json.dumps(_build_file(joined), allow_nan=False), encoding="utf-8")
    reread = read_scene_graph(target)
    for name, layer in LAYERS.items():
        counts[name][1] = len(reread.list_nodes(layer))
    agents = sum(len(graph.nodes) for graph in graphs) - sum(before for before, _ in counts.values())
    tally = {name: (before, after) for name, (before, after) in counts.items()}
    tally["other nodes"] = (agents, len(reread.nodes) - sum(after for _, after in counts.values()))
    return Tally(tally | {"nodes that are one": (merged, merged), "links": (edges, len(reread.edges))})


def read_scene_graph(path: Path) -> _Graph:
    """Read the nodes and edges of a scene graph.

    Raises:
        InputError: it is none, or names nodes that do not exist.
    """
    about = load_json_map(path)
    if not is_scene_graph(about):
        raise InputError(f"{path}: is no scene graph of Spark-DSG; save it by `graph.save`")
    graph = _Graph({key: value for key, value in about.items() if key not in ("nodes", "edges")})
    try:
        for node in about["nodes"]:
            _check_node(node)
            if node["id"] in graph.nodes:
                raise ValueError(f"node {node['id']} stands there twice")
            graph.nodes[node["id"]] = node
        for edge in about["edges"]:
            a, b = edge["source"], edge["target"]
            if a not in graph.nodes or b not in graph.nodes:
                raise ValueError(f"an edge names node {a} or {b}, which does not exist")
            graph.edges[a, b] = edge
        mesh = about.get("mesh")
        if mesh is not None and not isinstance(mesh, dict):
            raise ValueError("its mesh is none")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise build_damage_error(path, KIND, error) from error
    return graph


def _check_node(node: Any) -> None:
    number, position = node["id"], node["attributes"]["position"]
    whole = all(isinstance(v, int) and not isinstance(v, bool) for v in (number, node["layer"]))
    if not whole or not 0 <= number < 1 << 64:
        raise ValueError(f"a node of id {number!r}")
    if len(position) != 3 or not np.isfinite(np.array(position, np.float64)).all():
        raise ValueError(f"node {number} has no place")


def _move_graph(graph: _Graph, motion: Motion) -> _Graph:
    """Return the graph in the joined frame: all that is a place or a turn in the world."""
    nodes = {k: {**node, "attributes": _move_attributes(node["attributes"], motion)} for k, node in graph.nodes.items()}
    about = dict(graph.about)
    mesh = about.get("mesh")
    if mesh and mesh.get("points") and not motion.still:
        about["mesh"] = {**mesh, "points": motion.move_points(np.array(mesh["points"], np.float64)).tolist()}
    return _Graph(about, nodes, dict(graph.edges))


def _move_attributes(about: Json, motion: Motion) -> Json:
    if motion.still:
        return about
    pose = np.eye(4)
    pose[:3, 3] = about["position"]
    turn = motion.move_poses(pose[None])[0][:3, :3]
    out = {**about, "position": _move_points(about["position"], motion)}
    for name in (n for n in TURNS if isinstance(about.get(n), dict)):
        out[name] = _turn(about[name], turn)
    for name in (n for n in POINT_LISTS if about.get(n)):
        out[name] = [_move_points(point, motion) for point in about[name]]
    box = about.get("bounding_box")
    if isinstance(box, dict) and box.get("type") != "INVALID":
        out["bounding_box"] = {**box, "world_P_center": _move_points(box["world_P_center"], motion)}
        out["bounding_box"]["world_R_center"] = _turn(box["world_R_center"], turn)
        if box.get("type") == "AABB" and not np.allclose(turn, np.eye(3)):
            out["bounding_box"]["type"] = "RAABB" if motion.level else "OBB"
    if "ellipse_centroid" in about and np.isfinite(np.array(about["ellipse_centroid"], float)).all():
        out["ellipse_centroid"] = _move_points(about["ellipse_centroid"], motion)
        for name in ("ellipse_matrix_compress", "ellipse_matrix_expand"):
            flat = turn[:2, :2] @ np.array(about[name], float).reshape(2, 2) @ turn[:2, :2].T
            out[name] = flat.ravel().tolist()
    return out


def _move_points(point: Any, motion: Motion) -> list[float]:
    moved: list[float] = motion.move_points(np.array(point, np.float64).reshape(1, 3))[0].tolist()
    return moved


def _turn(quaternion: Any, turn: Array) -> Any:
    """Turn a quaternion; leave it as it is where it is none, as in nodes that never had one."""
    values = np.array([quaternion[axis] for axis in "xyzw"], np.float64)
    if not np.isfinite(values).all() or abs(float(np.linalg.norm(values)) - 1) > UNIT:
        return quaternion
    x, y, z, w = (Rotation.from_matrix(turn) * Rotation.from_quat(values)).as_quat().tolist()
    return {"w": w, "x": x, "y": y, "z": z}


def _share_labels(graph: _Graph, joined: _Graph) -> _Graph:
    """Return the numbers of classes as the joined graph counts them, where both name their classes."""
    own, base = (dict((g.about.get("metadata") or {}).get("labelspaces") or {}) for g in (graph, joined))
    spaces = {
        name: ({int(n): str(w) for n, w in own[name]}, {str(w): int(n) for n, w in base[name]}) for name in own if name in base
    }
    moves: dict[str, dict[int, int]] = {}
    for name, (labels, numbers) in spaces.items():
        for word in labels.values():
            if word not in numbers:
                numbers[word] = max([*numbers.values(), *labels, -1]) + 1
        moves[name] = {number: numbers[word] for number, word in labels.items()}
        joined.about["metadata"] = {
            **joined.about["metadata"],
            "labelspaces": {**base, name: [[n, w] for w, n in numbers.items()]},
        }
        base[name] = [[n, w] for w, n in numbers.items()]
    nodes = {}
    for k, node in graph.nodes.items():
        change = moves.get(f"_l{node['layer']}p{node.get('partition', 0)}", {})
        label = node["attributes"].get("semantic_label")
        about = {**node["attributes"], "semantic_label": change[label]} if label in change else node["attributes"]
        nodes[k] = {**node, "attributes": about}
    return _Graph(graph.about, nodes, graph.edges)


def _renumber(graph: _Graph, joined: _Graph) -> _Graph:
    """Return the graph with ids, and numbers of vertices, that the joined one does not use."""
    highest: dict[int, int] = {}
    for k in joined.nodes:
        highest[k >> LETTER] = max(highest.get(k >> LETTER, -1), k & ((1 << LETTER) - 1))
    fresh = {k: k + highest.get(k >> LETTER, -1) + 1 for k in graph.nodes}
    if any(fresh[k] >> LETTER != k >> LETTER for k in fresh):
        raise InputError("a scene graph numbers its nodes up to the end; save it again")
    first = len((joined.about.get("mesh") or {}).get("points") or ())
    nodes = {}
    for k, node in graph.nodes.items():
        about = dict(node["attributes"])
        for name in (n for n in VERTEX_LISTS if about.get(n)):
            about[name] = [v + first if isinstance(v, int) else v for v in about[name]]
        nodes[fresh[k]] = {**node, "id": fresh[k], "attributes": about}
    edges = {(fresh[a], fresh[b]): {**e, "source": fresh[a], "target": fresh[b]} for (a, b), e in graph.edges.items()}
    return _Graph(graph.about, nodes, edges)


def find_same_nodes(joined: _Graph, graph: _Graph) -> dict[int, int]:
    """Find nodes of a graph that the joined one has: id -> id of that; each is found once."""
    pairs = _pair_nearest(joined, graph, PLACES, lambda a, b: SAME_PLACE)
    pairs |= _pair_nearest(joined, graph, OBJECTS, _get_object_reach)
    pairs |= _pair_rooms(joined, graph, pairs)
    old, new = joined.list_nodes(BUILDINGS), graph.list_nodes(BUILDINGS)
    return pairs | dict(zip(new[:1], old[:1], strict=False))


def _get_object_reach(a: Json, b: Json) -> float:
    """Return how far two nodes of one class may be apart, m; below 0 for two classes."""
    same = [(node.get("semantic_label"), str(node.get("name") or "").split("(")[0]) for node in (a, b)]
    alike = same[0][0] == same[1][0] and (same[0][0] != 2**32 - 1 or same[0][1] == same[1][1])
    sizes = [max((node.get("bounding_box") or {}).get("dimensions") or (0.0,)) for node in (a, b)]
    return max(SAME_OBJECT, min(sizes) / 2) if alike else -1.0


def _pair_nearest(joined: _Graph, graph: _Graph, layer: int, reach: Any) -> dict[int, int]:
    """Pair nodes of a layer that are within reach of each other, the nearest pairs first, each node once."""
    old, new = joined.list_nodes(layer), graph.list_nodes(layer)
    if not old or not new:
        return {}
    tree = cKDTree(joined.get_places(old))
    candidates = []
    for k, place in zip(new, graph.get_places(new), strict=True):
        for row in tree.query_ball_point(place, 5.0 if layer == OBJECTS else SAME_PLACE):
            apart = float(np.linalg.norm(place - tree.data[row]))
            if apart <= reach(joined.nodes[old[row]]["attributes"], graph.nodes[k]["attributes"]):
                candidates.append((apart, k, old[row]))
    pairs: dict[int, int] = {}
    for _, k, other in sorted(candidates):
        if k not in pairs and other not in pairs.values():
            pairs[k] = other
    return pairs


def _pair_rooms(joined: _Graph, graph: _Graph, pairs: Mapping[int, int]) -> dict[int, int]:
    """Pair rooms most of whose places are those of one room; rooms without places by their middles."""
    old, new = joined.find_parents(), graph.find_parents()
    votes: dict[int, Counter[int]] = {}
    sizes = Counter(room for k, room in new.items() if graph.nodes[k]["layer"] == PLACES)
    for k, other in pairs.items():
        if graph.nodes[k]["layer"] == PLACES and k in new and other in old:
            votes.setdefault(new[k], Counter())[old[other]] += 1
    out: dict[int, int] = {}
    for room, counted in sorted(votes.items(), key=lambda item: -max(item[1].values())):
        other, count = counted.most_common(1)[0]
        if other not in out.values() and count >= SHARED_PLACES * sizes[room]:
            out[room] = other
    bare = [r for r in graph.list_nodes(ROOMS) if not sizes[r]]
    free_rooms = [r for r in joined.list_nodes(ROOMS) if r not in out.values()]
    for room in bare if free_rooms else ():
        apart = np.linalg.norm(joined.get_places(free_rooms) - graph.get_places([room]), axis=1)
        other = free_rooms[int(apart.argmin())]
        if apart.min() <= SAME_ROOM and other not in out.values():
            out[room] = other
    return out


def _unite(joined: _Graph, graph: _Graph, pairs: Mapping[int, int], name: str) -> _Graph:
    """Return both graphs as one; of a node that both have the first one's attributes stay, with the name and vertices of the
    other."""
    nodes = dict(joined.nodes)
    for k, node in graph.nodes.items():
        if k not in pairs:
            nodes[k] = node
            continue
        kept, about = nodes[pairs[k]], dict(nodes[pairs[k]]["attributes"])
        other = node["attributes"]
        for listed in (n for n in VERTEX_LISTS if other.get(n)):
            about[listed] = [*(about.get(listed) or ()), *other[listed]]
        if not about.get("name") and other.get("name"):
            about["name"] = other["name"]
        merged = dict((about.get("metadata") or {}).get(MERGED) or {})
        about["metadata"] = {**(about.get("metadata") or {}), MERGED: {**merged, name: [*merged.get(name, ()), k]}}
        nodes[pairs[k]] = {**kept, "attributes": about}
    parents = set(joined.find_parents())
    edges = dict(joined.edges)
    for (a, b), edge in graph.edges.items():
        ends = pairs.get(a, a), pairs.get(b, b)
        low = min(ends, key=lambda end: nodes[end]["layer"])
        crossing = nodes[ends[0]]["layer"] != nodes[ends[1]]["layer"]
        if ends[0] == ends[1] or ends in edges or ends[::-1] in edges or (crossing and low in parents):
            continue
        edges[ends] = {**edge, "source": ends[0], "target": ends[1]}
    keys = [*joined.about.get("layer_keys", ()), *graph.about.get("layer_keys", ())]
    layers = {"layer_keys": [key for n, key in enumerate(keys) if key not in keys[:n]]} if keys else {}
    return _Graph({**joined.about, **layers, **_join_meshes(joined.about, graph.about)}, nodes, edges)


def _join_meshes(a: Json, b: Json) -> Json:
    first, second = a.get("mesh") or {}, b.get("mesh") or {}
    if not second.get("points"):
        return {"mesh": a["mesh"]} if "mesh" in a else {}
    if not first.get("points"):
        return {"mesh": second}
    count = len(first["points"])
    mesh = {**first, "points": [*first["points"], *second["points"]]}
    mesh["faces"] = [*(first.get("faces") or ()), *([v + count for v in face] for face in second.get("faces") or ())]
    for column, flag in MESH_COLUMNS.items():
        both = all(len(m.get(column) or ()) == len(m["points"]) for m in (first, second))
        mesh.pop(column, None)
        if both:
            mesh[column] = [*first[column], *second[column]]
        mesh[flag] = both
    return {"mesh": mesh}


def _iter_sorted(nodes: Mapping[int, Json]) -> Iterator[Json]:
    yield from (nodes[k] for k in sorted(nodes, key=lambda k: (nodes[k]["layer"], k)))


def _build_file(graph: _Graph) -> Json:
    return {**graph.about, "nodes": list(_iter_sorted(graph.nodes)), "edges": list(graph.edges.values())}
