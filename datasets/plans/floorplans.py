"""Plans of real buildings, read from the formats that their owners publish, one `Plan` a storey for `build_building`.

| file | format | reader |
|---|---|---|
| `*.tar.xz`, `*.txt` | apartments of Raster-to-Vector | `plans.r2v` |
| `*.xml` | schools and offices of Luperto et al. | `plans.campus` |
| `*.building.yaml` | Open-RMF traffic editor | `plans.rmf` |
| `geojson_map.json` | malls of the indoor location competition 2.0 | `plans.mall` |
| `*.vectormap.json` | line maps of UT-AMRL | `plans.amrl` |
| `locations.yaml`, `*_gt_segmentation.png` | robot grids with true rooms: UTexas BWI, IPA | `plans.grid` |
| `*.ifc` | building models with spaces | `plans.ifc` |
| `*.json` that begin as Valetudo's | homes by vacuum robots, with the robots' rooms | `plans.robot_home` |

Reasons of refusals start with: not closed, crosses itself, overlapping rooms, zero-width doors, no doors, no walls, absurd
scale, no scale, too few rooms, disconnected, missing file, wrong version, bad line, damaged ..., absurd size, not read, not a
... plan, sealed.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import shapely
from topomerge.datasets.core.building import STRANGERS, Flight, Plan, PlanRoom, parse_storey_name
from topomerge.datasets.plans.robot_home import is_robot_home
from topomerge.datasets.plans.sealed import refuse_file
from topomerge.datasets.plans.sketch import Sketch, finish

from topomerge.errors import InputError

log = logging.getLogger(__name__)

READERS = (  # what a file's name matches, and the module that reads it
    (r"\.(tar(\.(xz|gz|bz2))?|tgz|txz|txt)$", "r2v"),
    (r"\.xml$", "campus"),
    (r"\.building\.yaml$", "rmf"),
    (r"(^|/)geojson_map\.json$", "mall"),
    (r"\.vectormap\.json$", "amrl"),
    (r"(^|/)locations\.yaml$|_gt_segmentation\.png$", "grid"),
    (r"\.ifc$", "ifc"),
)
NOT_PLANS = re.compile(r"(^|/)(NOTE|README|LICENSE[^/]*)\.txt$|\.vectormap\.txt$|\.navigation\.txt$|(^|/)package\.xml$")

FORMATS_WITH_LEVELS = ("rmf", "ifc")  # formats with several storeys a file
SURVEYED = ("mall",)  # formats whose storeys, one a folder, are in one frame

Maker = Callable[[], Sketch]


@dataclass(frozen=True)
class Refusal:
    """A plan that was not taken, and why; the reason's words before the colon are for counting."""

    name: str
    reason: str


def read_plans(path: str | Path) -> list[Plan]:
    """Read the plans of one file, lowest storey first.

    Args:
        path: a file; for one plan of an archive, ``archive.tar.xz::name``.

    Raises:
        InputError: the file is missing or of no known format, or one of its plans is refused.
    """
    file, _, member = str(path).partition("::")
    plans = []
    for name, result in _read(Path(file), lambda name: not member or member == name):
        if isinstance(result, Refusal):
            raise InputError(f"{file}: {name}: {result.reason}")
        plans.append(result)
    if not plans:
        raise InputError(f"{path}: no plan in it")
    return remove_dead_flights(plans)


def remove_dead_flights(plans: list[Plan]) -> list[Plan]:
    """Return storeys, lowest first, without the lifts and stairs that end in no room: rooms that no door reaches are left out."""
    out = []
    for k, plan in enumerate(plans):
        above = plans[k + 1].rooms if k + 1 < len(plans) else ()
        flights = [f for f in plan.flights if all(_is_in_room(f, rooms) for rooms in (plan.rooms, above))]
        out.append(replace(plan, flights=tuple(flights)))
    return out


def _is_in_room(flight: Flight, rooms: tuple[PlanRoom, ...]) -> bool:
    ahead = np.array([np.cos(flight.heading), np.sin(flight.heading)])
    middle = np.asarray(flight.corner) + ahead * flight.length / 2 + np.array([ahead[1], -ahead[0]]) * flight.width / 2
    return any(shapely.Polygon(room.polygon).contains(shapely.Point(middle)) for room in rooms)


def iter_plans(folder: str | Path, among: Collection[str] | None = None) -> Iterator[tuple[str, Plan | Refusal]]:
    """Yield every plan of a folder, or of one file, in the order of their names; a bad one is a `Refusal` and the rest goes on.

    Names are paths below the folder, without suffix, with the storey or the archive's member behind them: unique, and the same
    on every machine. What was changed or left out of a plan is logged at level INFO.

    Args:
        among: only plans of these names.

    Raises:
        InputError: no such folder.
    """
    for file, root in _list_files(Path(folder)):
        above = partial(_build_full_name, file, root)
        for name, result in _read(file, lambda name, above=above: among is None or above(name) in among):  # type: ignore[misc]
            name = above(name)
            yield name, Refusal(name, result.reason) if isinstance(result, Refusal) else result


