"""A folder that is watched: what lies or appears in it becomes maps of an atlas.

Each look at the folder compares sizes and times with those of the last one; what has not changed for a while is taken as written.
Maps and what is noted of their files are written in one change of the atlas: whenever a watch is stopped, the next one goes on.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.fusion.atlas.folder import Entry, StoredAtlas, change_folder, read_finished_folder, read_folder
from topomerge.fusion.atlas.maps import Memory
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.fusion.atlas.solve import Proposed
from topomerge.fusion.atlas.store import Change, Report, build_entry, change
from topomerge.fusion.fuse import match_common_rooms
from topomerge.fusion.inputs import check_cells, check_units, resolve_link_threshold
from topomerge.io.landmarks import find_landmark_file, is_landmark_file, list_companions
from topomerge.io.listing import format_json
from topomerge.io.maps import load_map
from topomerge.io.points import PICTURES, list_suffixes
from topomerge.progress import Stopwatch
from topomerge.registration.pipeline import register
from topomerge.types import Sim3, TopometricMap

SOURCES_FILE, SOURCES_FORMAT = "watch.json", 1
TRUTH = '{"format":1,"building":'  # that truth.json of `simulate` begins with, but for blanks
HASHED_AT_ONCE = 1 << 20  # bytes
LONGER = 0.8  # of a map's rooms, that a longer version of it has at least
MAPS_AT_ONCE, SECONDS_AT_ONCE = 8, 10.0  # that are read before they are written: a stop costs no more
SECONDS_TO_ANSWER = 5.0  # of registering, before it is said where new maps lie; the rest follows when nothing new is there
SECONDS_BETWEEN = 60.0  # … before that is written, and new files are looked for
NAMED_AT_MOST = 6  # maps, in a line


@dataclass(frozen=True)
class Source:
    """A file, or a folder of scans, that was read.

    Args:
        stamp: hash of the sizes and times of its files, and of the options that they were read with.
        digest: hash of their contents, and of the options that they were read with.
        map: name of the map that it gave; empty where it gave none.
        error: why it gave none.
    """

    stamp: str
    digest: str
    map: str = ""
    error: str = ""


def read_sources(folder: Path) -> dict[str, Source]:
    """Map each path to what it gave; nothing where the file is missing, damaged or of another format."""
    try:
        listing = json.loads((folder / SOURCES_FILE).read_text(encoding="utf-8"))
        if listing["format"] != SOURCES_FORMAT:
            return {}
        return {str(path): _parse_source(listed) for path, listed in listing["files"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}


def _parse_source(listed: Mapping[str, Any]) -> Source:
    parts = [listed[name] for name in ("stamp", "digest", "map", "error")]
    if not all(isinstance(word, str) for word in parts):
        raise ValueError("no source")
    return Source(*parts)


def serialise_sources(sources: Mapping[str, Source]) -> str:
    """Serialise sources; `read_sources` reads them."""
    return format_json({"format": SOURCES_FORMAT, "files": {path: asdict(sources[path]) for path in sorted(sources)}})


def list_simulation_files(folder: Path) -> tuple[str, ...]:
    """Return the files that `simulate` wrote beside its clouds, if its truth.json is in the folder."""
    try:
        with (folder / "truth.json").open("rb") as file:
            start = "".join(file.read(200).decode(errors="replace").split())
    except OSError:
        return ()
    return ("truth.json", "plan.png") if start.startswith(TRUTH) else ()


def compute_stamp(path: Path, options: str) -> str:
    """Compute a hash of the names, sizes and times of change of a file, or of all files of a folder, and of the options that it
    is read with; empty where it is gone."""
    try:
        of = [(_name_file(p, path), p.stat().st_size, p.stat().st_mtime_ns) for p in files_of(path)]
    except OSError:
        return ""
    return hashlib.sha256(repr((of, options)).encode()).hexdigest()[:16] if of else ""


def compute_digest(path: Path, options: str) -> str:
    """Return hash of the content of a file, or of all files of a folder, and of the options that it is read with.

    Raises:
        OSError: it can't be read.
    """
    digest = hashlib.sha256(f"{options}\0{path.suffix.lower()}\0".encode())
    for file in files_of(path):
        digest.update(f"{_name_file(file, path)}\0{file.stat().st_size}\0".encode())
        with file.open("rb") as stream:
            while block := stream.read(HASHED_AT_ONCE):
                digest.update(block)
    return digest.hexdigest()[:32]


def _name_file(file: Path, path: Path) -> str:
    return str(file.relative_to(path)) if file.is_relative_to(path) else file.name


def files_of(path: Path) -> list[Path]:
    """Return the file itself and the tables that are read with it, or all files in a folder, in their order; without hidden
    ones."""
    if not path.is_dir():
        companion = find_landmark_file(path)
        own = [companion] if companion is not None else []
        return [path, *(own if path.suffix.lower() == ".tmap" else list_companions(path, list_suffixes()))]
    inside = (p for p in path.rglob("*") if not any(part.startswith(".") for part in p.relative_to(path).parts))
    return sorted(p for p in inside if p.is_file())


@dataclass(frozen=True)
class LongerVersion:
    """A longer version of a map.

    Args:
        name: of the map in the atlas.
        pose: of the new map in the frame of the one before.
        rooms: of the one before that the new one has, too.
        of: rooms of the one before.
    """

    name: str
    pose: Sim3
    rooms: int
    of: int


def find_longer_version(name: str, old: TopometricMap, new: TopometricMap, stored: StoredAtlas) -> LongerVersion | None:
    """Return where a new map lies in the one before, if it is a longer version of it: if their registration is believed as a link
    of the atlas would be, and the new map has most rooms of the one before.

    Args:
        name: of the old map in the atlas.
    """
    registration = register(old, new, scale=stored.settings["scale"], same=stored.settings["same"])
    if registration.transform is None or registration.probability < resolve_link_threshold(stored.settings["threshold"]):
        return None
    pairs, _ = match_common_rooms(old, new, registration.transform)
    rooms = len(np.unique(pairs[:, 0]))
    if rooms < LONGER * len(old.rooms):
        return None
    return LongerVersion(name, registration.transform, rooms, len(old.rooms))


def replace_map(stored: StoredAtlas, longer: LongerVersion, new: Entry) -> tuple[StoredAtlas, Proposed]:
    """Return an atlas in which the new map stands where the one before stood, and where it may lie in those that were linked with
    it.

    Args:
        new: entry of the new map, under any name.
    """
    old = next(e for e in stored.entries if e.name == longer.name)
    entry = replace(new, name=old.name, frame=old.frame @ longer.pose)
    proposed = {}
    for (a, b), pose in stored.compute_relative_poses().items():
        if a == old.key:
            proposed[new.key, b] = longer.pose.inverse() @ pose
        elif b == old.key:
            proposed[a, new.key] = pose @ longer.pose
    return replace(stored, entries=tuple(entry if e is old else e for e in stored.entries)), proposed


@dataclass(frozen=True)
class Reader:
    """How the files of a folder are read.

    Args:
        read: gives the map of a file or a folder of scans.
        options: all that it depends on beside the file; with others all files are read again.
        failure: one line of an error, or None for one that ends the watch.
    """

    read: Callable[[Path], TopometricMap]
    options: str
    failure: Callable[[Exception, Path], str | None]


@dataclass(frozen=True)
class _ReadFile:
    """A file that was looked at; a map only where it is a new one."""

    path: Path
    source: Source
    map: TopometricMap | None = None


@dataclass(eq=False)
class FolderWatcher:
    """A folder and the atlas of its maps.

    Args:
        folder: that is watched; what lies right in it is one map each.
        atlas: its folder, which may lie in the other one.
        reader: of the files.
        report: as of `store.add`.
        tell: takes a line, and whether it is a warning.
        settle: s that a file must not have changed, before it is read.
        replacing: may a file that was changed give a longer version of its map, which then takes that one's place?
        settings: of the atlas, those that are not the usual ones.
        warm: look at all maps of the atlas at first, so that the answer to a new one comes at once?
        counts: "added", "replaced" and "unreadable" so far.
    """

    folder: Path
    atlas: Path
    reader: Reader
    report: Report
    tell: Callable[[str, bool], None]
    settle: float = 2.0
    replacing: bool = True
    settings: Mapping[str, Any] = field(default_factory=dict)
    warm: bool = False
    counts: Counter[str] = field(default_factory=Counter)
    memory: Memory = field(default_factory=Memory)

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            raise InputError(f"{self.folder}: no such folder; name the folder in which scans or maps appear")
        if self.folder.resolve() == self.atlas.resolve():
            raise InputError(f"{self.folder}: is watched and can't be the atlas, too; give another folder for it")
        held = read_folder(self.atlas)
        self._complete = held.complete and not (self.warm and held.entries)
        self._since: dict[str, tuple[str, float]] = {}
        self._broken: set[Path] = set()  # links that were told of

    def update(self) -> bool:
        """Put what is new or changed, and written, into the atlas; is there anything that is just being written?

        Raises:
            InputError: the folder is gone, or the atlas can't be written.
        """
        read_folder(self.atlas)
        sources, now = read_sources(self.atlas), time.monotonic()
        stamps = {str(p): self._compute_stamp(p) for p in self._list_inputs()}
        stamps = {p: stamp for p, stamp in stamps.items() if stamp and stamp != sources.get(p, Source("", "")).stamp}
        before, self._since = self._since, {}
        for path, stamp in stamps.items():
            seen, since = before.get(path, ("", now))
            self._since[path] = (stamp, since if seen == stamp else now)
        settled = [p for p, (_, since) in self._since.items() if now - since >= self.settle]
        for batch in self._iter_batches(sorted(settled)):
            self._write(batch)
        if not settled and not self._complete:
            self._write([])
        return len(settled) < len(stamps) or not self._complete

    def _compute_stamp(self, path: Path) -> str:
        return compute_stamp(path, self.reader.options)

    def _list_inputs(self) -> list[Path]:
        """List the files that may be maps."""
        try:
            entries = sorted(p for p in self.folder.resolve().iterdir() if not p.name.startswith("."))
        except OSError as error:
            raise InputError(f"{self.folder}: can't be read ({error.strerror or error}); is it there?") from error
        simulated = list_simulation_files(self.folder)
        described = {p.stem for p in entries if p.suffix.lower() in (".yaml", ".yml")}  # their pictures are no maps of their own
        kinds = {*list_suffixes(), ".tmap"}
        entries = [p for p in entries if p.name not in simulated and not is_landmark_file(p)]
        own = [p for p in entries if not (p.suffix.lower() in PICTURES and p.stem in described)]
        for p in sorted({p for p in own if p.is_symlink() and not p.exists()} - self._broken):
            self.tell(f"{p}: is a link to what is not there; it is skipped until it is", True)
            self._broken.add(p)
        own = [p for p in own if (p.is_dir() and p != self.atlas.resolve()) or (p.is_file() and p.suffix.lower() in kinds)]
        beside = {file for p in own if p.is_file() for file in files_of(p)[1:]}  # a trajectory is no cloud of its own
        return [p for p in own if p not in beside]

    def _iter_batches(self, paths: list[str]) -> Iterator[list[_ReadFile]]:
        """Read files, as many as are written at once."""
        batch, clock = list[_ReadFile](), Stopwatch()
        for path in paths:
            examined = self._read_file(Path(path))
            if examined is not None:
                batch.append(examined)
            maps = sum(one.map is not None for one in batch)
            if maps >= MAPS_AT_ONCE or (batch and clock.elapsed > SECONDS_AT_ONCE):
                yield batch
                batch, clock = [], Stopwatch()
        if batch:
            yield batch

    def _read_file(self, path: Path) -> _ReadFile | None:
        """Read a file as a map; None where it changes meanwhile."""
        stamp, sources = self._compute_stamp(path), read_sources(self.atlas)
        try:
            digest = compute_digest(path, self.reader.options)
            same = next((s for s in sources.values() if s.digest == digest and s.map), None)
            if same is not None:
                return _ReadFile(path, replace(same, stamp=stamp))
            map = self.reader.read(path)
            check_cells(len(map.grid), str(path))
        except Exception as error:
            line = self.reader.failure(error, path)
            if line is None:
                raise
            return _ReadFile(path, Source(stamp, "", error=line)) if stamp == self._compute_stamp(path) else None
        return _ReadFile(path, Source(stamp, digest), map) if stamp == self._compute_stamp(path) else None

    def _write(self, batch: list[_ReadFile]) -> None:
        """Put what was read into the atlas, or go on with registering if nothing was, and say what came of it."""
        plan = _Plan(self, batch)
        if batch and all(reading.map is None for reading in batch) and (self.atlas / "atlas.json").exists():
            with change_folder(self.atlas, []) as place:  # notes only
                for name, text in plan(read_finished_folder(self.atlas)).files.items():
                    (place / name).write_text(text, encoding="utf-8")
        else:
            self._complete = change(self.atlas, plan, self.report, self.memory, plan.report).complete
        plan.report(None)
        self.counts.update(plan.counts)


class _Plan:
    """The changes of an atlas by a batch, planned while nobody else can change it."""

    def __init__(self, watch: FolderWatcher, batch: list[_ReadFile]) -> None:
        self.watch, self.batch = watch, batch
        self.lines: list[tuple[str, bool]] = []
        self.counts: Counter[str] = Counter()
        self.names: dict[str, str] = {}  # of the new maps -> what they are
        self.before: dict[str, int] = {}  # name -> component
        self.links: list[set[str]] = []  # of two maps each, that were believed

    def __call__(self, stored: StoredAtlas) -> Change:
        self.before = {name: n for name, (n, _) in stored.get_poses().items()}
        self.links = [{stored.entries[k].name for k in pair} for pair in stored.list_linked_pairs()]
        sources = read_sources(stored.folder)
        requested = Change(replace(stored, settings={**stored.settings, **self.watch.settings}))
        for reading in self.batch:
            source = reading.source
            if source.error:
                self.lines.append((source.error, True))
                self.counts["unreadable"] += 1
            elif reading.map is not None:
                requested, source = self._add_map(requested, reading, reading.map, sources.get(str(reading.path)))
            sources[str(reading.path)] = source
        seconds = SECONDS_TO_ANSWER if self.batch else SECONDS_BETWEEN
        return replace(requested, files={SOURCES_FILE: serialise_sources(sources)}, seconds=seconds)

    def report(self, result: AtlasResult | None) -> None:
        """Say what was found out, once: as soon as it is known where the maps lie, if it will be."""
        lines = self.lines + [(line, False) for line in (iter_outcome(result, self) if result is not None else ())]
        self.lines = []
        for line, is_warning in lines:
            self.watch.tell(line, is_warning)

    def _add_map(self, requested: Change, reading: _ReadFile, map: TopometricMap, before: Source | None) -> tuple[Change, Source]:
        """Return the change with one more map."""
        stored, name = requested.stored, reading.path.name
        entry = build_entry(reading.path.stem, map, stored)
        same = stored.find_name(entry.key)
        if same is not None:
            self.lines.append((f"{name}: is in the atlas already, as {same}", False))
            return requested, replace(reading.source, map=same)
        old = next(
            (e for e in stored.entries if before is not None and e.name == before.map and e.name not in requested.new), None
        )
        first = next(iter(stored.entries), None)
        if first is not None and stored.settings["scale"] == "fixed":
            try:
                first_map = requested.new.get(first.name) or stored.folder / first.file
                check_units(self.watch.memory.summarise(first_map).extent, map)
            except InputError as error:
                self.lines.append((f"{name}: {error}", True))
                self.counts["unreadable"] += 1
                return requested, replace(reading.source, error=f"{name}: {error}")
        longer = None
        if old is not None and self.watch.replacing:
            longer = find_longer_version(old.name, load_map(stored.folder / old.file), map, stored)
        if longer is not None:
            stored, proposed = replace_map(stored, longer, entry)
            entry, requested = replace(entry, name=longer.name), replace(requested, proposed={**requested.proposed, **proposed})
        else:
            stored = replace(stored, entries=(*stored.entries, entry))
        self.counts["replaced" if longer else "added"] += 1
        self.names[entry.name] = describe_file(name, entry.name, map, longer, old.name if old else "")
        return replace(requested, stored=stored, new={**requested.new, entry.name: map}), replace(reading.source, map=entry.name)


def describe_file(file: str, name: str, map: TopometricMap, longer: LongerVersion | None, old: str) -> str:
    """Describe in words the map that was read from a file.

    Args:
        old: name of the map that the file gave before; empty: none.
    """
    rooms = f"{len(map.rooms)} room{'' if len(map.rooms) == 1 else 's'}"
    if longer is not None:
        return f"{file} -> {name}: {rooms}, takes the place of the map before: has {longer.rooms} of its {longer.of} rooms"
    if old:
        return f"{file} -> {name}: {rooms}, no longer version of {old}, which stays"
    return f"{file} -> {name}: {rooms}"


def iter_outcome(result: AtlasResult, plan: _Plan) -> Iterator[str]:
    """Yield sentences on where the new maps lie, and which others were joined and taken apart."""
    names = [str(name) for name in result.names]
    for name, head in plan.names.items():
        n = result.find_component(names.index(name))
        others = [names[k] for k in result.components[n] if names[k] != name]
        apart = "stands apart" if result.complete else "stands apart so far, there is more to be tried"
        yield f"{head}; lies with {_format_names(others)} ({result.get_probability(n):.2f})" if others else f"{head}; {apart}"
    for link in result.rejected:
        pair = [names[k] for k in link.maps]
        if set(pair) in plan.links:
            against = _format_names([names[k] for k in link.against]) if link.against else "other maps"
            yield f"no longer believed: {_format_names(sorted(pair))}: {against} contradict it"
    yield from iter_changes({names[k]: n for n, members in enumerate(result.components) for k in members}, plan.before)


def iter_changes(after: Mapping[str, int], before: Mapping[str, int]) -> Iterator[str]:
    """Yield sentences on which of the earlier maps were taken apart, and which joined.

    Args:
        after, before: name -> component.
    """
    both = [name for name in after if name in before]
    for one, two, event, between in ((before, after, "taken apart", " | "), (after, before, "joined now", " + ")):
        for group in _iter_groups(both, one):
            parts = list(_iter_groups(group, two))
            if len(parts) > 1:
                yield f"{event}: {between.join(map(_format_names, parts))}"


def _iter_groups(names: list[str], component: Mapping[str, int]) -> Iterator[list[str]]:
    """Yield names by their component."""
    for n in dict.fromkeys(component[name] for name in names):
        yield [name for name in names if component[name] == n]


def _format_names(names: list[str]) -> str:
    more = len(names) - NAMED_AT_MOST
    return ", ".join(names[:NAMED_AT_MOST]) + (f" and {more} more" if more > 0 else "")
