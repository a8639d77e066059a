"""Plans of real buildings, read from the formats that their owners publish, one `Plan` a storey for `erect`.

| file | format | reader |
|---|---|---|
| `*.tar.xz`, `*.txt` | apartments of Raster-to-Vector | `plan_r2v` |
| `*.xml` | schools and offices of Luperto et al. | `plan_campus` |
| `*.building.yaml` | Open-RMF traffic editor | `plan_rmf` |
| `geojson_map.json` | malls of the indoor location competition 2.0 | `plan_mall` |
| `*.vectormap.json` | line maps of UT-AMRL | `plan_amrl` |
| `locations.yaml`, `*_gt_segmentation.png` | robot grids with true rooms: UTexas BWI, IPA | `plan_grid` |
| `*.ifc` | building models with spaces | `plan_ifc` |

Reasons of refusals start with: not closed, crosses itself, overlapping rooms, zero-width doors, no doors, no walls, absurd
scale, no scale, too few rooms, disconnected, missing file, wrong version, bad line, damaged ..., absurd size, not read, not a
... plan.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from topomerge.datasets.plan import Plan
from topomerge.datasets.plan_sketch import Sketch, finish

from topomerge.errors import InputError

log = logging.getLogger(__name__)

READERS = (  # what a file's name matches, and the module that reads it
    (r"\.(tar(\.(xz|gz|bz2))?|tgz|txz|txt)$", "plan_r2v"),
    (r"\.xml$", "plan_campus"),
    (r"\.building\.yaml$", "plan_rmf"),
    (r"(^|/)geojson_map\.json$", "plan_mall"),
    (r"\.vectormap\.json$", "plan_amrl"),
    (r"(^|/)locations\.yaml$|_gt_segmentation\.png$", "plan_grid"),
    (r"\.ifc$", "plan_ifc"),
)
NOT_PLANS = re.compile(r"(^|/)(NOTE|README|LICENSE[^/]*)\.txt$|\.vectormap\.txt$|\.navigation\.txt$|(^|/)package\.xml$")

Maker = Callable[[], Sketch]


@dataclass(frozen=True)
class Refusal:
    """A plan that was not taken, and why; the reason's words before the colon are for counting."""

    name: str
    reason: str


def read_plans(path: str | Path) -> list[Plan]:
    """The plans of one file, lowest storey first.

    Args:
        path: a file; for one plan of an archive, ``archive.tar.xz::name``.

    Raises:
        InputError: the file is missing or of no known format, or one of its plans is refused.
    """
    file, _, member = str(path).partition("::")
    plans = []
    for name, result in _read(Path(file), member):
        if isinstance(result, Refusal):
            raise InputError(f"{file}: {name}: {result.reason}")
        plans.append(result)
    if not plans:
        raise InputError(f"{path}: no plan in it")
    return plans


def iter_plans(folder: str | Path) -> Iterator[tuple[str, Plan | Refusal]]:
    """Every plan of a folder, or of one file, in the order of their names; a bad one is a `Refusal` and the rest goes on.

    Names are paths below the folder, without suffix, with the storey or the archive's member behind them: unique, and the same
    on every machine. What was changed or left out of a plan is logged at level INFO.

    Raises:
        InputError: no such folder.
    """
    folder = Path(folder)
    if not folder.exists():
        raise InputError(f"{folder}: no such file or folder")
    files = [folder] if folder.is_file() else sorted(p for p in folder.rglob("*") if p.is_file() and _reader(p))
    root = folder.parent if folder.is_file() else folder
    for file in files:
        above = file.parent.relative_to(root).as_posix()
        for name, result in _read(file):
            name = name if above == "." else f"{above}/{name}"
            yield name, Refusal(name, result.reason) if isinstance(result, Refusal) else result


def summarise(results: Iterable[tuple[str, Plan | Refusal] | Refusal]) -> dict[str, int]:
    """How many plans were refused for which reason, the commonest first; plans among the results count as "taken"."""
    items = [item[1] if isinstance(item, tuple) else item for item in results]
    words = [item.reason.partition(":")[0] if isinstance(item, Refusal) else "taken" for item in items]
    return dict(Counter(words).most_common())


def _reader(path: Path) -> str:
    """Name of the module that reads a file, or nothing."""
    name = path.as_posix()
    if NOT_PLANS.search(name):
        return ""
    return next((module for pattern, module in READERS if re.search(pattern, name)), "")


def _read(path: Path, only: str = "") -> Iterator[tuple[str, Plan | Refusal]]:
    """Name and plan or refusal of each storey of a file."""
    module = _reader(path)
    if not module:
        yield path.stem, Refusal(path.stem, f"not a known format: {path.name}")
        return
    items: Iterator[tuple[str, Maker]] = import_module(f"topomerge.datasets.{module}").sketches(path)
    while True:
        try:
            name, make = next(items)
        except StopIteration:
            return
        except Exception as error:
            yield path.stem, Refusal(path.stem, _reason(error))
            return
        if not only or only == name:
            yield name, _made(name, make)


def _made(name: str, make: Maker) -> Plan | Refusal:
    try:
        plan, notes = finish(make())
    except Exception as error:
        return Refusal(name, _reason(error))
    if notes:
        log.info("%s: %s", name, "; ".join(f"{note} ({n} times)" if n > 1 else note for note, n in Counter(notes).items()))
    return plan


def _reason(error: Exception) -> str:
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, FileNotFoundError):
        return f"missing file: {Path(error.filename or '').name}"
    return f"not read: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
