"""What is in a cached set, as the tables of `docs/data.md`: ``python -m topomerge.datasets.reports.statistics
cache/train_small.jsonl``.

Reads the manifest and the pairs, and changes neither. While a build runs there is no manifest yet: ``--pairs cache/pairs`` counts
what is in the folder. ``--write docs/data.md`` puts the tables between the two marks there.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from topomerge.datasets.core.builder import refusal
from topomerge.datasets.core.script import exit_status
from topomerge.datasets.pairs.items import Item

from topomerge.errors import InputError
from topomerge.io import archive
from topomerge.io.atomic import replacing
from topomerge.types import Array

TABLES_BEGIN, TABLES_END = "<!-- statistics:begin -->", "<!-- statistics:end -->"
OVERLAP_BINS = (  # from, to, in words
    (0.0, 1e-9, "none"),
    (1e-9, 0.15, "below 15 %"),
    (0.15, 0.35, "15 to 35 %"),
    (0.35, 0.6, "35 to 60 %"),
    (0.6, 2.0, "above 60 %"),
)
CLEAN_IOU = 0.6  # IoU with the true room, from which on the middle of an extracted room can be compared
Row = Mapping[str, Any]
Lines = Iterator[str]


@dataclass(frozen=True)
class Counted:
    """A set as it was read.

    Args:
        rows: what its file says of each pair (`example.make_arrays`).
        bytes: of each file.
        apart: m, of all pairs: see `middles_apart`.
        outdated: pairs in the folder that are of another version of the data (`items.PAIR_FORMAT`); none of them is counted.
        refused: reasons and how often, without the names and numbers in them; of all versions in the folder. What took too
            long, or failed in a way that may not happen again, leaves no file and is not among them.
    """

    rows: list[Row]
    bytes: list[int]
    apart: list[float]
    outdated: int
    refused: dict[str, int]


def count_manifest(manifest: Path) -> Counted:
    """Count the pairs of a manifest; items beside it that were refused are counted too.

    Raises:
        InputError: no such manifest, it is damaged, or a pair of it is missing or damaged.
    """
    if not manifest.is_file():
        raise InputError(f"{manifest}: no such manifest; while a build runs, name its folder with --pairs")
    try:
        names = [str(json.loads(line)["file"]) for line in manifest.read_text(encoding="utf-8").splitlines()]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{manifest}: damaged ({error}); build the set again, which goes on where it was") from error
    return _counted([manifest.parent / "pairs" / name for name in names], manifest.parent / "pairs")


def count_folder(folder: Path) -> Counted:
    """Count all pairs that are in a folder by now.

    Raises:
        InputError: no such folder, or a damaged file.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name the folder of the pairs, as in --pairs cache/pairs")
    return _counted(sorted(folder.glob("[!.]*.npz")), folder)


def _counted(paths: Sequence[Path], folder: Path) -> Counted:
    rows: list[Row] = []
    sizes: list[int] = []
    apart: list[float] = []
    for path in paths:
        arrays = archive.read(path, "cached pair")
        try:
            row = json.loads(arrays["about"].tobytes())
            if item_of(row).name != path.stem:
                continue
            apart += middles_apart(arrays).tolist()
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path}: is no cached pair ({error}); delete it and build the set again") from error
        rows.append(row)
        sizes.append(path.stat().st_size)
    reasons = Counter(kind_of(refusal(folder, p.stem)) for p in sorted(folder.glob("[!.]*.refused")))
    return Counted(rows, sizes, apart, len(paths) - len(rows), dict(reasons.most_common()))


def item_of(row: Row) -> Item:
    """The item that a pair was made from: its name is that of the file if it was made by this version of the code.

    Raises:
        KeyError: something of it is missing.
    """
    entries = {**row, "overlap": row["asked_overlap"]}
    later = {field.name for field in fields(Item) if field.default is not MISSING}  # older rows don't tell them
    names = {field.name for field in fields(Item)} - (later - set(entries))
    return Item(**{name: _fixed(entries[name]) for name in names})


def _fixed(value: Any) -> Any:
    return tuple(map(_fixed, value)) if isinstance(value, list) else value


def kind_of(reason: str) -> str:
    """A reason without names, numbers and sensors, and without the advice after it."""
    short = re.split(r";| from a map of ", reason)[0]
    return re.sub(r"\S*\d\S*", "…", short)


def middles_apart(arrays: Mapping[str, Array]) -> Array:
    """(k,) m, seen from above, between the middles of matched rooms, b's moved by the true transform.

    Rooms count that are the one-to-one partner of their true room with an IoU above `CLEAN_IOU` in both maps. The IoU is that
    of what the map saw of the room: each may have seen another end of a corridor. Heights are left out: the middle's depends on
    what was seen of the ceiling.
    """
    i, j = arrays["matches"].T
    clean = [(arrays[f"{s}.true_iou"] > CLEAN_IOU) & arrays[f"{s}.true_one"] for s in "ab"]
    good = clean[0][i] & clean[1][j]
    moved = arrays["b.pos"][j[good]] @ arrays["transform"][:3, :3].T + arrays["transform"][:3, 3]
    return np.linalg.norm((moved - arrays["a.pos"][i[good]])[:, :2], axis=1)


def table(head: Sequence[str], body: Iterable[Sequence[object]]) -> Lines:
    """Lines of a Markdown table, and an empty one."""
    for cells in (head, ["---"] * len(head), *body):
        yield f"| {' | '.join(map(str, cells))} |"
    yield ""


def share(part: float, whole: float) -> str:
    """A share in words; a dash where there is nothing to share."""
    return f"{100 * part / whole:.0f} %" if whole else "–"


