"""Maps of `scale_maps.py` with what atlases of them (`scale.py`) have laid coarsely, so that it is not made again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.merging.scale_maps import ScaleMap
from topomerge.fusion.atlas.folder import read_atlas
from topomerge.fusion.atlas.maps import Maps, Memory, map_key
from topomerge.fusion.atlas.registration_cache import Journal
from topomerge.io.maps import load_map


def held(maps: Sequence[ScaleMap], folder: Path) -> Maps:
    """The maps; `Memory.coarse` of their memory is what the atlases in a folder hold."""
    atlases = [path.parent for path in sorted(folder.glob("atlas_*/atlas.json"))]
    coarse = {pair: x for atlas in atlases for pair, x in Journal(atlas, read_atlas(atlas).settings).coarse.items()}
    return Maps([m.file for m in maps], memory=Memory(coarse), keys=[map_key(load_map(m.file)) for m in maps])
