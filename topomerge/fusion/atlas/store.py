"""An atlas in a folder: maps to which maps are added and from which they are taken away.

| file | content |
|---|---|
| atlas.json | maps, which belong together, their transforms, the links that hold them, what was thrown out |
| maps/NAME.tmap | copies of the maps |
| pairs.json | registrations made so far, by the hashes of the maps; it may be deleted |
| map_N.tmap, merged_N.ply | the joined map of component N |
| report.html | everything to look at |

Maps that are added later give what building all at once gives: all is put together anew, only registrations are remembered.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from topomerge import __version__
from topomerge.errors import InputError
from topomerge.fusion.atlas.assembly import Link
from topomerge.fusion.atlas.folder import changing, finished, link_or_copy
from topomerge.fusion.atlas.maps import Maps, map_key
from topomerge.fusion.atlas.registration_cache import PAIRS_FILE, read_registrations, registrations_to_json
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.solve import AtlasSettings, solve
from topomerge.fusion.result import transform_to_json
from topomerge.io.listing import json_text, plain
from topomerge.io.maps import load_map, save_map
from topomerge.io.rooms_ply import save_rooms_ply
from topomerge.types import TopometricMap

ATLAS_FORMAT = 1
Report = Callable[[AtlasResult, Mapping[int, TopometricMap], str], str]  # atlas, joined map of each component, title -> HTML


@dataclass(frozen=True)
class Entry:
    """A map of the atlas."""

    name: str
    key: str
    source: str
    rooms: int
    storeys: int

    @property
    def file(self) -> str:
        """Where its copy is, in the atlas."""
        return f"maps/{self.name}.tmap"


@dataclass(frozen=True, eq=False)
class Stored:
    """What atlas.json says."""

    folder: Path
    entries: tuple[Entry, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=lambda: asdict(AtlasSettings()))
    listing: Mapping[str, Any] | None = None

    def files(self) -> list[str]:
        """All that belongs to the atlas but atlas.json."""
        joined = [c[kind] for c in (self.listing or {}).get("components", []) for kind in ("map", "ply") if kind in c]
        return [e.file for e in self.entries] + joined


def read_atlas(folder: str | Path) -> Stored:
    """What an atlas holds; a change that was interrupted is finished first.

    Raises:
        InputError: no such folder, no atlas, or damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; make an atlas with `topomerge atlas add {folder} MAP ...`")
    finished(folder)
    path = folder / "atlas.json"
    if not path.exists():
        raise InputError(f"{folder}: is no atlas (atlas.json is missing); `topomerge atlas add` makes one in a new folder")
    try:
        listing = json.loads(path.read_text(encoding="utf-8"))
        if listing["format"] != ATLAS_FORMAT:
            written = f"is of format {listing['format']!r}, this topomerge reads format {ATLAS_FORMAT}"
            raise InputError(f"{path}: {written}; update topomerge")
        entries = tuple(Entry(m["name"], m["key"], m["source"], int(m["rooms"]), int(m["storeys"])) for m in listing["maps"])
        settings = {name: listing["settings"].get(name, usual) for name, usual in asdict(AtlasSettings()).items()}
        if any(Path(e.file).parent != Path("maps") or not isinstance(e.key, str) for e in entries):
            raise ValueError("a map lies elsewhere")
        stored = Stored(folder, entries, settings, listing)
        if any(Path(name).is_absolute() or ".." in Path(name).parts for name in stored.files()):
            raise ValueError("a file lies elsewhere")
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise InputError(f"{path}: damaged ({reason}); make the atlas again from the maps in {folder / 'maps'}") from error
    return stored


