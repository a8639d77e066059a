"""The maps of a merge or an atlas as a pose graph of g2o: to optimise it elsewhere, and to come back with `topomerge move`."""

from __future__ import annotations

from pathlib import Path

from topomerge.archive import replace_on_success
from topomerge.errors import InputError
from topomerge.io.native.pose_graph import PoseGraph, format_pose_graph
from topomerge.types import TopometricMap


def save(map: TopometricMap, path: Path, graph: PoseGraph | None = None) -> None:
    """Write the graph; a vertex is a map, by its number in merge.json or atlas.json.

    Raises:
        InputError: there is no graph, or the path can't be written.
    """
    del map
    if graph is None:
        raise InputError("g2o: needs to know where maps lie; give the folder of a merge or an atlas that brought some together")
    with replace_on_success(path) as temporary:
        temporary.write_text(format_pose_graph(graph), encoding="utf-8")
