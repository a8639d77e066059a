"""MkDocs: what the parser knows of the commands is written into docs/cli.md where it says `<!-- commands -->`."""

from __future__ import annotations

import argparse
from typing import Any


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put the commands' help into the page of the command line."""
    if page.file.src_uri != "cli.md":
        return markdown
    return markdown.replace("<!-- commands -->", commands())


def commands() -> str:
    """Every command with its example and its help, as Markdown."""
    from topomerge.cli import build_parser
    from topomerge.commands import COMMANDS

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