def add(folder: str | Path, maps: Sequence[tuple[str, TopometricMap]], report: Report, **settings: Any) -> AtlasResult:
    """Add maps to an atlas; a new one where there is none.

    Args:
        folder: of the atlas.
        maps: name, map; where a name is taken already, a number is put behind it.
        report: makes report.html (`topomerge.atlas_html`).
        settings: ``scale``, ``threshold``, ``embedder`` of `atlas`; they stay those of the atlas.

    Raises:
        InputError: the folder is no atlas, a map is in it already, or what `atlas` says of the maps.
    """
    stored = check_folder(folder)
    stored = replace(stored, settings={**stored.settings, **settings})
    entries, new = list(stored.entries), {}
    for name, m in maps:
        key = map_key(m)
        same = next((e.name for e in entries if e.key == key), None)
        if same is not None:
            raise InputError(f"{m.source or name}: is in the atlas already, as {same}; leave it out")
        entry = Entry(_free_name(name, entries), key, m.source or name, len(m.rooms), len(m.storeys))
        entries.append(entry)
        new[entry.name] = m
    return _written(replace(stored, entries=tuple(entries)), new, stored, report)


def remove(folder: str | Path, names: Sequence[str], report: Report) -> AtlasResult:
    """Take maps back out, and what they brought with them.

    Args:
        report: as of `add`.

    Raises:
        InputError: the folder is no atlas, or it has no such map.
    """
    stored = read_atlas(folder)
    held = [e.name for e in stored.entries]
    for name in names:
        if name not in held:
            raise InputError(f"{name}: is no map of {folder}; it holds {', '.join(held) or 'none'}")
    remaining = tuple(e for e in stored.entries if e.name not in names)
    return _written(replace(stored, entries=remaining), {}, stored, report)


def check_folder(folder: str | Path) -> Stored:
    """What an atlas holds, of a new one nothing.

    Raises:
        InputError: a file, or a folder with other things in it.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; give the name of a folder")
    if folder.is_dir():
        finished(folder)
    there = folder.is_dir() and any(not p.name.startswith(".") for p in folder.iterdir())
    return read_atlas(folder) if there else Stored(folder)


def _free_name(name: str, entries: Iterable[Entry]) -> str:
    taken = {e.name.lower() for e in entries}
    name = "".join(c if c.isalnum() or c in "-_. " else "_" for c in name).strip(". ")[:80] or "map"
    numbered = [name, *(f"{name}-{k}" for k in range(2, len(taken) + 3))]
    return next(n for n in numbered if n.lower() not in taken)


def _written(stored: Stored, new: Mapping[str, TopometricMap], before: Stored, report: Report) -> AtlasResult:
    """Put everything together and write it, all or nothing."""
    folder, gone = stored.folder, list[str]()
    registrations = read_registrations(folder, stored.settings)
    with changing(folder, gone) as place:
        (place / "maps").mkdir()
        for entry in stored.entries:
            if entry.name in new:
                save_map(new[entry.name], place / entry.file)
        files = [place / e.file if e.name in new else folder / e.file for e in stored.entries]
        names, keys = [e.name for e in stored.entries], [e.key for e in stored.entries]
        atlas = solve(files, AtlasSettings(**stored.settings), registrations, names, keys)
        joined, components = {}, []
        for n, members in enumerate(atlas.components):
            component = _component(atlas, stored, n)
            if len(members) > 1:
                component |= {"map": f"map_{n}.tmap", "ply": f"merged_{n}.ply"}
                joined[n] = _joined(atlas, n, component, before, place)
            components.append(component)
        listing = _listing(atlas, stored, components)
        _write(place / "report.html", report(atlas, joined, folder.resolve().name))
        _write(place / PAIRS_FILE, json.dumps(registrations_to_json(registrations, keys, stored.settings)))
        _write(place / "atlas.json", json_text(listing))
        gone += sorted(set(before.files()) - set(replace(stored, listing=listing).files()))
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
    into = {k: members[0] for members in atlas.components for k in members[1:]}
    poses = {str(k): transform_to_json(atlas.transforms[k], atlas.residuals[k], into[k]) for k in sorted(into)}
    maps = [
        {"name": e.name, "file": e.file, "key": e.key, "source": e.source, "rooms": e.rooms, "storeys": e.storeys}
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
        "registered": {"pairs": atlas.registered[0], "of": atlas.registered[1]},
        "seconds": round(atlas.seconds, 3),
    }
    plain_listing: dict[str, Any] = plain(listing)
    return plain_listing


def _link(link: Link) -> dict[str, Any]:
    return {"maps": link.maps, "by_itself": round(link.hypothesis.probability, 4)}
