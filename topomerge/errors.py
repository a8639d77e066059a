"""Errors that are for people: one line that names the file, what is wrong with it and what to do."""

from __future__ import annotations

import errno


class InputError(ValueError):
    """A file or a value from the user that can't be used. The command line prints it as one line and exits with status 1."""


# What libraries say where memory is short, in their own kinds of errors.
MEMORY_WORDS = (
    *("allocate memory", "bad_alloc", "out of memory", "unable to allocate", "failed to map segment", "start new thread"),
)


def is_memory_short(error: BaseException | None) -> bool:
    """Return whether an error, or one that it comes from, says that there is not enough memory."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        message = str(error).lower()
        if isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM:
            return True
        if not isinstance(error, InputError) and any(phrase in message for phrase in MEMORY_WORDS):
            return True
        error = error.__cause__ or error.__context__
    return False


def make_printable(text: str) -> str:
    """Make a text from a stranger's file safe for a terminal, without what would steer it."""
    return "".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text)
