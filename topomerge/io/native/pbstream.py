"""States of Cartographer joined into one with all trajectories in one frame, which Cartographer loads.

Poses of nodes, submaps and landmarks are moved in the pose graph. All else (grids, nodes' scans, what sensors measured) stands in
frames of its own trajectory and stays to the byte, but for the trajectory's number. Constraints hold the trajectories together.
"""

from __future__ import annotations

import gzip
import struct
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np
from scipy.spatial.transform import Rotation

from topomerge.errors import InputError
from topomerge.io.native import Doubt, Motion, Source, Tally, find_nearest_links
from topomerge.io.pbstream import (
    BYTES,
    FIXED64,
    KIND,
    MAGIC,
    OPTIONS,
    POSE_GRAPH,
    SUBMAP,
    VARINT,
    VERSIONS,
    Field,
    Key,
    PoseGraph,
    get_int,
    get_message,
    iter_messages,
    parse_message,
    parse_pose,
    parse_pose_graph,
)
from topomerge.io.piece import build_damage_error
from topomerge.types import Array

NAMES = {3: "submaps", 4: "nodes", 5: "trajectories", 6: "readings", 7: "readings", 8: "readings", 9: "readings"}
INTER_SUBMAP = 1
Change = Callable[[bytes], bytes]


@dataclass(frozen=True, eq=False)
class _State:
    """The graph and options of a file, the number that its first trajectory gets, and what else it holds."""

    source: Source
    graph: PoseGraph
    graph_data: bytes
    options: bytes
    first: int
    counts: Counter[str]
    flat: bool


def join(sources: Sequence[Source], target: Path, doubt: Doubt) -> Tally:
    """Write all states as one.

    Raises:
        InputError: one is damaged, some are flat and others not, or a flat one would be tilted.
    """
    states: list[_State] = []
    for source in sources:
        first = sum(_count_trajectories(state.graph) for state in states)
        states.append(_guard(source.path, partial(_read_state, source, first)))
    for state in states:
        if state.flat != states[0].flat:
            raise InputError(f"{state.source.path}: one state is flat and the other is not; only states of one kind are joined")
        if state.flat and not state.source.motion.level:
            raise InputError(f"{state.source.path}: is a state in a plane, and its map is tilted; it can't be written truly")
    graph, between = _join_graphs(states, doubt)
    with target.open("wb") as out:
        out.write(MAGIC)
        _write(out, _encode([(1, VARINT, VERSIONS[-1])]))
        _write(out, _encode([(POSE_GRAPH, BYTES, graph)]))
        _write(out, _encode([(OPTIONS, BYTES, b"".join(_move_options(state) for state in states))]))
        for state in states:
            _guard(state.source.path, partial(_copy, state, out))
    reread = _guard(target, partial(_read_state, Source(target), 0))
    before: Counter[str] = sum((state.counts for state in states), Counter())
    counts = {name: (before[name], reread.counts[name]) for name in dict.fromkeys([*NAMES.values(), "landmarks"])}
    links = sum(state.graph.constraints for state in states) + between
    return Tally(counts | {"links": (links, reread.graph.constraints), "links between sessions": (between, between)})


def _guard(path: Path, act: Callable[[], _State]) -> _State:
    try:
        return act()
    except (ValueError, struct.error) as error:
        if isinstance(error, InputError):
            raise
        raise build_damage_error(path, KIND, error) from error


def _count_trajectories(graph: PoseGraph) -> int:
    return max((t for t, _ in [*graph.nodes, *graph.submaps]), default=-1) + 1


def _read_state(source: Source, first: int) -> _State:
    graph, data, options, flat = PoseGraph(), b"", b"", False
    counts: Counter[str] = Counter()
    for message, _ in iter_messages(source.path):
        for number, _, value in parse_message(message):
            if not isinstance(value, bytes):
                continue
            if number == POSE_GRAPH:
                data, graph = value, parse_pose_graph(value)
            elif number == OPTIONS:
                options = value
            elif number in NAMES:
                counts[NAMES[number]] += 1
                flat |= number == SUBMAP and bool(get_message(parse_message(value), 2))
    if not graph.nodes and not graph.submaps:
        raise InputError(f"{source.path}: has no pose graph; finish the trajectory before it is saved")
    counts["landmarks"] = len(graph.landmarks)
    counts["trajectories"] = len({t for t, _ in [*graph.nodes, *graph.submaps]})
    return _State(source, graph, data, options, first, counts, flat)


def _write(out: IO[bytes], message: bytes) -> None:
    packed = gzip.compress(message, compresslevel=1, mtime=0)
    out.write(len(packed).to_bytes(8, "little") + packed)


def _encode(fields: Sequence[Field]) -> bytes:
    parts = []
    for number, kind, value in fields:
        parts.append(_encode_varint(number << 3 | kind))
        if isinstance(value, int):
            parts.append(_encode_varint(value))
        elif kind == BYTES:
            parts += [_encode_varint(len(value)), value]
        else:
            parts.append(value)
    return b"".join(parts)


