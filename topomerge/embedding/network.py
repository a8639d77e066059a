"""Settings of an embedding network: plain dataclasses, stored as JSON beside its weights; and the inputs that it reads of a map's
graph."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from topomerge.embedding.graph import POINTS_PER_ROOM, TABLES
from topomerge.embedding.surroundings import CROP_SHAPES
from topomerge.errors import InputError
from topomerge.networks.network import Signature, Tensor
from topomerge.registry import GEOMETRIES, NODES

LANDMARK_PART = "landmarks"  # is added to what the other parts say: a room without landmarks stays as it is, to the bit
# Part -> table of the graph that it reads.
TABLE_PARTS = {"scalars": "x", "engineered": "engineered", "shapedna": "shapedna", LANDMARK_PART: "landmarks"}
GRAPH = ("edge_index", "edge_attr")
LARGEST_WIDTH = 4096  # more is a mistake, or a file that was made to take all memory
FARTHEST_AROUND = 100.0  # m
JUMPS = ("last", "cat", "max")


@dataclass
class Geometry:
    """Room -> vector.

    Args:
        parts: of `list_geometry_parts`, or an encoder of one's own of crops, as `surroundings:mine`; several are concatenated.
        width: of the vector.
        yaws: turns over which an encoder of points takes the mean.
        canonical: turn the longest axis into x first.
    """

    parts: list[str] = field(default_factory=lambda: ["scalars"])
    width: int = 64
    yaws: int = 4
    canonical: bool = False


@dataclass
class Node:
    """Rooms and the edges between them -> vector.

    Args:
        kind: of `topomerge.registry.NODES`, or none.
        layers: 1 to 4.
        heads: of the attention.
        edges: use the features of edges.
        edge_values: attention sums values of neighbours and of edges (`models.nodes.EdgeValueConv`); False: as in the paper,
            edges change the weights of the neighbours only (`torch_geometric.nn.GATv2Conv`).
        doors: layers over pairs of doors; needs `edges`.
        near: pairs are all doors within 12 m (`embedding.engineered.compute_door_layout`), not only those of one room.
        around: m; rooms at most that far away are neighbours, too (`embedding.graph.add_proximity_edges`); 0: by doors only.
        ways: edges tell in which direction of the building their neighbour and its door are; needs `edges`.
        skip: add what goes into a layer to what comes out.
        jump: what the last layer says, or all of them joined or their maximum (jumping knowledge: Xu et al. 2018).
        width: of edges.
    """

    kind: str = "gat"
    layers: int = 2
    heads: int = 4
    edges: bool = True
    edge_values: bool = True
    doors: int = 0
    near: bool = False
    around: float = 0.0
    ways: bool = False
    skip: bool = True
    jump: str = "cat"
    width: int = 32


@dataclass
class Network:
    """The whole of it; `size` is the width of an embedding."""

    geometry: Geometry = field(default_factory=Geometry)
    node: Node = field(default_factory=Node)
    size: int = 64
    dropout: float = 0.1

    @property
    def turns(self) -> int:
        """1, or 4 where what a room gets depends on how the map is turned: it gets a row for each quarter turn then."""
        turned = any(find_tensor(part) in CROP_SHAPES for part in self.geometry.parts)
        return 4 if turned or (self.node.ways and self.node.kind != "none") else 1


def list_geometry_parts() -> tuple[str, ...]:
    """Return what a geometry can be made of: tables, encoders of points (`topomerge.registry.GEOMETRIES`) and of surroundings."""
    return (*TABLE_PARTS, *GEOMETRIES, *CROP_SHAPES)


def find_tensor(part: str) -> str:
    """Return the tensor of the graph that a part of the geometry reads."""
    crops = part.partition(":")[0]
    return crops if crops in CROP_SHAPES else TABLE_PARTS.get(part, "room_points")


def find_crop_encoder(part: str) -> str:
    """Return the registered encoder that a part such as `surroundings:mine` names; empty where it names none."""
    crops, _, encoder = part.partition(":")
    return encoder if crops in CROP_SHAPES else ""


def list_pair_tensors(node: Node) -> tuple[str, ...]:
    """Return names of the tensors that tell of pairs of doors, if the node encoder reads any."""
    if not node.doors or node.kind == "none":
        return ()
    return ("near_index", "near_attr") if node.near else ("door_index", "door_attr")


def list_tensors(network: Network) -> tuple[str, ...]:
    """Return names of the tensors that a network reads."""
    directions = ("edge_way",) if network.node.ways and network.node.kind != "none" else ()
    return (
        *dict.fromkeys(find_tensor(part) for part in network.geometry.parts),
        *GRAPH,
        *list_pair_tensors(network.node),
        *directions,
    )


def build_embedder_signature(network: Network) -> Signature:
    """Describe an embedder as one call runs it: on a map as it is turned."""
    counted = {"edge_attr": "edges", "edge_way": "edges", "door_attr": "pairs", "near_attr": "pairs"}
    inputs = {}
    for name in list_tensors(network):
        count = counted.get(name, "rooms")
        if name in TABLES:
            inputs[name] = Tensor((count, len(TABLES[name])), ", ".join(TABLES[name]))
        elif name in CROP_SHAPES:
            inputs[name] = Tensor((count, *CROP_SHAPES[name]), "what stands around each room, seen from above", "uint8")
        elif name == "room_points":
            inputs[name] = Tensor((count, POINTS_PER_ROOM, 3), "m, points of each room about its middle")
        elif name == "edge_index":
            inputs[name] = Tensor((2, "edges"), "rooms at both ends of each edge", "int64")
        else:
            inputs[name] = Tensor((2, "pairs"), "both edges of each pair of doors", "int64")
    outputs = {
        "embedding": Tensor(("rooms", network.size), "rows of length 1, of the map as it is turned"),
        "dustbin": Tensor(("rooms",), "logit of having no partner"),
    }
    return Signature("Says what each room of a map looks like, from itself and its neighbours.", inputs, outputs)


def check(network: Network) -> None:
    """Refuse what can't be built.

    Raises:
        InputError: names the key.
    """
    for part in network.geometry.parts:
        if isinstance(part, str) and (encoder := find_crop_encoder(part)):
            GEOMETRIES.check(encoder)
        elif not isinstance(part, str) or part not in (possible := list_geometry_parts()):
            raise InputError(f"geometry.parts: unknown {part!r}; {', '.join(possible)} are possible")
    if network.node.kind not in ("none", *NODES):
        raise InputError(f"node.kind: unknown {network.node.kind!r}; none, {', '.join(NODES)} are possible")
    _check_sizes(network)


def _check_sizes(network: Network) -> None:
    """Refuse what no network can have, whatever its encoders are."""
    geometry, node = network.geometry, network.node
    if not geometry.parts or len(set(map(str, geometry.parts))) < len(geometry.parts):
        raise InputError("geometry.parts must be one or more, each once")
    if not all(isinstance(part, str) for part in geometry.parts):
        raise InputError(f"geometry.parts must be names, not {geometry.parts!r}")
    if node.jump not in JUMPS:
        raise InputError(f"node.jump: unknown {node.jump!r}; {', '.join(JUMPS)} are possible")
    if node.kind != "none" and not 1 <= node.layers <= 4:
        raise InputError(f"node.layers must be 1 to 4, not {node.layers}")
    if node.ways and not node.edges:
        raise InputError("node.ways are features of edges: set node.edges=true")
    if node.doors and not node.edges:
        raise InputError("node.doors are features of edges: set node.edges=true")
    if node.doors and node.around:
        raise InputError("node.doors are of neighbours by doors: set node.around=0")
    if not 0 <= node.around <= FARTHEST_AROUND:
        raise InputError(f"node.around must be 0 to {FARTHEST_AROUND:g} m, not {node.around}")
    if geometry.canonical and geometry.yaws % 2:
        raise InputError(f"geometry.yaws must be even where canonical is set (an axis has two ends), not {geometry.yaws}")
    least = {"geometry.width": geometry.width, "geometry.yaws": geometry.yaws, "node.heads": node.heads, "size": network.size}
    for key, value in least.items() | {("node.width", node.width)}:
        if not 1 <= value <= LARGEST_WIDTH:
            raise InputError(f"{key} must be 1 to {LARGEST_WIDTH}, not {value}")
    if not 0 <= node.doors <= 4:
        raise InputError(f"node.doors must be 0 to 4, not {node.doors}")
    if geometry.width % node.heads:
        raise InputError(f"geometry.width must be a multiple of node.heads: {geometry.width} and {node.heads}")
    if not 0 <= network.dropout < 1:
        raise InputError(f"dropout must be 0 or more and below 1, not {network.dropout}")


def build_network(table: Mapping[str, Any], known: bool = True) -> Network:
    """Build a network from what `dataclasses.asdict` gave.

    Args:
        known: its encoders must be; False: an exported network brings them along.

    Raises:
        InputError: an unknown key, a value of another type, or what can't be built.
    """
    network = Network(
        geometry=_fill_dataclass(Geometry, table.get("geometry", {}), "geometry."),
        node=_fill_dataclass(Node, table.get("node", {}), "node."),
        **{k: v for k, v in _check_values(Network, table, "").items() if k not in ("geometry", "node")},
    )
    check(network) if known else _check_sizes(network)
    return network


def _fill_dataclass(kind: type, table: Any, where: str) -> Any:
    return kind(**_check_values(kind, table, where))


def _check_values(kind: type, table: Any, where: str) -> dict[str, Any]:
    """Return the values of a dataclass' fields, if each is of the type of its default."""
    if not isinstance(table, Mapping):
        raise InputError(f"{where.rstrip('.') or 'network'} must be a table of keys, not {table!r}")
    defaults = asdict(kind())
    keys = {f.name for f in fields(kind)}
    for key, value in table.items():
        if key not in keys:
            raise InputError(f"unknown key {where}{key}; {', '.join(sorted(keys))} are possible")
        expected = float if isinstance(defaults[key], float) and not isinstance(value, bool) else type(defaults[key])
        if not (isinstance(value, expected) or (expected is float and isinstance(value, int))) or (
            expected is int and isinstance(value, bool)
        ):
            raise InputError(f"{where}{key} must be {expected.__name__}, not {value!r}")
    return dict(table)
