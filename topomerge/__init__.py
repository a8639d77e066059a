"""topomerge: rooms, doors and storeys out of partial indoor maps, matched and merged across sensors.

    import topomerge as tm
    a = tm.extract(tm.read_points("a.ply"))

What the package offers is imported when it is first asked for, so that ``import topomerge`` and ``topomerge --help``
stay fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from topomerge.writers import WRITERS

if TYPE_CHECKING:
    from topomerge.changes.compare import Changes as Changes
    from topomerge.changes.compare import align_maps as align_maps
    from topomerge.changes.compare import compare_maps as compare_maps
    from topomerge.edits.apply import apply_edits as apply_edits
    from topomerge.edits.apply import load_corrected_map as load_corrected_map
    from topomerge.edits.journal import Edit as Edit
    from topomerge.edits.journal import append_edits as append_edits
    from topomerge.edits.journal import build_edit as build_edit
    from topomerge.edits.journal import read_journal as read_journal
    from topomerge.embedding.learned import load_embedder as load_embedder
    from topomerge.errors import InputError as InputError
    from topomerge.extraction.extract import extract as extract
    from topomerge.extraction.parameters import PRESETS as PRESETS
    from topomerge.extraction.voxels import voxelise as voxelise
    from topomerge.extraction.zones import cut_zones as cut_zones
    from topomerge.fusion.atlas.find import find as find
    from topomerge.fusion.atlas.locate import locate as locate
    from topomerge.fusion.atlas.result import AtlasResult as AtlasResult
    from topomerge.fusion.atlas.solve import build_atlas as build_atlas
    from topomerge.fusion.pipeline import merge as merge
    from topomerge.fusion.result import MergeResult as MergeResult
    from topomerge.io.exports import save_export as save_export
    from topomerge.io.listing import convert_map_to_json as convert_map_to_json
    from topomerge.io.listing import save_json as save_json
    from topomerge.io.maps import load_map as load_map
    from topomerge.io.maps import save_map as save_map
    from topomerge.io.points import read_chunks as read_chunks
    from topomerge.io.points import read_points as read_points
    from topomerge.io.rooms_ply import save_rooms_ply as save_rooms_ply
    from topomerge.types import PointCloud as PointCloud
    from topomerge.types import Sim3 as Sim3
    from topomerge.types import TopometricMap as TopometricMap
    from topomerge.types import VoxelGrid as VoxelGrid
    from topomerge.viz.atlas_report import render_atlas_html as render_atlas_html
    from topomerge.viz.figures import plot_plan as plot_plan
    from topomerge.viz.figures import save_figure as save_figure
    from topomerge.viz.merge_report import save_merge as save_merge
    from topomerge.viz.report import save_report as save_report

__version__ = "0.1.0"

_HOMES = {
    "AtlasResult": "topomerge.fusion.atlas.result",
    "Edit": "topomerge.edits.journal",
    "append_edits": "topomerge.edits.journal",
    "apply_edits": "topomerge.edits.apply",
    "build_edit": "topomerge.edits.journal",
    "load_corrected_map": "topomerge.edits.apply",
    "read_journal": "topomerge.edits.journal",
    "Changes": "topomerge.changes.compare",
    "align_maps": "topomerge.changes.compare",
    "compare_maps": "topomerge.changes.compare",
    "find": "topomerge.fusion.atlas.find",
    "locate": "topomerge.fusion.atlas.locate",
    "InputError": "topomerge.errors",
    "MergeResult": "topomerge.fusion.result",
    "PRESETS": "topomerge.extraction.parameters",
    "PointCloud": "topomerge.types",
    "Sim3": "topomerge.types",
    "TopometricMap": "topomerge.types",
    "VoxelGrid": "topomerge.types",
    "build_atlas": "topomerge.fusion.atlas.solve",
    "render_atlas_html": "topomerge.viz.atlas_report",
    "cut_zones": "topomerge.extraction.zones",
    "extract": "topomerge.extraction.extract",
    "load_embedder": "topomerge.embedding.learned",
    "load_map": "topomerge.io.maps",
    "convert_map_to_json": "topomerge.io.listing",
    "merge": "topomerge.fusion.pipeline",
    "plot_plan": "topomerge.viz.figures",
    "read_chunks": "topomerge.io.points",
    "read_points": "topomerge.io.points",
    "save_export": "topomerge.io.exports",
    "save_figure": "topomerge.viz.figures",
    "save_json": "topomerge.io.listing",
    "save_map": "topomerge.io.maps",
    "save_merge": "topomerge.viz.merge_report",
    "save_report": "topomerge.viz.report",
    "save_rooms_ply": "topomerge.io.rooms_ply",
    "voxelise": "topomerge.extraction.voxels",
}

# Deprecated names of 0.1: they give what they gave.
_RENAMED = {
    "atlas": "build_atlas",
    "atlas_html": "render_atlas_html",
    "map_to_json": "convert_map_to_json",
    "plan_figure": "plot_plan",
}

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    """Import a public name from its home (PEP 562)."""
    name = _RENAMED.get(name, name)
    if name not in _HOMES:
        raise AttributeError(f"module 'topomerge' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def _write_merge(result: Any, folder: Any) -> None:
    __getattr__("save_merge")(result, folder)


WRITERS["merge"] = _write_merge


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
