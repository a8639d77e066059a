"""An atlas in a folder: maps to which maps are added and from which they are taken away.

| file | content |
|---|---|
| atlas.json | maps, which belong together, their transforms, the links that hold them, what was thrown out |
| maps/NAME.tmap | copies of the maps |
| pairs.json | registrations made so far, by the hashes of the maps; it may be deleted |
| map_N.tmap, merged_N.ply | the joined map of component N |
| report.html | everything to look at; of more than four joined maps it names their pages |
| map_N.html | the page of component N, then, or where one of them is large |
| map_N_tile_K.html | a part of a large joined map, with all of its cells (`tiles`) |
| report_stamp.css | which report and pages these are: an open page of before loads itself anew |
| watch.json | which files gave which maps (`sources`) |

Maps that are added later give what building all at once gives: all is put together anew, only registrations are remembered.
What two processes change at once is changed one after the other: each reads the atlas when it is its turn.
"""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from topomerge import __version__
from topomerge.archive import convert_to_plain
from topomerge.edits.apply import load_corrected_map
from topomerge.edits.journal import find_journal, read_journal
from topomerge.errors import InputError
from topomerge.fusion.atlas.folder import (
    ATLAS_FORMAT,
    Entry,
    StoredAtlas,
    change_folder,
    files_of,
    link_or_copy,
    read_atlas,
    read_finished_folder,
    read_folder,
)
from topomerge.fusion.atlas.link_evidence import Link
from topomerge.fusion.atlas.maps import MapFiles, Maps, Memory, hash_map
from topomerge.fusion.atlas.pairs import serialise_contradiction
from topomerge.fusion.atlas.partners import Workers
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.solve import (
    JOURNAL_FILE,
    PAIRS_FILE,
    AtlasSettings,
    Journal,
    Proposed,
    SolvingSchedule,
    serialise_registrations,
    solve,
)
from topomerge.fusion.result import serialise_transform
from topomerge.fusion.transfer import LANDMARK_PARAMETER
from topomerge.io.listing import format_json
from topomerge.io.maps import save_map
from topomerge.io.rooms_ply import save_rooms_ply
from topomerge.landmarks.fuse import describe_listed
from topomerge.types import EDITED, LEVELLED, Array, Sim3, TopometricMap, convert_pose_to_files, is_level

TILE_CELLS = 1_000_000  # cells of a tile, at most, but for a single room
NEAREST_BY = 0.5  # m: the raster in which the nearest room is looked for
Report = Callable[..., str]  # (atlas, joined maps, title, stamp=…, pages=…), of one of them (…, component=…, stamp=…) -> HTML
JOINED_ON_ONE_PAGE = 4  # joined maps; of more each has a page of its own
STAMP_FILE = "report_stamp.css"


def serialise_component(atlas: AtlasResult, stored: StoredAtlas, n: int) -> dict[str, Any]:
    """Serialise a component for atlas.json, without its files."""
    members = atlas.components[n]
    digest = hashlib.sha256(__version__.encode())
    for k in members:
        digest.update(stored.entries[k].key.encode() + atlas.transforms[k].matrix.tobytes())
    return {
        "maps": list(members),
        "names": [stored.entries[k].name for k in members],
        "probability": round(atlas.get_probability(n), 4),
        "made_of": digest.hexdigest()[:16],
    }


