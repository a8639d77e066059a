"""HTML and SVG as text in which nothing from outside can become markup."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterable
from typing import Any

CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")  # no text on a page needs them, and names of files may hold them
VOID = frozenset(("br", "input", "meta", "col"))


class Markup(str):
    """Text that is markup already; any other string is escaped where it is put into an element."""

    __slots__ = ()


def _escaped(text: str) -> str:
    return html.escape(CONTROL.sub("\N{REPLACEMENT CHARACTER}", text))


def element(name: str, *content: str, **attributes: Any) -> Markup:
    """One element with its content.

    Args:
        name: its name.
        content: `Markup` as it is; other strings escaped.
        attributes: values are escaped. An underscore stands for a hyphen, one at the end is dropped (`class_`); None and
            False leave the attribute out, True gives it without a value.
    """
    words = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        key = key.rstrip("_").replace("_", "-")
        words.append(key if value is True else f'{key}="{_escaped(str(value))}"')
    inside = "".join(part if isinstance(part, Markup) else _escaped(part) for part in content)
    if name in VOID:
        return Markup(f"<{' '.join(words)}>")
    return Markup(f"<{' '.join(words)}>{inside}</{name}>")


def join(parts: Iterable[str], between: str = "") -> Markup:
    """Parts one after another; those that are no markup are escaped."""
    safe = [part if isinstance(part, Markup) else _escaped(part) for part in parts]
    return Markup(between.join(safe))


def json_data(value: Any, id: str) -> Markup:
    """A value for the page's script, in an element that is not run; it can't end that element before its time."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return element("script", Markup(text), type="application/json", id=id)
