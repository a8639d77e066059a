"""Compiled parts of file formats: LZF, CRC-32C and the nodes of an OctoMap. They read what may be damaged, so they check
every index and answer with -1 instead of failing."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

LEAF_LEVEL = 16  # depth of the smallest cells of an OctoMap
UNKNOWN_CHILD, FREE_LEAF, OCCUPIED_LEAF, INNER_CHILD = 0, 1, 2, 3


@njit(cache=True)
def _unpack(data, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    i, o = 0, 0
    while i < len(data):
        control = int(data[i])
        i += 1
        if control < 32:  # a run of control + 1 literal bytes
            n = control + 1
            if i + n > len(data) or o + n > len(out):
                return -1
            for _ in range(n):
                out[o] = data[i]
                i += 1
                o += 1
            continue
        n = control >> 5  # a copy of n + 2 bytes from further back
        if n == 7:
            if i >= len(data):
                return -1
            n += int(data[i])
            i += 1
        if i >= len(data):
            return -1
        back = o - (((control & 31) << 8) | int(data[i])) - 1
        i += 1
        n += 2
        if back < 0 or o + n > len(out):
            return -1
        for _ in range(n):
            out[o] = out[back]
            back += 1
            o += 1
    return o


def unpack_lzf(data: NDArray[np.uint8], size: int) -> NDArray[np.uint8] | None:
    """Return the `size` bytes that LZF data unpacks to, or None where it does not (Lehmann, liblzf: the format)."""
    out = np.empty(size, np.uint8)
    return out if int(_unpack(data, out)) == size else None


def _build_crc_table() -> NDArray[np.uint32]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(0x82F63B78), table >> 1).astype(np.uint32)
    return table


@njit(cache=True)
def _compute_crc_pages(pages, table, out):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    for p in range(pages.shape[0]):
        crc = np.uint32(0xFFFFFFFF)
        for k in range(pages.shape[1]):
            crc = np.uint32(table[(crc ^ pages[p, k]) & np.uint32(0xFF)] ^ (crc >> np.uint32(8)))
        out[p] = crc ^ np.uint32(0xFFFFFFFF)


def compute_crc32c(pages: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Return (n,) CRC-32C (Castagnoli, RFC 3720) of each row of (n, k) bytes."""
    out = np.empty(len(pages), np.uint32)
    _compute_crc_pages(pages, _build_crc_table(), out)
    return out


@njit(cache=True)
def _walk_octree(data, keys, depths, states, stack):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Walk the nodes; return (leaves, bytes read), leaves -1 where the tree is broken."""
    count, at = 0, 0
    top = 1
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 0, 0, 0, 0
    while top > 0:
        top -= 1
        x, y, z, depth = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        if at + 2 > len(data) or depth >= LEAF_LEVEL:
            return -1, at
        bits = int(data[at]) | (int(data[at + 1]) << 8)
        at += 2
        side = 1 << (LEAF_LEVEL - depth - 1)
        for child in range(7, -1, -1):  # the stack turns the order around
            state = (bits >> (2 * child)) & 3
            if state == UNKNOWN_CHILD:
                continue
            cx, cy, cz = x + (child & 1) * side, y + ((child >> 1) & 1) * side, z + ((child >> 2) & 1) * side
            if state == INNER_CHILD:
                stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = cx, cy, cz, depth + 1
                top += 1
                continue
            keys[count, 0], keys[count, 1], keys[count, 2] = cx, cy, cz
            depths[count] = depth + 1
            states[count] = state
            count += 1
    return count, at


def read_octree_leaves(data: NDArray[np.uint8]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]] | None:
    """Return the leaves of an OctoMap's nodes in depth-first order, or None where they are cut short or broken.

    Returns:
        (n, 3) int32 smallest cell of each leaf in 0..65535, (n,) int8 depth 1..16 and (n,) int8 FREE_LEAF or OCCUPIED_LEAF.
    """
    pairs = np.stack([(data >> s) & 3 for s in (0, 2, 4, 6)], axis=1)
    room = int(((pairs == FREE_LEAF) | (pairs == OCCUPIED_LEAF)).sum())
    keys, depths, states = np.empty((room, 3), np.int32), np.empty(room, np.int8), np.empty(room, np.int8)
    stack = np.empty((8 * LEAF_LEVEL + 8, 4), np.int32)
    count, read = _walk_octree(data, keys, depths, states, stack)
    if count < 0 or read != len(data):
        return None
    return keys[:count], depths[:count], states[:count]


@njit(cache=True)
def _walk_full_octree(data, width, keys, depths, states, stack):  # type: ignore[no-untyped-def]  # pragma: no cover - compiled
    """Walk the nodes of `width` bytes, log-odds first and bits of the children last; return as `_walk_octree` does."""
    top, count, at = 1, 0, 0
    stack[0, :] = 0
    while top > 0:
        top -= 1
        x, y, z, depth = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        if at + width > len(data):
            return -1, at
        high, bits = int(data[at + 3]), int(data[at + width - 1])
        if (high & 0x7F) == 0x7F and int(data[at + 2]) & 0x80:
            return -1, at  # not finite
        if bits == 0:
            free = (high & 0x80) != 0 and (high & 0x7F or data[at] or data[at + 1] or data[at + 2])  # below 0, and not -0
            keys[count, 0], keys[count, 1], keys[count, 2] = x, y, z
            depths[count] = depth
            states[count] = FREE_LEAF if free else OCCUPIED_LEAF
            count += 1
        elif depth >= LEAF_LEVEL:
            return -1, at
        at += width
        side = 1 << (LEAF_LEVEL - depth - 1) if depth < LEAF_LEVEL else 0
        for child in range(7, -1, -1):
            if (bits >> child) & 1:
                stack[top, 0], stack[top, 1] = x + (child & 1) * side, y + ((child >> 1) & 1) * side
                stack[top, 2], stack[top, 3] = z + ((child >> 2) & 1) * side, depth + 1
                top += 1
    return count, at


def read_full_octree_leaves(data: NDArray[np.uint8], width: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]] | None:
    """Return, as `read_octree_leaves`, the leaves of the nodes of a full OctoMap, each of `width` bytes; the root may be a leaf
    (of depth 0)."""
    room = len(data) // width
    keys, depths, states = np.empty((room, 3), np.int32), np.empty(room, np.int8), np.empty(room, np.int8)
    stack = np.empty((8 * LEAF_LEVEL + 8, 4), np.int32)
    count, read = _walk_full_octree(data, width, keys, depths, states, stack)
    if count < 0 or read != len(data):
        return None
    return keys[:count], depths[:count], states[:count]
