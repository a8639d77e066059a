"""Figures in documents: written between marks, drawn as tables, and told stale by digest; those of the README are in one file."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.code_digest import compute_code_digest
from topomerge.errors import InputError
from topomerge.statistics import format_interval

ROOT = Path(__file__).parent.parent.parent
BLOCK = re.compile(r"<!-- ([\w-]+):begin -->\n(.*?)<!-- \1:end -->", re.DOTALL)
STAMP = re.compile(
    r"<!-- made by `(?P<command>[^`]+)`; code (?P<code>\w+) of (?P<modules>[\w., ]+); data (?P<data>\w+)"
    r"(?:; (?P<confirmed>[^>]+))? -->"
)
OLD_STAMP = re.compile(r"<!-- measured at commit (?P<commit>\w+)[^>]*-->")
NO_INPUTS = "none"


@dataclass(frozen=True)
class Stamp:
    """The command, code and data that made a block.

    Args:
        command: that writes it.
        modules: whose code, and all that this imports and reads, decides what stands in it.
        code: digest of that.
        data: digest of the names of its inputs.
        confirmed: which of its rows are older, if any, and what says that they hold.
    """

    command: str
    modules: tuple[str, ...]
    code: str
    data: str
    confirmed: str = ""

    def write_comment(self) -> str:
        """Write the stamp as the comment that `read_stamp` reads."""
        origin = f"made by `{self.command}`; code {self.code} of {', '.join(self.modules)}; data {self.data}"
        return f"<!-- {'; '.join(filter(None, (origin, self.confirmed)))} -->"


def build_stamp(command: str, modules: Iterable[str], inputs: Iterable[str] = (), confirmed: str = "") -> Stamp:
    """Build the stamp of what this state of the code makes of these inputs."""
    names = tuple(modules)
    return Stamp(command, names, compute_code_digest(*names), digest_inputs(inputs), confirmed)


def digest_inputs(inputs: Iterable[str]) -> str:
    """Compute a short digest of the names of inputs, in any order."""
    names = sorted(inputs)
    return hashlib.sha256("\n".join(names).encode()).hexdigest()[:12] if names else NO_INPUTS


def read_stamp(text: str) -> Stamp | None:
    """Read the stamp in the first line of a block; None where there is none."""
    found = STAMP.match(text.lstrip())
    if found is None:
        return None
    modules = tuple(found["modules"].split(", "))
    return Stamp(found["command"], modules, found["code"], found["data"], found["confirmed"] or "")


def write_blocks(page: Path, blocks: Mapping[str, str], stamp: Stamp) -> list[str]:
    """Write the blocks that a page has marks of; the names of these.

    Raises:
        InputError: the page has the marks of none of them.
    """
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    written = []
    for name, block in blocks.items():
        begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
        if begin in text and end in text:
            before, rest = text.split(begin, 1)
            text = f"{before}{begin}\n{stamp.write_comment()}\n\n{block.strip()}\n\n{end}{rest.split(end, 1)[1]}"
            written.append(name)
    if not written:
        raise InputError(f"{page}: has no marks of {', '.join(blocks)}; put <!-- NAME:begin --> and <!-- NAME:end --> into it")
    with replace_on_success(page) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return written


def list_pages(root: Path = ROOT) -> list[Path]:
    """List the README and all pages of the documentation."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


Row = dict[str, Any]


def write_table(heads: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """Write a table."""
    return "\n".join([write_line(heads), "|" + "---|" * len(heads), *map(write_line, lines)])


def write_line(cells: Sequence[object]) -> str:
    """Write a line of a table."""
    return f"| {' | '.join(map(str, cells))} |"


def write_mean(rows: Sequence[Row], key: str) -> str:
    """Write the mean of a value with its 95 % interval over places (`format_interval`)."""
    return format_interval(np.array([float(r.get(key, np.nan)) for r in rows]), np.array([r["place"] for r in rows]))


def compute_mean(rows: Sequence[Row], key: str) -> str:
    """Write the mean of a value alone."""
    return re.split(r"[, ]", write_mean(rows, key))[0]


def write_share(counts: Iterable[int]) -> str:
    """Write right ones of all: 0.95 (19 of 20)."""
    right, every = counts
    return f"{right / every:.2f} ({right} of {every})" if every else "none"


def write_medians(errors: Iterable[Any]) -> list[str]:
    """Write the median of each array of errors; – where nothing was compared."""
    return [f"{np.nanmedian(e):.2f}" if np.isfinite(e).any() else "–" for e in map(np.asarray, errors)]


def group_rows(rows: Iterable[Row], key: Callable[[Row], str]) -> dict[str, list[Row]]:
    """Group rows in the order in which they come."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


FIGURES = ROOT / "docs" / "results" / "headline.json"


def read_headline(path: Path = FIGURES) -> list[dict[str, Any]]:
    """Read the figures in the order of the README: name, group, what, result, of, page, stamp."""
    figures: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["figures"]
    return figures


def write_headline(path: Path, figures: Mapping[str, tuple[str, str]], stamp: Stamp) -> None:
    """Write results into the entries of these names, with the stamp; entries that the file does not have are left out."""
    entries = read_headline(path)
    for entry in entries:
        if entry["name"] in figures:
            entry["result"], entry["of"] = figures[entry["name"]]
            entry["stamp"] = stamp.write_comment()
    with replace_on_success(path) as temporary:
        temporary.write_text(json.dumps({"figures": entries}, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    if path.resolve() == FIGURES:
        write_readme()


def write_readme(readme: Path = ROOT / "README.md", path: Path = FIGURES) -> None:
    """Write the figures into the README, between the marks of `headline`."""
    begin, end = "<!-- headline:begin -->", "<!-- headline:end -->"
    before, rest = readme.read_text(encoding="utf-8").split(begin, 1)
    with replace_on_success(readme) as temporary:
        temporary.write_text(f"{before}{begin}\n\n{tabulate_headline(path)}\n\n{end}{rest.split(end, 1)[1]}", encoding="utf-8")


def tabulate_headline(path: Path = FIGURES) -> str:
    """Tabulate the figures by group, as they stand in the README; older ones are marked."""
    parts: dict[str, list[str]] = {}
    for entry in read_headline(path):
        stamp = OLD_STAMP.match(entry["stamp"])
        result = entry["result"] + (f" (commit {stamp['commit']})" if stamp else "")
        what = f"[{entry['what']}]({entry['page']})"
        parts.setdefault(entry["group"], []).append(f"| {what} | {result} | {entry['of']} |")
    return "\n\n".join("\n".join([f"| {group} | result | of |", "|---|---|---|", *lines]) for group, lines in parts.items())
