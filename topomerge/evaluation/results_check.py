"""Name what is stale in the README and the docs: ``make results-check``. It measures nothing, takes seconds, and never fails."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

from topomerge.code_digest import compute_code_digest
from topomerge.errors import InputError
from topomerge.evaluation.documents import (
    BLOCK,
    FIGURES,
    OLD_STAMP,
    ROOT,
    Stamp,
    digest_inputs,
    list_pages,
    read_headline,
    read_stamp,
)
from topomerge.evaluation.tasks import list_inputs_of


def find_stale(pages: Iterable[Path], root: Path = ROOT) -> Iterator[str]:
    """Name each generated block that is not of this state of code and inputs, and why.

    Yields:
        lines such as ``docs/results/rooms.md classic: the code has changed since (python evaluate.py ...)``.
    """
    for page in pages:
        for name, text in BLOCK.findall(page.read_text(encoding="utf-8")):
            if name == "headline":  # each of its figures has a stamp of its own
                continue
            if reason := explain_stale(text):
                yield f"{page.relative_to(root)} {name}: {reason}"


def explain_stale(block: str) -> str:
    """Say why a block, or an entry with a stamp, is stale; empty where it is not."""
    stamp = read_stamp(block)
    if stamp is None:
        old = OLD_STAMP.match(block.lstrip())
        return f"measured at commit {old['commit']}, not since" if old else "nothing says what made it"
    reasons = [f"the {what} has changed" for what in find_changes(stamp)]
    return f"{' and '.join(reasons)} since ({stamp.command})" if reasons else ""


def find_changes(stamp: Stamp) -> list[str]:
    """Compare a stamp with this state: ``code``, ``data``, both, or nothing has changed."""
    changed = []
    try:
        now = compute_code_digest(*stamp.modules)
    except ModuleNotFoundError:
        now = ""
    if now != stamp.code:
        changed.append("code")
    try:
        inputs = list_inputs_of(stamp.command)
    except InputError:  # its data is not on this machine, or the command is one of an earlier state
        inputs = None
    if inputs is not None and digest_inputs(inputs) != stamp.data:
        changed.append("data")
    return changed


def find_stale_figures(path: Path = FIGURES) -> Iterator[str]:
    """Name each figure that is not of this state of code and inputs, and why."""
    for entry in read_headline(path):
        if reason := explain_stale(entry["stamp"]):
            yield f"{path.relative_to(ROOT)} {entry['name']}: {reason}"


def main() -> int:
    """Print a line for each stale block and figure, and how many there are."""
    stale = [*find_stale_figures(), *find_stale(list_pages())]
    print("\n".join([*stale, f"{len(stale)} blocks and figures are not of this state of the code."]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