def list_plan_names(folder: str | Path) -> list[str]:
    """List names (as of `iter_plans`) of all plans of a folder, also of those that would be refused; no plan is read.

    Raises:
        InputError: no such folder.
    """
    return [_build_full_name(file, root, name) for file, root in _list_files(Path(folder)) for name in _list_names(file)]


def _list_files(folder: Path) -> list[tuple[Path, Path]]:
    """List the files with plans, and the folder that their names count from."""
    if not folder.exists():
        raise InputError(f"{folder}: no such file or folder")
    if folder.is_file():
        return [(folder, folder.parent)]
    return [(p, folder) for p in sorted(folder.rglob("*")) if p.is_file() and _find_reader(p)]


def _build_full_name(file: Path, root: Path, name: str) -> str:
    """Return the path of the folder and name of the plan, without repeating the folder's own name."""
    above = file.parent.relative_to(root)
    if above.name and above.name == name.split("/")[0]:
        above = above.parent
    return (above / name).as_posix()


def group_siblings(folder: str | Path) -> list[list[str]]:
    """Return names (as of `iter_plans`) of the plans that are storeys of one building, lowest first; single ones are left out.

    Storeys of one file belong together; so do files whose names differ in a storey only: Sabadell1 and Sabadell2, P0 and P1,
    groundfloor and secondfloor, LOWER and MAIN, the folders B1, F1 and F2. Whether their frames and scales agree is up to the
    owner of the plans: those of the campus plans do not.
    """
    groups: dict[tuple[str, str], list[tuple[float, str]]] = {}
    for file, root in _list_files(Path(folder)):
        names = [_build_full_name(file, root, name) for name in _list_names(file)]
        if len(names) > 1 and _find_reader(file) in FORMATS_WITH_LEVELS:
            groups[("", names[0])] = [(k, name) for k, name in enumerate(names)]
        elif len(names) == 1:
            above, _, last = names[0].rpartition("/")
            base, level = parse_storey_name(last)
            if base not in STRANGERS:
                groups.setdefault((above if base or level else names[0], base), []).append((level, names[0]))
    return sorted([name for _, name in sorted(group)] for group in groups.values() if len(group) > 1)


def map_plans_to_frames(folder: str | Path) -> dict[str, str]:
    """Map each plan (named as of `iter_plans`) to the frame it is in: that of its file or survey, otherwise one of its own."""
    out = {}
    for file, root in _list_files(Path(folder)):
        for name in (_build_full_name(file, root, name) for name in _list_names(file)):
            reader = _find_reader(file)
            out[name] = (
                file.as_posix()
                if reader in FORMATS_WITH_LEVELS
                else file.parent.parent.as_posix()
                if reader in SURVEYED
                else name
            )
    return out


def _list_names(file: Path) -> list[str]:
    try:
        refuse_file(file)
        return [name for name, _ in import_module(f"topomerge.datasets.plans.{_find_reader(file)}").iter_sketches(file)]
    except Exception:  # refused by `iter_plans`, with the reason
        return []


def summarise(results: Iterable[tuple[str, Plan | Refusal] | Refusal]) -> dict[str, int]:
    """Count the refused plans by reason, the commonest first; plans among the results count as "taken"."""
    items = [item[1] if isinstance(item, tuple) else item for item in results]
    parts = [item.reason.partition(":")[0] if isinstance(item, Refusal) else "taken" for item in items]
    return dict(Counter(parts).most_common())


def _find_reader(path: Path) -> str:
    """Return the name of the module that reads a file, or nothing."""
    name = path.as_posix()
    if NOT_PLANS.search(name):
        return ""
    module = next((module for pattern, module in READERS if re.search(pattern, name)), "")
    return "robot_home" if not module and path.suffix == ".json" and is_robot_home(path) else module


def _read(path: Path, requested: Callable[[str], bool] = lambda name: True) -> Iterator[tuple[str, Plan | Refusal]]:
    """Yield the name and plan or refusal of each storey of a file."""
    module = _find_reader(path)
    if not module:
        yield path.stem, Refusal(path.stem, f"not a known format: {path.name}")
        return
    try:
        refuse_file(path)
    except InputError as error:
        yield path.stem, Refusal(path.stem, str(error))
        return
    items: Iterator[tuple[str, Maker]] = import_module(f"topomerge.datasets.plans.{module}").iter_sketches(path)
    while True:
        try:
            name, make = next(items)
        except StopIteration:
            return
        except Exception as error:
            yield path.stem, Refusal(path.stem, _format_reason(error))
            return
        if requested(name):
            yield name, _build_plan(name, make)


def _build_plan(name: str, make: Maker) -> Plan | Refusal:
    try:
        plan, notes = finish(make())
    except Exception as error:
        return Refusal(name, _format_reason(error))
    if notes:
        log.info("%s: %s", name, "; ".join(f"{note} ({n} times)" if n > 1 else note for note, n in Counter(notes).items()))
    return plan


def _format_reason(error: Exception) -> str:
    if isinstance(error, InputError):
        return " ".join(str(error).split())
    if isinstance(error, FileNotFoundError):
        return f"missing file: {Path(error.filename or '').name}"
    return f"not read: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