def by_sensor(rows: Sequence[Row]) -> Lines:
    """How many rooms come out of a map of each sensor, and how many of them are true ones."""
    keys = ("visited", "extracted", "identified", "one_to_one")
    maps = [(row["sensors"][k], *(row[key][k] for key in keys)) for row in rows for k in (0, 1)]
    names = [name for name, _ in Counter(m[0] for m in maps).most_common()]
    body = []
    for name in (*names, "all"):
        held = np.array([m[1:] for m in maps if name in (m[0], "all")], float)
        visited, extracted, identified, one = held.sum(axis=0)
        each = [f"{total / len(held):.1f}" for total in (visited, extracted)]
        body.append((name, len(held), *each, share(identified, extracted), share(one, extracted)))
    yield from table(("sensor", "maps", "rooms visited", "rooms extracted", "are a true room", "one-to-one"), body)


def by_overlap(rows: Sequence[Row]) -> Lines:
    """How many extracted rooms have a true partner, by the share of visited rooms in common."""
    alike = [row for row in rows if not row["hard"]]
    hard = [row for row in rows if row["hard"]]
    kinds = ", ".join(f"{count} {kind.replace('-', ' ')}" for kind, count in Counter(row["hard"] for row in hard).most_common())
    groups = [(name, [row for row in alike if low <= row["overlap"] < high]) for low, high, name in OVERLAP_BINS]
    groups += [("all that overlap", [row for row in alike if row["overlap"] > 0]), (f"hard negatives: {kinds or 'none'}", hard)]
    body = []
    for name, held in groups:
        partners, extracted = (sum(sum(row[key]) for row in held) for key in ("partners", "extracted"))
        mean = f"{100 * np.mean([row['overlap'] for row in held]):.0f} %" if held else "–"
        body.append((name, len(held), mean, share(partners, extracted), sum(not row["partners"][0] for row in held)))
    head = ("overlap (rooms visited by both)", "pairs", "mean", "extracted rooms with a true partner", "pairs without any")
    yield from table(head, body)


def by_source(rows: Sequence[Row]) -> Lines:
    """Where the buildings are from."""
    body = []
    for source, held in _groups(rows, "source"):
        kinds = [f"{len(of)} {kind}" for kind, of in _groups(held, "kind") if kind]
        stacks = sum(row["storeys"] > 1 for row in held)
        body.append((source, len(held), stacks, sum(row["over_stairs"] for row in held), ", ".join(kinds) or "plans"))
    yield from table(("source", "pairs", "of several storeys", "walked over stairs", "kinds"), body)


def _groups(rows: Sequence[Row], key: str) -> list[tuple[str, list[Row]]]:
    """Rows of each value, the commonest first."""
    counts = Counter(row[key] for row in rows).most_common()
    return [(name, [row for row in rows if row[key] == name]) for name, _ in counts]


def report(counted: Counted) -> Lines:
    """All tables, as Markdown.

    Raises:
        InputError: there is no pair.
    """
    if not counted.rows:
        raise InputError("no pair is there yet; build the set, or wait for its first pairs")
    refused = sum(counted.refused.values())
    size, total = np.median(counted.bytes) / 1000, sum(counted.bytes) / 1e6
    if counted.outdated:
        yield f"{counted.outdated} pairs of another version of the data are in the folder; they are not counted."
        yield ""
    yield f"{len(counted.rows)} pairs, {refused} items refused; {size:.0f} kB a file (median), {total:.0f} MB together."
    yield ""
    yield from by_sensor(counted.rows)
    yield from by_overlap(counted.rows)
    yield from by_source(counted.rows)
    if counted.apart:
        middle, most = np.percentile(counted.apart, [50, 90])
        over = len(counted.apart)
        yield f"Matched rooms that came out of both maps with an IoU above {CLEAN_IOU:g}, one-to-one, have their middles"
        yield f"{middle:.2f} m apart under the true transform, seen from above (median of {over}; 90 %: {most:.1f} m;"
        yield "each map may have seen another part of a room, which moves its middle)."
        yield ""
    if refused:
        yield from table(("refused because", "items"), counted.refused.items())


def insert(path: Path, lines: Iterable[str]) -> None:
    """Replace what stands between the marks of a file.

    Raises:
        InputError: no such file, or it lacks the marks.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror})") from error
    before, begin, rest = text.partition(TABLES_BEGIN)
    _, end, after = rest.partition(TABLES_END)
    if not begin or not end:
        raise InputError(f"{path}: lacks {TABLES_BEGIN} and {TABLES_END} after it; put them where the tables belong")
    with replacing(path) as beside:
        body = "\n".join(line.rstrip() for line in lines).strip()
        beside.write_text(f"{before}{TABLES_BEGIN}\n{body}\n{TABLES_END}{after}", encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables, or write them into a file."""
    parser = argparse.ArgumentParser(prog="python -m topomerge.datasets.reports.statistics", description=__doc__)
    parser.add_argument("manifest", nargs="?", type=Path, help="manifest of a set, such as cache/train_small.jsonl")
    parser.add_argument("--pairs", type=Path, metavar="FOLDER", help="folder of pairs, instead of a manifest")
    parser.add_argument(
        "--write", type=Path, metavar="FILE", help=f"replace what is between {TABLES_BEGIN} and {TABLES_END} in this file"
    )
    given = parser.parse_args(arguments)
    if (given.manifest is None) == (given.pairs is None):
        parser.error("name a manifest, or a folder with --pairs")
    return exit_status("statistics", lambda: _write(given))


def _write(given: argparse.Namespace) -> None:
    lines = list(report(count_manifest(given.manifest) if given.manifest else count_folder(given.pairs)))
    if given.write:
        insert(given.write, lines)
    else:
        print("\n".join(lines))


if __name__ == "__main__":
    sys.exit(main())