def _encode_varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _encode_pose(pose: Array) -> bytes:
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
    parts = [_encode([(k + 1, FIXED64, struct.pack("<d", v)) for k, v in enumerate(values)]) for values in (pose[:3, 3], turn)]
    return _encode([(1, BYTES, parts[0]), (2, BYTES, parts[1])])


def _change(data: bytes, changes: Mapping[int, Change]) -> bytes:
    """Return a message in which submessages are changed; others stay as they are."""
    fields: list[Field] = [
        (number, kind, changes[number](value) if kind == BYTES and number in changes and isinstance(value, bytes) else value)
        for number, kind, value in parse_message(data)
    ]
    return _encode(fields)


def _renumber(data: bytes, field: int, first: int) -> bytes:
    """Return a message whose number of a trajectory is moved up; 0 is not written in Protocol Buffers."""
    if not first:
        return data
    fields = parse_message(data)
    rest: list[Field] = [f for f in fields if f[0] != field]
    return _encode([(field, VARINT, get_int(fields, field) + first), *rest])


def _move_pose(data: bytes, motion: Motion) -> bytes:
    return data if motion.still else _encode_pose(motion.move_poses(parse_pose(data)[None])[0])


def _join_graphs(states: Sequence[_State], doubt: Doubt) -> tuple[bytes, int]:
    """Return the pose graph of all, and how many constraints join them."""
    parts, seen = [], set[str]()
    nodes: list[list[Key]] = []
    places: list[Array] = []
    moved: list[dict[Key, Array]] = []
    for state in states:
        first, motion = state.first, state.source.motion

        def move(data: bytes, motion: Motion = motion) -> bytes:
            return _move_pose(data, motion)

        def renumber(data: bytes, first: int = first) -> bytes:
            return _renumber(data, 1, first)

        trajectory = {1: lambda d, m=move: _change(d, {5: m}), 2: lambda d, m=move: _change(d, {1: m})}
        fields: list[Field] = []
        for number, kind, value in parse_message(state.graph_data):
            if number == 2 and isinstance(value, bytes):
                value = _change(value, {1: renumber, 2: renumber})
            elif number == 4 and isinstance(value, bytes):
                value = _renumber(_change(value, trajectory), 3, first)
            elif number == 5 and isinstance(value, bytes):
                name = get_message(parse_message(value), 1).decode("utf-8", "replace")
                if name in seen:  # the tag of another session: its place is that of the first one
                    continue
                seen.add(name)
                value = _change(value, {2: move})
            fields.append((number, kind, value))
        parts.append(_encode(fields))
        nodes.append(list(state.graph.nodes))
        own = np.array([state.graph.nodes[k] for k in nodes[-1]]).reshape(-1, 4, 4)
        placed = motion.move_poses(own)
        places.append(placed[:, :3, 3])
        moved.append(dict(zip(nodes[-1], placed, strict=True)))
    links = []
    for a, i, b, j in find_nearest_links(places):
        submaps = {k: states[a].source.motion.move_poses(p[None])[0] for k, p in states[a].graph.submaps.items()}
        if submaps:
            near = min(submaps, key=lambda k: float(np.linalg.norm(submaps[k][:3, 3] - places[a][i])))
            links.append(
                _encode_constraint(
                    (states[a].first, near), submaps[near], (states[b].first, nodes[b][j]), moved[b][nodes[b][j]], doubt
                )
            )
    return b"".join([*parts, *(_encode([(2, BYTES, link)]) for link in links)]), len(links)


def _encode_constraint(submap: tuple[int, Key], start: Array, node: tuple[int, Key], end: Array, doubt: Doubt) -> bytes:
    ids = [_encode([(1, VARINT, first + key[0]), (2, VARINT, key[1])]) for first, key in (submap, node)]
    weights = [struct.pack("<d", spread**-2) for spread in (doubt.place, doubt.turn)]
    return _encode(
        [
            (1, BYTES, ids[0]),
            (2, BYTES, ids[1]),
            (3, BYTES, _encode_pose(np.linalg.inv(start) @ end)),
            (5, VARINT, INTER_SUBMAP),
            (6, FIXED64, weights[0]),
            (7, FIXED64, weights[1]),
        ]
    )


def _move_options(state: _State) -> bytes:
    """Return the options of the trajectories; where one began in another one, that has another number now."""

    def renumber(data: bytes) -> bytes:
        return _renumber(data, 2, state.first)

    return _change(state.options, {1: lambda d: _change(d, {2: lambda e: _change(e, {4: renumber})})})


def _copy(state: _State, out: IO[bytes]) -> _State:
    """Copy all messages but the graph and the options."""
    first, motion = state.first, state.source.motion
    key: Mapping[int, Change] = {1: lambda d: _renumber(d, 1, first)}
    for message, _ in iter_messages(state.source.path):
        fields: list[Field] = []
        for number, kind, value in parse_message(message):
            if number in (POSE_GRAPH, OPTIONS):
                continue
            if isinstance(value, bytes) and number in NAMES:
                if number <= 4:
                    value = _change(value, key)
                else:
                    value = _renumber(_change(value, {4: lambda d: _move_pose(d, motion)}) if number == 5 else value, 1, first)
            fields.append((number, kind, value))
        if fields:
            _write(out, _encode(fields))
    return state
