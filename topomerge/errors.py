"""Errors that are for people: one line that names the file, what is wrong with it and what to do."""

from __future__ import annotations


class InputError(ValueError):
    """A file or a value from the user that can't be used. The command line prints it as one line and exits with status 1."""


def printable(text: str) -> str:
    """A text that may come from a stranger's file, without what would steer a terminal."""
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)
