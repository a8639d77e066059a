"""The sealed run: ``make sealed``, once a release, by whoever releases.

``python -m topomerge.evaluation.sealed [--jobs 2]`` measures rooms and merges on the sealed set (`datasets/plans/sealed.py`),
which nothing else can read, and appends a block to ``docs/results/sealed.md``: date, version,
command, figures. What stands there is never written again. About 25 minutes on two cores: 110 pairs of grids (a quarter of
which must not merge), 40 scans of procedural buildings, and the sealed plans and grids of real buildings, if TOPOMERGE_DATA is
set. ``--public s3dis=FOLDER`` adds the sealed buildings of a published set. A version is measured once; ``--again`` does it once
more, and the block says so.

``--small`` runs two or three items of training seeds, to try the way; it writes to ``--page`` only.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import sys
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path

from topomerge import __version__
from topomerge.archive import replace_on_success
from topomerge.code_digest import read_commit
from topomerge.datasets.core.builder import run_script
from topomerge.datasets.plans.sealed import SEALED, open_sealed_set
from topomerge.errors import InputError
from topomerge.evaluation.sealed_measures import SEALED_PARTS, Row, SealedItem, format_tables, list_items, measured
from topomerge.progress import Stopwatch

ROOT = Path(__file__).parent.parent.parent
PAGE = ROOT / "docs" / "results" / "sealed.md"
HEAD = """# The sealed set

Buildings that no script of training, fitting, choosing or looking can read ([what they are](../data.md#the-sealed-set)), measured
once a release by `make sealed`. Blocks are appended, never written again.
"""


def measure_sealed_item(item: SealedItem, split: str) -> list[Row]:
    """Return the rows of an item, in this process; the gate is open for as long as that takes."""
    with open_sealed_set() if split == SEALED else nullcontext():
        return measured(item)


def run(
    split: str, data: Path | None, public: Sequence[tuple[str, Path]], jobs: int, small: bool, parts: Sequence[str] = SEALED_PARTS
) -> list[Row]:
    """Measure everything of these parts, in the order of the items."""
    from joblib import Parallel, delayed

    with open_sealed_set() if split == SEALED else nullcontext():
        items = [item for item in list_items(split, data, public, small) if item.part in parts]
    print(f"sealed: {len(items)} items", file=sys.stderr, flush=True)
    if jobs == 1:
        return [row for item in items for row in measure_sealed_item(item, split)]
    results: Iterable[list[Row]] = Parallel(jobs, batch_size=1, pre_dispatch=jobs)(
        delayed(measure_sealed_item)(i, split) for i in items
    )
    return [row for rows in results for row in rows]


def commit() -> str:
    """Return the commit of the sources, with a word where they differ from it; nothing outside a checkout."""
    named, changed = read_commit()
    return f"{named[:12]} with changes that are not committed" if changed else named[:12]


def list_blocks(text: str) -> list[str]:
    """List the versions of the blocks of a page."""
    return re.findall(r"(?m)^## \d{4}-\d\d-\d\d \d\d:\d\d UTC: version (\S+?)(?:,|$)", text)


def check_page(page: Path, version: str, repeated: bool) -> None:
    """Refuse to measure a version twice.

    Raises:
        InputError: it was measured, and nobody asks for it again.
    """
    if not repeated and page.is_file() and version in list_blocks(page.read_text(encoding="utf-8")):
        raise InputError(f"{page}: has a block of version {version}; a version is measured once (--again does it once more)")


def format_block(rows: Sequence[Row], version: str, command: str, seconds: float, before: int) -> str:
    """Format the block of a run, which is appended to the page.

    Args:
        before: blocks of the same version that are there.
    """
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    source = commit()
    title = f"## {now}: version {version}" + (f", commit {source}" if source else "")
    repeated = f" This version had been measured {before} times before: the set was not sealed for it any more." if before else ""
    took = f"`{command}`, {seconds / 60:.0f} minutes.{repeated}"
    return "\n".join(["", title, "", took, "", *format_tables(rows), ""])


def append_text(page: Path, text: str) -> None:
    """Add text to the end of a page: what stands there stays as it is, byte for byte, and the page is whole at any time."""
    before = page.read_bytes() if page.is_file() else HEAD.encode()
    with replace_on_success(page) as temporary:
        temporary.write_bytes(before + text.encode())


def parse_public_sets(values: Sequence[str]) -> list[tuple[str, Path]]:
    """Parse the sources and folders of SOURCE=FOLDER.

    Raises:
        InputError: not of this form, or no such folder.
    """
    out = []
    for word in values:
        source, _, folder = word.partition("=")
        if not folder or not Path(folder).is_dir():
            raise InputError(
                f"--public {word}: give SOURCE=FOLDER, such as s3dis=Stanford3dDataset_v1.2, with a folder that exists"
            )
        out.append((source, Path(folder)))
    return out


def parse_arguments(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m topomerge.evaluation.sealed", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--again", action="store_true", help="measure a version that was measured; the block says so")
    parser.add_argument("--small", action="store_true", help="a few items of training seeds")
    parser.add_argument("--parts", nargs="+", choices=SEALED_PARTS, default=list(SEALED_PARTS), help="what is measured")
    parser.add_argument("--public", nargs="*", default=[], metavar="SOURCE=FOLDER", help="published sets")
    parser.add_argument("--page", type=Path, help="where the block goes; docs/results/sealed.md")
    return parser.parse_args(arguments)


def measure_and_append(arguments: Sequence[str]) -> None:
    """Make the whole run."""
    options = parse_arguments(arguments)
    page = options.page or (None if options.small else PAGE)
    if page:
        check_page(page, __version__, options.again)
    before = list_blocks(page.read_text(encoding="utf-8")).count(__version__) if page and page.is_file() else 0
    data = Path(os.environ["TOPOMERGE_DATA"]) if os.environ.get("TOPOMERGE_DATA") and not options.small else None
    watch = Stopwatch()
    split, public = "train" if options.small else SEALED, parse_public_sets(options.public)
    rows = run(split, data, public, options.jobs, options.small, options.parts)
    text = format_block(
        rows, __version__, shlex.join(["python", "-m", "topomerge.evaluation.sealed", *arguments]), watch.elapsed, before
    )
    if page:
        append_text(page, text)
    print(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; the exit status."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    return run_script("sealed", lambda: measure_and_append(arguments), "nothing was written")


if __name__ == "__main__":
    sys.exit(main())
