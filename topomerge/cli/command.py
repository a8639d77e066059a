"""What a command of the command line is made of."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Argument = tuple[tuple[str, ...], dict[str, Any]]


@dataclass(frozen=True)
class Command:
    """One command: its function, its words for the help and its arguments."""

    name: str
    run: Callable[[argparse.Namespace], int]
    summary: str
    example: str
    arguments: tuple[Argument, ...]
    paths: tuple[str, ...] = ()  # arguments that name files, the input first: errors are told under its name
    description: str = ""


def option(*flags: str, **settings: Any) -> Argument:
    """One argument, as argparse's `add_argument` takes it.

    An option without `default` is absent from the namespace unless it was given: its default has one home, the function
    that takes it.
    """
    if flags[0].startswith("-"):
        settings.setdefault("default", argparse.SUPPRESS)
    return flags, settings


def output(metavar: str, help: str) -> Argument:
    """Where to write what a command is for."""
    return option("-o", "--output", required=True, metavar=metavar, default=None, help=help)


def quiet(help: str = "print nothing") -> Argument:
    """That nobody watches."""
    return option("-q", "--quiet", action="store_true", default=False, help=help)


def count(text: str) -> int:
    """A whole number from 0 on, as the `type` of an argument."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number, not {text!r}")
    return int(text)
