"""Which object each vertex of a mesh belongs to, in the two files that ScanNet and 3RScan have for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from topomerge.datasets.public.sources import read_json

from topomerge.errors import InputError
from topomerge.types import Array


def read_objects(segments: Path, groups: Path, vertices: int) -> tuple[tuple[str, ...], Array]:
    """Labels of the objects, and (n,) int32 object of each vertex, -1: none.

    Args:
        segments: ``*.segs.json`` with `segIndices`, the segment of each vertex.
        groups: ``*aggregation.json`` or ``semseg*.json`` with `segGroups`, the label and the segments of each object.
        vertices: of the mesh.

    Raises:
        InputError: missing or damaged file, or one of another mesh.
    """
    held, listed = read_json(segments), read_json(groups)
    try:
        segment = np.array(held["segIndices"], np.int64)
        objects = [(str(g["label"]), np.array(g["segments"], np.int64)) for g in listed["segGroups"]]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{groups}: it or {segments.name} lacks what a segmentation holds ({error}); copy both again") from error
    if len(segment) != vertices:
        raise InputError(f"{segments}: segments {len(segment)} vertices and the mesh has {vertices}; are both of one version?")
    out = np.full(len(segment), -1, np.int32)
    for number, (_, members) in enumerate(objects):
        out[np.isin(segment, members)] = number
    return tuple(label for label, _ in objects), out
