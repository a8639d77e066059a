"""XML that is whole, the same every time, and safe from odd file names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as xml

from topomerge.archive import replace_on_success

FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def replace_forbidden(value: str) -> str:
    """Return a text without the characters that XML cannot hold."""
    return FORBIDDEN.sub("\ufffd", value)


def write_xml(root: Any, path: Path) -> None:
    """Write a document, indented, in UTF-8.

    Raises:
        InputError: the path can't be written.
    """
    xml.indent(root)
    with replace_on_success(path) as temporary:
        xml.ElementTree(root).write(temporary, encoding="UTF-8", xml_declaration=True)
