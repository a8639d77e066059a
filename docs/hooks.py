"""MkDocs: what the program knows of itself is written into the pages.

docs/cli.md: the help of every command, where it says `<!-- commands -->`; docs/api.md: what the package offers and no line names.
"""

from __future__ import annotations

import argparse
import re
from typing import Any


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Complete the pages of the command line and of Python."""
    if page.file.src_uri == "cli.md":
        return markdown.replace("<!-- commands -->", commands())
    return markdown + others(markdown) if page.file.src_uri == "api.md" else markdown


def others(markdown: str) -> str:
    """Lines for mkdocstrings, of the public names that the page does not name yet."""
    from topomerge import _HOMES

    lines = [f"::: {home}.{name}" for name, home in _HOMES.items() if not re.search(rf"(?m)^::: .*\.{name}$", markdown)]
    lines = [line.replace("topomerge.models.", "models.").replace("topomerge.datasets.", "datasets.") for line in lines]
    return "\n## More\n\n" + "\n".join(lines) + "\n" if lines else ""


def commands() -> str:
    """Every command with its example and its help, as Markdown."""
    from topomerge.cli.main import COMMANDS, build_parser

    parser = build_parser()
    (sub,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    out = []
    for command in COMMANDS:
        one = sub.choices[command.name]
        one.formatter_class = _Wide
        told = one.format_help().partition("example:")[0].strip()
        out.append(f"### {command.name}\n\n{command.description or command.summary}\n\n```\n{command.example}\n```\n")
        out.append(f"```text\n{told}\n```\n")
    return "\n".join(out)


class _Wide(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=100, max_help_position=28)
