"""A look at an index' graph before the library reads it: it follows links blindly, and a stranger's may lead anywhere.

The layout is that of usearch 2: vectors, a head, levels, and for each room its key, level and the rooms it is linked to.
"""

from __future__ import annotations

import numpy as np

from topomerge.types import Array

INDEX_HEAD, GRAPH_HEAD = (
    64,
    40,
)  # bytes: of the file, and of the graph: rooms, links, links at the lowest level, levels, first room
KINDS = b"i\x17\x0e\x0f"  # inner product, eight bits a number, keys of 64 bits, links of 32 bits
NODE = 10  # bytes of a room's key and level
HIGHEST_LEVEL = 64
LISTS_AT_ONCE = 1 << 14


def check_graph(graph: bytes, count: int, size: int, links: int) -> None:
    """Does a graph hold vectors (count, size), and does every link lead to one of them?

    Args:
        links: most of a room at each level; at the lowest twice as many.

    Raises:
        ValueError: it does not.
    """
    whole = np.frombuffer(graph, np.uint8)
    start = 8 + count * size
    if len(whole) < start + INDEX_HEAD + GRAPH_HEAD + 2 * count or tuple(_at(whole, [0], 2)[0]) != (count, size):
        raise ValueError("cut off, or of other vectors")
    head = graph[start : start + INDEX_HEAD]
    if head[:7] != b"usearch" or head[13:17] != KINDS:
        raise ValueError("of another version; update topomerge or usearch")
    if tuple(np.frombuffer(head[17:41], np.uint64)) != (count, 0, size) or head[41]:
        raise ValueError("rooms are missing")
    start += INDEX_HEAD
    levels = np.frombuffer(graph[start + GRAPH_HEAD : start + GRAPH_HEAD + 2 * count], np.int16).astype(np.int64)
    rooms, upper, lowest, highest, first = (int(n) for n in np.frombuffer(graph[start : start + GRAPH_HEAD], np.uint64))
    if not count or (rooms, upper, lowest) != (count, links, 2 * links) or first >= count:
        raise ValueError("its head is wrong")
    if levels.min() < 0 or levels.max() > HIGHEST_LEVEL or levels[first] != highest or highest != levels.max():
        raise ValueError("its levels are wrong")
    sizes = NODE + 4 * (1 + lowest) + levels * 4 * (1 + upper)
    ends = start + GRAPH_HEAD + 2 * count + np.cumsum(sizes)
    if ends[-1] != len(whole):
        raise ValueError("cut off")
    nodes = ends - sizes
    keys = _at(whole, nodes, 2)
    if (keys[:, 1] != 0).any() or len(np.unique(keys[:, 0])) < count or keys[:, 0].max() >= count:
        raise ValueError("keys are wrong")
    if not np.array_equal(_at(whole, nodes + NODE - 4, 1)[:, 0] >> 16, levels):
        raise ValueError("its levels are wrong")
    _check_links(whole, nodes + NODE, lowest, np.ones(count, bool))
    for level in range(1, highest + 1):
        at = nodes[levels >= level] + NODE + 4 * (1 + lowest) + (level - 1) * 4 * (1 + upper)
        _check_links(whole, at, upper, levels >= level)


def _check_links(whole: Array, places: Array, most: int, there: Array) -> None:
    """Lists at these bytes, each the number of links and then so many rooms, which must be `there` at this level."""
    for k in range(0, len(places), LISTS_AT_ONCE):
        lists = _at(whole, places[k : k + LISTS_AT_ONCE], 1 + most)
        to = lists[:, 1:][np.arange(most) < lists[:, :1]]
        if lists[:, 0].max() > most or to.max(initial=0) >= len(there) or not there[to].all():
            raise ValueError("links lead nowhere")


def _at(whole: Array, places: Array | list[int], count: int) -> Array:
    """(n, count) whole numbers of 32 bits that begin at these bytes."""
    at = np.asarray(places)[:, None] + np.arange(4 * count)
    return np.ascontiguousarray(whole[at]).view("<u4").astype(np.int64)
