"""Maps that the studio has open: the stored map, its journal, the corrected map, and what the page draws of it."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.edits.apply import EditedMap, RefusedEdit, apply_edits
from topomerge.edits.journal import (
    TAKE_BACK,
    ConflictError,
    Edit,
    Journal,
    append_edits,
    build_edit,
    build_redo,
    build_undo,
    find_journal,
    read_journal,
    select_effective,
)
from topomerge.errors import InputError
from topomerge.extraction.landmarks import load_map_with_landmarks
from topomerge.studio.plans import DrawnPlan, build_plan_data, lift_places
from topomerge.types import TopometricMap
from topomerge.viz.plan import build_scene_data
from topomerge.viz.report import render_report_html

KEPT_OPEN = 6  # maps
FLAT = ("at", "to", "between")  # fields of edits whose places the page gives as [x, y], on a storey


@dataclass(eq=False)
class OpenMap:
    """A stored map with its corrections.

    Args:
        path: of the `.tmap`.
        stamp: of the file when it was read.
        base: the map as it is stored.
        map: as it is corrected.
        journal: that was applied.
        refused: edits that do not fit the map, each with the reason.
        drawn: how it is drawn.
        plan: what the page draws, as JSON.
        whole: are all storeys in the plan, or only the lowest one?
    """

    path: Path
    stamp: tuple[int, int]
    base: TopometricMap
    map: TopometricMap
    journal: Journal
    refused: tuple[RefusedEdit, ...] = ()
    drawn: DrawnPlan | None = None
    plan: bytes = b""
    whole: bool = True

    @property
    def version(self) -> int:
        """Number of lines of the journal."""
        return self.journal.version

    def list_walls(self) -> list[str]:
        """List the outlines of the walls of each storey."""
        return [str(storey["walls"]) for storey in json.loads(self.plan)["storeys"]]


class OpenMaps:
    """The maps that were looked at last. Its functions may be called from several threads."""

    def __init__(self) -> None:
        self._open: OrderedDict[Path, OpenMap] = OrderedDict()
        self._locks: dict[Path, threading.Lock] = {}
        self._lock = threading.Lock()

    def load(self, path: Path, quick: bool = False) -> OpenMap:
        """Load a map as it is now, with the journal as it is now.

        Args:
            path: of the map.
            quick: draw the lowest storey only, if the map was not open before: of a large map it is seen soon.

        Raises:
            InputError: the map or its journal can't be read.
        """
        with self._lock:
            lock = self._locks.setdefault(path, threading.Lock())
        with lock:
            status = path.stat()
            stamp, journal = (status.st_mtime_ns, status.st_size), read_journal(find_journal(path))
            held = self._open.get(path)
            if held is None or held.stamp != stamp:
                base = load_map_with_landmarks(path)
                held = _apply(OpenMap(path, stamp, base, base, replace(journal, edits=()), whole=not quick), journal)
            elif held.journal.edits != journal.edits or not (held.whole or quick):
                held.whole = True
                held = _apply(held, journal)
            with self._lock:
                self._open[path] = held
                self._open.move_to_end(path)
                while len(self._open) > KEPT_OPEN:
                    self._open.popitem(last=False)
            return held

    def edit(self, path: Path, wish: Mapping[str, Any], version: int) -> OpenMap:
        """Append what somebody wants to the journal of a map, and return the map that is then.

        Args:
            path: of the map.
            wish: `op` with its fields, `by`, and `storey` for places that are given as [x, y]; or only `op`: undo or redo.
            version: of the journal that it was made for.

        Raises:
            ConflictError: somebody else was faster.
            InputError: it is no edit, or does not fit the map.
        """
        held = self.load(path)
        if held.version != version:
            raise ConflictError(held.journal.path, version, held.version)
        edit, after = _build(held, wish), None
        if edit.op not in TAKE_BACK:
            after = apply_edits(held.map, [edit])
            if after.refused:
                raise InputError(after.refused[0].reason)
        append_edits(find_journal(path), [edit], version)
        with self._lock:
            if after is not None and self._open.get(path) is held:
                self._open[path] = _apply(held, replace(held.journal, edits=(*held.journal.edits, edit)), after)
        return self.load(path)

    def render_scene(self, path: Path) -> bytes:
        """Render the data of the 3D view, as JSON."""
        held = self.load(path)
        return json.dumps(build_scene_data(held.map, turn=held.drawn.sheet.turn if held.drawn else 0.0)).encode()

    def render_report(self, path: Path) -> bytes:
        """Render the page of the corrected map that can be sent to others."""
        return render_report_html(self.load(path).map).encode("utf-8", "replace")


def _build(held: OpenMap, wish: Mapping[str, Any]) -> Edit:
    """Return the edit that somebody wants."""
    values = dict(wish)
    op, by, storey = str(values.pop("op", "")), str(values.pop("by", ""))[:64], values.pop("storey", 0)
    if op in TAKE_BACK:
        return (build_undo if op == "undo" else build_redo)(held.journal.edits, by)
    for name in FLAT:
        if isinstance(values.get(name), list):
            values[name] = _lift(held.map, values[name], storey)
    return build_edit(op, by, **values)


def _lift(map: TopometricMap, places: list[Any], storey: Any) -> list[Any]:
    """Return places [x, y] of a storey as [x, y, z]; others as they are."""
    single = not (places and isinstance(places[0], list))
    listed = [places] if single else places
    numbers = all(isinstance(p, list) and len(p) == 2 and all(isinstance(v, int | float) for v in p) for p in listed)
    if not numbers or not isinstance(storey, int):
        return places
    lifted = lift_places(map, np.array(listed, float), storey).round(4).tolist()
    return lifted[0] if single else lifted


def _apply(held: OpenMap, journal: Journal, after: EditedMap | None = None) -> OpenMap:
    """Return the map with another state of its journal.

    Args:
        held: with the state before.
        journal: the state that counts.
        after: `held.map` with what was added, where somebody has applied that.
    """
    added, before = journal.edits[len(held.journal.edits) :], held.refused
    if after is None and (journal.edits[: len(held.journal.edits)] != held.journal.edits or _takes_back(added)):
        after, before = apply_edits(held.base, journal.edits), ()
    elif after is None:
        after = apply_edits(held.map, added)
    corrected = replace(held, map=after.map, journal=journal, refused=(*before, *after.refused))
    listing, corrected.drawn = build_plan_data(corrected.map, held.drawn, None if held.whole else 1)
    corrected.whole = held.whole or len(listing["storeys"]) == 1
    listing["whole"] = corrected.whole
    refused = [{"id": one.edit.id, "op": one.edit.op, "reason": one.reason} for one in corrected.refused]
    listing |= {"version": journal.version, "unapplied": refused, "journal": _list_journal(journal)}
    listing |= {"title": corrected.map.title, "warnings": [*corrected.map.warnings, *journal.warnings]}
    corrected.plan = json.dumps(listing, allow_nan=False).encode()
    return corrected


def _takes_back(edits: Sequence[Edit]) -> bool:
    return any(edit.op in TAKE_BACK for edit in edits)


def _list_journal(journal: Journal) -> dict[str, Any]:
    """Return the edits of a journal, which of them hold, and what can be taken back."""
    held = {edit.id for edit in select_effective(journal.edits)}
    edits = [edit.to_json() | {"holds": edit.id in held} for edit in journal.edits if edit.op not in TAKE_BACK]
    can = {}
    for name, build in (("undo", build_undo), ("redo", build_redo)):
        try:
            can[name] = str(build(journal.edits).values["edit"])
        except InputError:
            can[name] = ""
    return {"edits": edits[-500:], "count": len(held), **can}