def serialise_atlas(atlas: AtlasResult, stored: StoredAtlas, components: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return atlas.json, see docs/outputs.md."""
    into = {k: members[0] for members in atlas.components for k in members}
    moved = sorted(k for k, first in into.items() if k != first or atlas.transforms[k] != Sim3())
    lying = {
        k: convert_pose_to_files(atlas.transforms[k], stored.entries[k].levelling, stored.entries[into[k]].levelling)
        for k in moved
    }
    poses = {str(k): serialise_transform(atlas.transforms[k], atlas.residuals[k], lying[k], into[k]) for k in moved}
    maps = [
        {"name": e.name, "file": e.file, "key": e.key, "source": e.source, "rooms": e.rooms, "storeys": e.storeys}
        | ({} if e.frame == Sim3() else {"frame": e.frame.matrix.tolist()})
        | ({EDITED: e.edits} if e.edits else {})
        | ({} if is_level(e.levelling) else {LEVELLED: e.levelling.tolist()})
        for e in stored.entries
    ]
    listing = {
        "format": ATLAS_FORMAT,
        "status": atlas.status,
        "reason": atlas.format_summary(),
        "settings": dict(stored.settings),
        "maps": maps,
        "components": components,
        "transforms": poses,
        "links": [_serialise_link(link) | {"probability": round(link.probability, 4)} for link in atlas.links],
        "thrown_out": [_serialise_link(link) | {"against": link.against} for link in atlas.rejected],
        "contradictions": [serialise_contradiction(c) for c in atlas.contradictions],
        "registered": {"pairs": atlas.registered[0], "of": atlas.registered[1], "complete": atlas.complete},
        "seconds": round(atlas.seconds, 3),
    }
    plain_listing: dict[str, Any] = convert_to_plain(listing)
    return plain_listing


def _serialise_link(link: Link) -> dict[str, Any]:
    return {"maps": link.maps, "by_itself": round(link.hypothesis.probability, 4)}


def hash_component_page(atlas: AtlasResult, n: int, component: Mapping[str, Any], title: str) -> str:
    """Return a hash of all that the page of a component shows."""
    members = set(atlas.components[n])
    links = [x for x in (*atlas.links, *atlas.rejected) if members & {*x.maps}]
    named = [[atlas.names[k] for k in (*x.maps, *(x.against or ()))] for x in links]
    odds = [[repr(x.hypothesis.probability), repr(x.log_odds)] for x in links]
    missed = [repr(atlas.residuals.get(k)) for k in sorted(members)]
    differing = [serialise_contradiction(c) for c in atlas.contradictions if members & {*c.maps}]
    content = [title, n, component["maps"], component["names"], component["made_of"], missed, named, odds, differing]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def split_into_tiles(map: TopometricMap) -> list[Array]:
    """Return the rooms of each tile, ascending; every room is in one. A map without rooms is one tile."""
    size = np.bincount(find_nearest_rooms(map), minlength=len(map.rooms)) if len(map.rooms) else np.zeros(0, np.int64)
    parts, small = [np.arange(len(map.rooms))], []
    while parts:
        rooms = parts.pop()
        if len(rooms) < 2 or size[rooms].sum() <= TILE_CELLS:
            small.append(rooms)
            continue
        middle = map.rooms["centroid"][rooms, :2]
        order = np.argsort(middle[:, np.argmax(np.ptp(middle, axis=0))], kind="stable")
        below = np.cumsum(size[rooms][order])
        half = int(np.clip(np.searchsorted(below, below[-1] / 2), 1, len(rooms) - 1))
        parts += [np.sort(rooms[order[half:]]), np.sort(rooms[order[:half]])]
    return small


def find_nearest_rooms(map: TopometricMap) -> Array:
    """Return (n,) room of each occupied cell; of those without one that of the nearest cell with one, from above. 0 where none
    has."""
    owner = map.room.astype(np.int64)
    inside = owner >= 0
    if inside.all() or not inside.any():
        return np.maximum(owner, 0)
    step = max(round(NEAREST_BY / map.grid.edge), 1)
    squares, first = np.unique(map.grid.cells[inside, :2] // step, axis=0, return_index=True)
    others, square = np.unique(map.grid.cells[~inside, :2] // step, axis=0, return_inverse=True)
    near = cKDTree(squares).query(others)[1][square.ravel()]
    owner[~inside] = owner[inside][first][near]
    return owner


def select_tile(map: TopometricMap, rooms: Sequence[int] | Array) -> TopometricMap:
    """Return the map with nothing but what belongs to some of its rooms, which keep their numbers."""
    mine = np.zeros(max(len(map.rooms), 1), bool)
    mine[np.asarray(rooms, np.int64)] = True
    mine |= not len(map.rooms)
    cells, floor = mine[find_nearest_rooms(map)], (map.navigable_room >= 0) & mine[np.maximum(map.navigable_room, 0)]
    assert map.navigable_area is not None
    return replace(
        map,
        grid=map.grid.select_cells(cells),
        room=map.room[cells],
        provenance=None if map.provenance is None else map.provenance[cells],
        navigable=map.navigable.select_cells(floor),
        navigable_room=map.navigable_room[floor],
        navigable_area=map.navigable_area[floor],
        edges=map.edges[mine[map.edges["rooms"]].any(axis=1)] if len(map.edges) else map.edges,
        narrows=map.narrows[mine[map.areas["room"][map.narrows["rooms"]]].any(axis=1)] if len(map.narrows) else map.narrows,
        windows=map.windows[mine[map.windows["rooms"][:, 0]]] if len(map.windows) else map.windows,
        landmarks=map.landmarks.select(np.append(mine, False)[map.landmarks.table["room"]]),
        free=None,
    )


@dataclass(frozen=True)
class Change:
    """A change of an atlas: the maps and settings that it shall hold.

    Args:
        stored: its maps and settings.
        new: those that it does not hold yet, or their files, by their names.
        proposed: as of `solve`, beside those of the links that there are.
        files: others that are written with it, name -> text.
        seconds: after which no more pairs are registered: what is left is for the next change.
    """

    stored: StoredAtlas
    new: Mapping[str, TopometricMap | Path] = field(default_factory=dict)
    proposed: Proposed = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    seconds: float = float("inf")


def add(
    folder: str | Path,
    maps: Iterable[tuple[str, TopometricMap]],
    report: Report,
    workers: Workers | None = None,
    **settings: Any,
) -> AtlasResult:
    """Add maps to an atlas; a new one where there is none. Waits for other processes that change it.

    Args:
        folder: of the atlas.
        maps: name, map; where a name is taken already, a number is put behind it. Only one is in memory at once, if they are made
            one after the other.
        report: makes report.html (`topomerge.render_atlas_html`).
        workers: register pairs in place of this process (`workers.processes`, `workers.cluster`).
        settings: ``scale``, ``threshold``, ``embedder`` of `atlas`; they stay those of the atlas.

    Raises:
        InputError: the folder is no atlas, a map is in it already, or what `atlas` says of the maps.
    """
    read_folder(folder)
    with tempfile.TemporaryDirectory(prefix="topomerge-") as spool:
        entries = []
        for k, (name, m) in enumerate(maps):
            entries.append(build_entry(name, m, StoredAtlas(Path(folder))))
            save_map(m, Path(spool) / f"{k}.tmap")

        def with_maps(stored: StoredAtlas) -> Change:
            stored = replace(stored, settings={**stored.settings, **settings})
            new = {}
            for k, entry in enumerate(entries):
                same = stored.find_name(entry.key)
                if same is not None:
                    raise InputError(f"{entry.source}: is in the atlas already, as {same}; leave it out")
                entry = replace(entry, name=_find_free_name(entry.name, stored.entries))
                stored = replace(stored, entries=(*stored.entries, entry))
                new[entry.name] = Path(spool) / f"{k}.tmap"
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

    def without_maps(stored: StoredAtlas) -> Change:
        held = [e.name for e in stored.entries]
        for name in names:
            if name not in held:
                raise InputError(f"{name}: is no map of {folder}; it holds {', '.join(held) or 'none'}")
        return Change(replace(stored, entries=tuple(e for e in stored.entries if e.name not in names)))

    return change(folder, without_maps, report)


def build_entry(name: str, map: TopometricMap, stored: StoredAtlas) -> Entry:
    """Return the entry of a map that an atlas does not hold yet, under its name or, where that is taken, under another one."""
    free_name, source, counts = _find_free_name(name, stored.entries), map.source or name, (len(map.rooms), len(map.storeys))
    return Entry(free_name, hash_map(map), source, *counts, levelling=map.levelling)


def _follow_journal(folder: Path, entry: Entry) -> Entry:
    """Return the entry of a map with the corrections that its journal has by now."""
    version = read_journal(find_journal(folder / entry.file)).version
    if version == entry.edits:
        return entry
    map = load_corrected_map(folder / entry.file)
    return replace(entry, key=hash_map(map), rooms=len(map.rooms), edits=version)


def update(folder: str | Path, report: Report) -> AtlasResult:
    """Put an atlas together again with the corrections of its maps. Waits for other processes that change the atlas.

    Args:
        report: as of `add`.

    Raises:
        InputError: the folder is no atlas, or a journal is damaged.
    """
    read_atlas(folder)
    return change(folder, Change, report)


def _find_free_name(name: str, entries: Iterable[Entry]) -> str:
    taken = {e.name.lower() for e in entries}
    name = "".join(c if c.isalnum() or c in "-_. " else "_" for c in name).strip(". ")[:80] or "map"
    numbered = [name, *(f"{name}-{k}" for k in range(2, len(taken) + 3))]
    return next(n for n in numbered if n.lower() not in taken)


def change(
    folder: str | Path,
    make: Callable[[StoredAtlas], Change],
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
        answered, workers: as of `solve.SolvingSchedule`.

    Raises:
        InputError: what `make` says, or `atlas` of the maps; or the folder can't be written.
    """
    folder = Path(folder)
    gone: list[str] = []
    with change_folder(folder, gone) as place:
        before = read_finished_folder(folder)
        requested = make(before)
        followed = tuple(e if e.name in requested.new else _follow_journal(folder, e) for e in requested.stored.entries)
        stored = replace(requested.stored, entries=followed)
        (place / "maps").mkdir()
        for entry in stored.entries:
            new = requested.new.get(entry.name)
            if isinstance(new, Path):
                link_or_copy(new, place / entry.file)
            elif new is not None:
                save_map(new, place / entry.file)
        files = [place / e.file if e.name in requested.new else folder / e.file for e in stored.entries]
        names, keys = [e.name for e in stored.entries], [e.key for e in stored.entries]
        registrations = Journal(folder, stored.settings)
        memory = Memory() if memory is None else memory
        memory.coarse = registrations.coarse
        choices, proposed = AtlasSettings(**stored.settings), {**before.compute_relative_poses(), **requested.proposed}
        atlas = solve(
            files, choices, registrations, names, keys, proposed, memory, SolvingSchedule(requested.seconds, answered, workers)
        )
        atlas = atlas.transform_components({k: e.frame for k, e in enumerate(stored.entries) if e.frame != Sim3()})
        components = [serialise_component(atlas, stored, n) for n in range(len(atlas.components))]
        joined = _write_joined_maps(atlas, components, before, place)
        warnings = [describe_listed(c[LANDMARK_PARAMETER], c["names"]) for c in components if LANDMARK_PARAMETER in c]
        atlas = replace(atlas, warnings=(*atlas.warnings, *filter(None, warnings)))
        title = folder.resolve().name
        pages = _write_pages(atlas, components, before, place, title, partial(report, atlas, joined, title))
        listing = serialise_atlas(atlas, stored, components)
        pairs = json.dumps(serialise_registrations(registrations, keys, stored.settings))
        stamp = hashlib.sha256(format_json(listing | {"seconds": 0}).encode()).hexdigest()[:16]
        page = report(atlas, joined, title, stamp=stamp, pages=pages)
        css = "".join(f':root {{ --{name}: "{value}"; }}\n' for name, value in _iter_stamps(stamp, components))
        texts = {PAIRS_FILE: pairs, "report.html": page, STAMP_FILE: css, "atlas.json": format_json(listing)}
        for name, text in (texts | dict(requested.files)).items():
            _write(place / name, text)
        gone += [JOURNAL_FILE, *sorted(set(before.list_files()) - set(replace(stored, listing=listing).list_files()))]
    return replace(atlas, maps=Maps([folder / e.file for e in stored.entries]))


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", errors="replace", newline="\n")


def _write_joined_maps(
    atlas: AtlasResult, components: Sequence[dict[str, Any]], before: StoredAtlas, place: Path
) -> Mapping[int, TopometricMap]:
    """Write the joined maps, one after the other; those are copied where the atlas had the same before; read when they are asked
    for."""
    files = {}
    for n, component in enumerate(components):
        if len(component["maps"]) < 2:
            continue
        component |= {"map": f"map_{n}.tmap", "ply": f"merged_{n}.ply"}
        files[n] = place / component["map"]
        old = _copy_component(before, component, "made_of", ("map", "ply"), place)
        if old is None:
            joined = atlas.join_component(n)
            save_map(joined, files[n])
            save_rooms_ply(joined, place / component["ply"])
        listed = joined.parameters if old is None else old
        component |= {LANDMARK_PARAMETER: listed[LANDMARK_PARAMETER]} if LANDMARK_PARAMETER in listed else {}
        count = len(split_into_tiles(joined)) if old is None else len(old.get("tiles", ()))
        if count > 1:
            component["tiles"] = [f"map_{n}_tile_{k}.html" for k in range(count)]
    return MapFiles(files)


def _write_pages(
    atlas: AtlasResult, components: Sequence[dict[str, Any]], before: StoredAtlas, place: Path, title: str, page: Report
) -> dict[int, str]:
    """Write, of more joined maps than one page shows, or larger ones, the pages of each, like the maps."""
    joined = [n for n, component in enumerate(components) if "map" in component]
    if len(joined) <= JOINED_ON_ONE_PAGE and not any("tiles" in components[n] for n in joined):
        return {}
    for n in joined:
        components[n] |= {"page": f"map_{n}.html", "shown": hash_component_page(atlas, n, components[n], title)}
        if _copy_component(before, components[n], "shown", ("page", "tiles"), place) is None:
            stamp = components[n]["shown"]
            _write(place / components[n]["page"], page(component=n, stamp=stamp))
            for k, file in enumerate(components[n].get("tiles", ())):
                _write(place / file, page(component=n, stamp=stamp, tile=k))
    return {n: components[n]["page"] for n in joined}


def _copy_component(
    before: StoredAtlas, component: Mapping[str, Any], digest: str, kinds: Sequence[str], place: Path
) -> Mapping[str, Any] | None:
    """Take files over from the atlas before, where it has a component with the same digest: that component."""
    old: Mapping[str, Any]
    for old in (before.listing or {}).get("components", []):
        files = list(zip(files_of(old, kinds), files_of(component, kinds), strict=False))
        if files and old.get(digest) == component[digest] and all((before.folder / was).is_file() for was, _ in files):
            for was, now in files:
                link_or_copy(before.folder / was, place / now)
            return old
    return None


def _iter_stamps(stamp: str, components: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """Yield by what each page is told: name, stamp."""
    yield "stamp", stamp
    yield from ((f"stamp-{n}", component["shown"]) for n, component in enumerate(components) if "shown" in component)
