"""The examples in the README and in docs/: fenced blocks marked `python` or `console`, in the order of the page.

A comment in the line before a block says what is special about it: `<!-- not run: why -->`, `<!-- status: 2 -->` for the exit
status that its last command must have.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
NOTE = r"(?:<!-- (?P<note>[^>]*) -->\n)?"
BLOCK = re.compile(rf"(?ms)^{NOTE}(?P<indent> *)```(?P<kind>\w+)\n(?P<text>.*?)^(?P=indent)```$")


@dataclass(frozen=True)
class Example:
    """A block of a page."""

    kind: str
    text: str
    line: int
    status: int = 0
    skipped: str = ""


def pages() -> list[Path]:
    """The README and every page that has an example."""
    return [p for p in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))) if examples(p)]


def examples(page: Path) -> list[Example]:
    """The blocks of a page that are Python or commands."""
    text, found = page.read_text(encoding="utf-8"), []
    for match in BLOCK.finditer(text):
        note = match["note"] or ""
        if match["kind"] not in ("python", "console"):
            continue
        status = int(note.partition(":")[2]) if note.startswith("status:") else 0
        skipped = note.partition(":")[2].strip() if note.startswith("not run:") else ""
        lines = [line[len(match["indent"]) :] for line in match["text"].splitlines()]
        found.append(Example(match["kind"], "\n".join(lines), text.count("\n", 0, match.start("text")) + 1, status, skipped))
    return found


def commands(example: Example) -> list[str]:
    """What is typed behind the prompts of a console block."""
    return [line[2:] for line in example.text.splitlines() if line.startswith("$ ")]
