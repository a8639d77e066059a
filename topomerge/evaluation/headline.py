"""Figures of the README: kept in one file with what made each, and written into the README from there only."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from topomerge.archive import replace_on_success
from topomerge.evaluation.documents import OLD_STAMP, ROOT, Stamp

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
