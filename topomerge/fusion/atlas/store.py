"""An atlas in a folder: maps to which maps are added and from which they are taken away.

| file | content |
|---|---|
| atlas.json | maps, which belong together, their transforms, the links that hold them, what was thrown out |
| maps/NAME.tmap | copies of the maps |
| pairs.json | registrations made so far, by the hashes of the maps; it may be deleted |
| map_N.tmap, merged_N.ply | the joined map of component N |
| report.html | everything to look at |
| report_stamp.css | which report that is: an open page that has another one loads itself anew |
| watch.json | which files gave which maps (`sources`) |

Maps that are added later give what building all at once gives: all is put together anew, only registrations are remembered.
What two processes change at once is changed one after the other: each reads the atlas when it is its turn.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from topomerge import __version__
from topomerge.errors import InputError
from topomerge.fusion.atlas.assembly import Link
from topomerge.fusion.atlas.folder import changing, link_or_copy
from topomerge.fusion.atlas.maps import Maps
from topomerge.fusion.atlas.memory import Memory, map_key
from topomerge.fusion.atlas.registration_cache import PAIRS_FILE, Journal, registrations_to_json
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.solve import AtlasSettings, Pace, Proposed, solve
from topomerge.fusion.atlas.stored import ATLAS_FORMAT, Entry, Stored, check_folder, held_by, read_atlas
from topomerge.fusion.atlas.workers import Workers
from topomerge.fusion.result import transform_to_json
from topomerge.io.listing import json_text, plain
from topomerge.io.maps import load_map, save_map
from topomerge.io.rooms_ply import save_rooms_ply
from topomerge.types import Sim3, TopometricMap

Report = Callable[..., str]  # (atlas, joined map of each component, title, stamp=…) -> HTML
STAMP_FILE = "report_stamp.css"


@dataclass(frozen=True)
class Change:
    """What an atlas shall hold.

    Args:
        stored: its maps and settings.
        new: those that it does not hold yet, by their names.
        proposed: as of `solve`, beside those of the links that there are.
        files: others that are written with it, name -> text.
        seconds: after which no more pairs are registered: what is left is for the next change.
    """

    stored: Stored
    new: Mapping[str, TopometricMap] = field(default_factory=dict)
    proposed: Proposed = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    seconds: float = float("inf")


def add(
    folder: str | Path,
    maps: Sequence[tuple[str, TopometricMap]],
    report: Report,
    workers: Workers | None = None,
    **settings: Any,
) -> AtlasResult:
    """Add maps to an atlas; a new one where there is none. Waits for other processes that change it.

    Args:
        folder: of the atlas.
        maps: name, map; where a name is taken already, a number is put behind it.
        report: makes report.html (`topomerge.atlas_html`).
        workers: register pairs in place of this process (`workers.processes`, `workers.cluster`).
        settings: ``scale``, ``threshold``, ``embedder`` of `atlas`; they stay those of the atlas.

    Raises:
        InputError: the folder is no atlas, a map is in it already, or what `atlas` says of the maps.
    """
    check_folder(folder)

    def with_maps(stored: Stored) -> Change:
        stored = replace(stored, settings={**stored.settings, **settings})
        new = {}
        for name, m in maps:
            entry = entry_of(name, m, stored)
            same = stored.named(entry.key)
            if same is not None:
                raise InputError(f"{m.source or name}: is in the atlas already, as {same}; leave it out")
            stored = replace(stored, entries=(*stored.entries, entry))
            new[entry.name] = m
        return Change(stored, new)

    return change(folder, with_maps, report, workers=workers)


def remove(folder: str | Path, names: Sequence[str], report: Report) -> AtlasResult:
    """Take maps back out, and what they brought with them. Waits for other processes that change the atlas.

    Args:
        report: as of `add`.

    Raises:
        InputError: the folder is no atlas, or it has no such map.
    """
    read_atlas(folder)

    def without_maps(stored: Stored) -> Change:
        held = [e.name for e in stored.entries]
        for name in names:
            if name not in held:
                raise InputError(f"{name}: is no map of {folder}; it holds {', '.join(held) or 'none'}")
        return Change(replace(stored, entries=tuple(e for e in stored.entries if e.name not in names)))

    return change(folder, without_maps, report)


def entry_of(name: str, map: TopometricMap, stored: Stored) -> Entry:
    """The entry of a map that an atlas does not hold yet, under its name or, where that is taken, under another one."""
    return Entry(_free_name(name, stored.entries), map_key(map), map.source or name, len(map.rooms), len(map.storeys))


def _free_name(name: str, entries: Iterable[Entry]) -> str:
    taken = {e.name.lower() for e in entries}
    name = "".join(c if c.isalnum() or c in "-_. " else "_" for c in name).strip(". ")[:80] or "map"
    numbered = [name, *(f"{name}-{k}" for k in range(2, len(taken) + 3))]
    return next(n for n in numbered if n.lower() not in taken)


def change(
    folder: str | Path,
    make: Callable[[Stored], Change],
    report: Report,
    memory: Memory | None = None,
    answered: Callable[[AtlasResult], None] | None = None,
    workers: Workers | None = None,
) -> AtlasResult:
    """Put everything together and write it, all or nothing; what others changed before is in it.

    Args:
        make: called with what the atlas holds when no other process can change it any more.
        report: as of `add`.
        memory: of what was made of its maps before.
        answered, workers: as of `solve.Pace`.

    Raises:
        InputError: what `make` says, or `atlas` of the maps; or the folder can't be written.
    """
    folder = Path(folder)
    gone: list[str] = []
    with changing(folder, gone) as place:
        before = held_by(folder)
        wanted = make(before)
        stored = wanted.stored
        (place / "maps").mkdir()
        for entry in stored.entries:
            if entry.name in wanted.new:
                save_map(wanted.new[entry.name], place / entry.file)
        files = [place / e.file if e.name in wanted.new else folder / e.file for e in stored.entries]
        names, keys = [e.name for e in stored.entries], [e.key for e in stored.entries]
        registrations = Journal(folder, stored.settings)
        choices, proposed = AtlasSettings(**stored.settings), {**before.lying(), **wanted.proposed}
        atlas = solve(files, choices, registrations, names, keys, proposed, memory, Pace(wanted.seconds, answered, workers))
        atlas = atlas.in_frames({k: e.frame for k, e in enumerate(stored.entries) if e.frame != Sim3()})
        joined, components = {}, []
        for n, members in enumerate(atlas.components):
            component = _component(atlas, stored, n)
            if len(members) > 1:
                component |= {"map": f"map_{n}.tmap", "ply": f"merged_{n}.ply"}
                joined[n] = _joined(atlas, n, component, before, place)
            components.append(component)
        listing = _listing(atlas, stored, components)
        pairs = json.dumps(registrations_to_json(registrations, keys, stored.settings))
        stamp = hashlib.sha256(json_text(listing | {"seconds": 0}).encode()).hexdigest()[:16]
        page = report(atlas, joined, folder.resolve().name, stamp=stamp)
        css = f':root {{ --stamp: "{stamp}"; }}\n'
        texts = {PAIRS_FILE: pairs, "report.html": page, STAMP_FILE: css, "atlas.json": json_text(listing)}
        for name, text in (texts | dict(wanted.files)).items():
            _write(place / name, text)
        gone += sorted(set(before.files()) - set(replace(stored, listing=listing).files()))
    registrations.end()
    return replace(atlas, maps=Maps([folder / e.file for e in stored.entries]))


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", errors="replace", newline="\n")


def _joined(atlas: AtlasResult, n: int, component: dict[str, Any], before: Stored, place: Path) -> TopometricMap:
    """The joined map of a component, written; copied where the atlas had the same before."""
    for old in (before.listing or {}).get("components", []):
        there = all((before.folder / old.get(kind, "?")).is_file() for kind in ("map", "ply"))
        if there and old.get("made_of") == component["made_of"]:
            for kind in ("map", "ply"):
                link_or_copy(before.folder / old[kind], place / component[kind])
            return load_map(place / component["map"])
    joined = atlas.joined(n)
    save_map(joined, place / component["map"])
    save_rooms_ply(joined, place / component["ply"])
    return joined


def _component(atlas: AtlasResult, stored: Stored, n: int) -> dict[str, Any]:
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


def _listing(atlas: AtlasResult, stored: Stored, components: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """atlas.json, see docs/outputs.md."""
    into = {k: members[0] for members in atlas.components for k in members}
    moved = sorted(k for k, first in into.items() if k != first or atlas.transforms[k] != Sim3())
    poses = {str(k): transform_to_json(atlas.transforms[k], atlas.residuals[k], into[k]) for k in moved}
    maps = [
        {"name": e.name, "file": e.file, "key": e.key, "source": e.source, "rooms": e.rooms, "storeys": e.storeys}
        | ({} if e.frame == Sim3() else {"frame": e.frame.matrix.tolist()})
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
        "registered": {"pairs": atlas.registered[0], "of": atlas.registered[1], "complete": atlas.complete},
        "seconds": round(atlas.seconds, 3),
    }
    plain_listing: dict[str, Any] = plain(listing)
    return plain_listing


def _link(link: Link) -> dict[str, Any]:
    return {"maps": link.maps, "by_itself": round(link.hypothesis.probability, 4)}
