"""pairs.json of an atlas: the registrations of its maps, coarse ones, too, so that none is made twice. It may be deleted.

While pairs are registered each is written to `.registered.jsonl` at once, so that who is killed goes on there the next time.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from topomerge import __version__
from topomerge.fusion.atlas.solve import RegistrationsByPair
from topomerge.io.listing import plain
from topomerge.matching.poses import PoseHypothesis
from topomerge.registration.verify import model
from topomerge.types import Sim3

PAIRS_FILE, PAIRS_FORMAT = "pairs.json", 1
JOURNAL_FILE = ".registered.jsonl"
UNREADABLE = (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError)
Pair = tuple[str, str]


class Journal(dict[Pair, tuple[PoseHypothesis, ...]]):
    """The registrations of an atlas, as its files hold them. Those that are added stand in `JOURNAL_FILE` at once, until the
    atlas itself is written.

    Args:
        folder: of the atlas, which exists.
        settings: of the atlas.

    Attributes:
        coarse: the coarse ones, log odds of pairs; written down, too (`coarse.coarse_log_odds`).
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        listing = _listing(folder, settings)
        super().__init__(_registrations(listing))
        self.coarse = _Coarse(self._write, _coarse(listing))
        self._file, self._stamp = folder / JOURNAL_FILE, _stamp(settings)
        if self._file.is_file():
            for line in self._file.read_text(encoding="utf-8", errors="replace").splitlines():
                self._take(line)

    def __setitem__(self, pair: Pair, hypotheses: tuple[PoseHypothesis, ...]) -> None:
        super().__setitem__(pair, hypotheses)
        self._write(_entry(pair, hypotheses))

    def _write(self, entry: Mapping[str, Any]) -> None:
        with self._file.open("a", encoding="utf-8") as out:
            out.write(json.dumps({"stamp": self._stamp, **entry}) + "\n")

    def _take(self, line: str) -> None:
        """What a line says; nothing where it was cut, or is of other settings."""
        try:
            entry = json.loads(line)
            if entry["stamp"] == self._stamp and "coarse" in entry:
                self.coarse.update(_coarse(entry))
            elif entry["stamp"] == self._stamp:
                super().__setitem__(*_read(entry))
        except UNREADABLE:
            return


class _Coarse(dict[Pair, float]):
    """Log odds of pairs; those that are added are written down."""

    def __init__(self, write: Callable[[Mapping[str, Any]], None], listed: Mapping[Pair, float]) -> None:
        super().__init__(listed)
        self._write_entry = write

    def __setitem__(self, pair: Pair, log_odds: float) -> None:
        super().__setitem__(pair, log_odds)
        self._write_entry({"coarse": [[*pair, log_odds]]})


def _listing(folder: Path, settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """What stands in pairs.json; nothing where the file is missing, damaged or of another version or other settings."""
    try:
        listing: Mapping[str, Any] = json.loads((folder / PAIRS_FILE).read_text(encoding="utf-8"))
        return listing if listing["format"] == PAIRS_FORMAT and listing["stamp"] == _stamp(settings) else {}
    except (OSError, *UNREADABLE):
        return {}


def _registrations(listing: Mapping[str, Any]) -> RegistrationsByPair:
    try:
        return dict(_read(entry) for entry in listing.get("pairs", ()))
    except UNREADABLE:
        return {}


def _coarse(listing: Mapping[str, Any]) -> dict[Pair, float]:
    try:
        coarse = {(str(a), str(b)): float(log_odds) for a, b, log_odds in listing.get("coarse", ())}
    except UNREADABLE:
        return {}
    return {pair: log_odds for pair, log_odds in coarse.items() if math.isfinite(log_odds)}


def registrations_to_json(registrations: Journal, keys: Collection[str], settings: Mapping[str, Any]) -> dict[str, Any]:
    """What `Journal` reads, of the maps with these keys."""
    of = set(keys)
    pairs = [_entry(pair, hypotheses) for pair, hypotheses in sorted(registrations.items()) if of.issuperset(pair)]
    coarse = [[*pair, log_odds] for pair, log_odds in sorted(registrations.coarse.items()) if of.issuperset(pair)]
    return {"format": PAIRS_FORMAT, "stamp": _stamp(settings), "pairs": pairs, "coarse": coarse}


def _entry(pair: Pair, hypotheses: Sequence[PoseHypothesis]) -> dict[str, Any]:
    return {"maps": list(pair), "hypotheses": [_listed(h) for h in hypotheses]}


def _read(entry: Mapping[str, Any]) -> tuple[Pair, tuple[PoseHypothesis, ...]]:
    """What `_entry` gave."""
    return (entry["maps"][0], entry["maps"][1]), tuple(_hypothesis(h) for h in entry["hypotheses"])


def _stamp(settings: Mapping[str, Any]) -> str:
    """What registrations depend on beside the maps."""
    inputs = [__version__, model(), settings["scale"], str(settings["embedder"]), settings["same"]]
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:16]


def _hypothesis(listed: Mapping[str, Any]) -> PoseHypothesis:
    x, y, z = map(float, listed["translation"])
    p = float(listed["probability"])
    if not 0 <= p <= 1:
        raise ValueError(f"probability {p}")
    pose = Sim3(float(listed["yaw"]), (x, y, z), float(listed["scale"]))
    return PoseHypothesis(pose, probability=p, features={str(k): float(v) for k, v in listed["features"].items()})


def _listed(hypothesis: PoseHypothesis) -> dict[str, Any]:
    pose = hypothesis.transform
    return {
        "yaw": pose.yaw,
        "translation": list(pose.translation),
        "scale": pose.scale,
        "probability": hypothesis.probability,
        "features": plain(dict(hypothesis.features)),
    }
