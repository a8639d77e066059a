"""What a command of the command line is made of."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Argument = tuple[tuple[str, ...], dict[str, Any]]


@dataclass(frozen=True)
class Command:
    """One command: its function, its words for the help and its arguments.

    `run` takes the parsed arguments and returns the exit status; `paths` are the arguments that name files, the input first:
    an error that names no file is reported under the first of them. `one_input` is said of words too many.
    """

    name: str
    run: Callable[[argparse.Namespace], int]
    summary: str
    example: str
    arguments: tuple[Argument, ...]
    paths: tuple[str, ...] = ()
    description: str = ""
    one_input: str = ""


def option(*flags: str, **settings: Any) -> Argument:
    """One argument, as argparse's `add_argument` takes it.

    An option without `default` is absent from the namespace unless it was given: its default has one home, the function
    that takes it (see `topomerge.cli.options.given`).
    """
    if flags[0].startswith("-"):
        settings.setdefault("default", argparse.SUPPRESS)
    return flags, settings
