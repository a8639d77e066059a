"""atlas.json, as it is written; `stored` reads it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

from topomerge import __version__
from topomerge.fusion.atlas.contradictions import contradiction_to_json
from topomerge.fusion.atlas.link_evidence import Link
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.stored import ATLAS_FORMAT, Stored
from topomerge.fusion.result import transform_to_json
from topomerge.io.listing import plain
from topomerge.types import LEVELLED, Sim3, between_files, is_level


def component_to_json(atlas: AtlasResult, stored: Stored, n: int) -> dict[str, Any]:
    """What atlas.json says of a component, but for its files."""
    members = atlas.components[n]
    digest = hashlib.sha256(__version__.encode())
    for k in members:
        digest.update(stored.entries[k].key.encode() + atlas.transforms[k].matrix.tobytes())
    return {
        "maps": list(members),
        "names": [stored.entries[k].name for k in members],
        "probability": round(atlas.probability(n), 4),
        "made_of": digest.hexdigest()[:16],
    }


def atlas_to_json(atlas: AtlasResult, stored: Stored, components: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """atlas.json, see docs/outputs.md."""
    into = {k: members[0] for members in atlas.components for k in members}
    moved = sorted(k for k, first in into.items() if k != first or atlas.transforms[k] != Sim3())
    lying = {k: between_files(atlas.transforms[k], stored.entries[k].levelling, stored.entries[into[k]].levelling) for k in moved}
    poses = {str(k): transform_to_json(atlas.transforms[k], atlas.residuals[k], lying[k], into[k]) for k in moved}
    maps = [
        {"name": e.name, "file": e.file, "key": e.key, "source": e.source, "rooms": e.rooms, "storeys": e.storeys}
        | ({} if e.frame == Sim3() else {"frame": e.frame.matrix.tolist()})
        | ({} if is_level(e.levelling) else {LEVELLED: e.levelling.tolist()})
        for e in stored.entries
    ]
    listing = {
        "format": ATLAS_FORMAT,
        "status": atlas.status,
        "reason": atlas.words(),
        "settings": dict(stored.settings),
        "maps": maps,
        "components": components,
        "transforms": poses,
        "links": [_link(link) | {"probability": round(link.probability, 4)} for link in atlas.links],
        "thrown_out": [_link(link) | {"against": link.against} for link in atlas.rejected],
        "contradictions": [contradiction_to_json(c) for c in atlas.contradictions],
        "registered": {"pairs": atlas.registered[0], "of": atlas.registered[1], "complete": atlas.complete},
        "seconds": round(atlas.seconds, 3),
    }
    plain_listing: dict[str, Any] = plain(listing)
    return plain_listing


def _link(link: Link) -> dict[str, Any]:
    return {"maps": link.maps, "by_itself": round(link.hypothesis.probability, 4)}


def shown_of(atlas: AtlasResult, n: int, component: Mapping[str, Any], title: str) -> str:
    """A hash of all that the page of a component shows."""
    members = set(atlas.components[n])
    links = [x for x in (*atlas.links, *atlas.rejected) if members & {*x.maps}]
    named = [[atlas.names[k] for k in (*x.maps, *(x.against or ()))] for x in links]
    odds = [[repr(x.hypothesis.probability), repr(x.log_odds)] for x in links]
    missed = [repr(atlas.residuals.get(k)) for k in sorted(members)]
    differing = [contradiction_to_json(c) for c in atlas.contradictions if members & {*c.maps}]
    content = [title, n, component["maps"], component["names"], component["made_of"], missed, named, odds, differing]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]
