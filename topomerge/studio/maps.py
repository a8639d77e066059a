"""Maps that the studio has open: the stored map, its journal, the corrected map, and what the page draws of it."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.edits.apply import apply_edits
from topomerge.edits.journal import (
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
from topomerge.io.maps import load_map
from topomerge.studio.plans import build_plan_data, lift_places
from topomerge.types import TopometricMap
from topomerge.viz.plan import build_scene_data
from topomerge.viz.report import render_report_html
from topomerge.viz.svg import Sheet

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
        unapplied: edits that do not fit the map, each with the reason.
        sheet: the paper on which it is drawn.
        plan: what the page draws, as JSON.
    """

    path: Path
    stamp: tuple[int, int]
    base: TopometricMap
    map: TopometricMap
    journal: Journal
    unapplied: list[dict[str, str]]
    sheet: Sheet | None = None
    plan: bytes = b""

    @property
    def version(self) -> int:
        """Number of lines of the journal."""
        return self.journal.version


class OpenMaps:
    """The maps that were looked at last. Its functions may be called from several threads."""

    def __init__(self) -> None:
        self._open: OrderedDict[Path, OpenMap] = OrderedDict()
        self._locks: dict[Path, threading.Lock] = {}
        self._lock = threading.Lock()

    def load(self, path: Path) -> OpenMap:
        """Load a map as it is now, with the journal as it is now.

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
                base = load_map(path)
                held = _apply(OpenMap(path, stamp, base, base, replace(journal, edits=()), []), journal)
            elif held.journal.edits != journal.edits:
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
        edit = _build(held, wish)
        if edit.op not in ("undo", "redo"):
            fitting = apply_edits(held.map, [edit])
            if fitting.unapplied:
                raise InputError(fitting.unapplied[0].reason)
        append_edits(find_journal(path), [edit], version)
        return self.load(path)

    def render_scene(self, path: Path) -> bytes:
        """Render the data of the 3D view, as JSON."""
        held = self.load(path)
        return json.dumps(build_scene_data(held.map, turn=held.sheet.turn if held.sheet else 0.0)).encode()

    def render_report(self, path: Path) -> bytes:
        """Render the page of the corrected map that can be sent to others."""
        return render_report_html(self.load(path).map).encode("utf-8", "replace")


def _build(held: OpenMap, wish: Mapping[str, Any]) -> Edit:
    """The edit that somebody wants."""
    values = dict(wish)
    op, by, storey = str(values.pop("op", "")), str(values.pop("by", ""))[:64], values.pop("storey", 0)
    if op in ("undo", "redo"):
        return (build_undo if op == "undo" else build_redo)(held.journal.edits, by)
    for name in FLAT:
        if isinstance(values.get(name), list):
            values[name] = _lift(held.map, values[name], storey)
    return build_edit(op, by, **values)


def _lift(map: TopometricMap, places: list[Any], storey: Any) -> list[Any]:
    """Places [x, y] of a storey as [x, y, z]; others as they are."""
    single = not (places and isinstance(places[0], list))
    listed = [places] if single else places
    numbers = all(isinstance(p, list) and len(p) == 2 and all(isinstance(v, int | float) for v in p) for p in listed)
    if not numbers or not isinstance(storey, int):
        return places
    lifted = lift_places(map, np.array(listed, float), storey).round(4).tolist()
    return lifted[0] if single else lifted


def _apply(held: OpenMap, journal: Journal) -> OpenMap:
    """The map with another state of its journal."""
    edited = apply_edits(held.base, journal.edits)
    unapplied = [{"id": one.edit.id, "op": one.edit.op, "reason": one.reason} for one in edited.unapplied]
    corrected = OpenMap(held.path, held.stamp, held.base, edited.map, journal, unapplied)
    listing, corrected.sheet = build_plan_data(corrected.map, held.sheet)
    listing |= {"version": journal.version, "unapplied": unapplied, "journal": _list_journal(journal)}
    listing |= {"title": corrected.map.title, "warnings": [*corrected.map.warnings, *journal.warnings]}
    corrected.plan = json.dumps(listing, allow_nan=False).encode()
    return corrected


def _list_journal(journal: Journal) -> dict[str, Any]:
    """The edits of a journal, which of them hold, and what can be taken back."""
    held = {edit.id for edit in select_effective(journal.edits)}
    edits = [edit.to_json() | {"holds": edit.id in held} for edit in journal.edits if edit.op not in ("undo", "redo")]
    can = {}
    for name, build in (("undo", build_undo), ("redo", build_redo)):
        try:
            can[name] = str(build(journal.edits).values["edit"])
        except InputError:
            can[name] = ""
    return {"edits": edits[-500:], "count": len(held), **can}
