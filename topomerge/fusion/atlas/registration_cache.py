"""pairs.json of an atlas: the registrations of its maps, so that none is made twice. It may be deleted.

While pairs are registered each is written to `.registered.jsonl` at once, so that who is killed goes on there the next time.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from topomerge import __version__
from topomerge.fusion.atlas.solve import RegistrationsByPair
from topomerge.fusion.verify import model
from topomerge.io.listing import plain
from topomerge.matching.poses import PoseHypothesis
from topomerge.types import Sim3

PAIRS_FILE, PAIRS_FORMAT = "pairs.json", 1
JOURNAL_FILE = ".registered.jsonl"
Pair = tuple[str, str]


class Journal(dict[Pair, tuple[PoseHypothesis, ...]]):
    """The registrations of an atlas; those that are added are written down at once.

    Args:
        folder: of the atlas, which exists.
        settings: of the atlas.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        super().__init__(read_registrations(folder, settings))
        self._file, self._stamp = folder / JOURNAL_FILE, _stamp(settings)
        if self._file.is_file():
            for line in self._file.read_text(encoding="utf-8", errors="replace").splitlines():
                self._take(line)

    def __setitem__(self, pair: Pair, hypotheses: tuple[PoseHypothesis, ...]) -> None:
        super().__setitem__(pair, hypotheses)
        line = json.dumps({"stamp": self._stamp, **_entry(pair, hypotheses)})
        with self._file.open("a", encoding="utf-8") as out:
            out.write(line + "\n")

    def end(self) -> None:
        """All of it stands in the atlas now."""
        self._file.unlink(missing_ok=True)

    def _take(self, line: str) -> None:
        """What a line says; nothing where it was cut, or is of other settings."""
        try:
            entry = json.loads(line)
            if entry["stamp"] == self._stamp:
                super().__setitem__(*_read(entry))
        except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError):
            return


def read_registrations(folder: Path, settings: Mapping[str, Any]) -> RegistrationsByPair:
    """The registrations of an atlas; none where the file is missing, damaged or of another version.

    Args:
        settings: of the atlas.
    """
    try:
        listing = json.loads((folder / PAIRS_FILE).read_text(encoding="utf-8"))
        if listing["format"] != PAIRS_FORMAT or listing["stamp"] != _stamp(settings):
            return {}
        return dict(_read(entry) for entry in listing["pairs"])
    except (OSError, ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError):
        return {}


def registrations_to_json(
    registrations: RegistrationsByPair, keys: Collection[str], settings: Mapping[str, Any]
) -> dict[str, Any]:
    """What `read_registrations` reads, of the maps with these keys."""
    pairs = [_entry(pair, hypotheses) for pair, hypotheses in sorted(registrations.items()) if set(pair) <= set(keys)]
    return {"format": PAIRS_FORMAT, "stamp": _stamp(settings), "pairs": pairs}


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
