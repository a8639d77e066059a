"""Generated blocks of documents: written between their marks with what made them, and found again once that has changed.

A block stands between ``<!-- NAME:begin -->`` and ``<!-- NAME:end -->``. Its first line is a stamp, a comment that names the
command, a digest of the code and weights behind it (`code_digest`) and one of its inputs. `results_check` computes both digests
anew, which takes seconds and measures nothing. A block without a stamp, or with the commit that it was measured at instead,
is stale.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from topomerge.code_digest import code_digest
from topomerge.errors import InputError
from topomerge.io.atomic import replacing

ROOT = Path(__file__).parent.parent.parent
BLOCK = re.compile(r"<!-- ([\w-]+):begin -->\n(.*?)<!-- \1:end -->", re.DOTALL)
STAMP = re.compile(r"<!-- made by `(?P<command>[^`]+)`; code (?P<code>\w+) of (?P<modules>[\w., ]+); data (?P<data>\w+) -->")
OLD_STAMP = re.compile(r"<!-- measured at commit (?P<commit>\w+)[^>]*-->")
NO_INPUTS = "none"


@dataclass(frozen=True)
class Stamp:
    """What made a block.

    Args:
        command: that writes it.
        modules: whose code, and all that this imports and reads, decides what stands in it.
        code: digest of that.
        data: digest of the names of its inputs.
    """

    command: str
    modules: tuple[str, ...]
    code: str
    data: str

    def write_comment(self) -> str:
        """Write the stamp as the comment that `read_stamp` reads."""
        return f"<!-- made by `{self.command}`; code {self.code} of {', '.join(self.modules)}; data {self.data} -->"


def build_stamp(command: str, modules: Iterable[str], inputs: Iterable[str] = ()) -> Stamp:
    """Build the stamp of what this state of the code makes of these inputs."""
    names = tuple(modules)
    return Stamp(command, names, code_digest(*names), digest_inputs(inputs))


def digest_inputs(inputs: Iterable[str]) -> str:
    """Compute a short digest of the names of inputs, in any order."""
    names = sorted(inputs)
    return hashlib.sha256("\n".join(names).encode()).hexdigest()[:12] if names else NO_INPUTS


def read_stamp(text: str) -> Stamp | None:
    """Read the stamp in the first line of a block; None where there is none."""
    found = STAMP.match(text.lstrip())
    return found and Stamp(found["command"], tuple(found["modules"].split(", ")), found["code"], found["data"])


def write_blocks(page: Path, blocks: Mapping[str, str], stamp: Stamp) -> list[str]:
    """Write the blocks that a page has marks of; the names of these.

    Raises:
        InputError: the page has the marks of none of them.
    """
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    written = []
    for name, block in blocks.items():
        begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
        if begin in text and end in text:
            before, rest = text.split(begin, 1)
            text = f"{before}{begin}\n{stamp.write_comment()}\n\n{block.strip()}\n\n{end}{rest.split(end, 1)[1]}"
            written.append(name)
    if not written:
        raise InputError(f"{page}: has no marks of {', '.join(blocks)}; put <!-- NAME:begin --> and <!-- NAME:end --> into it")
    with replacing(page) as beside:
        beside.write_text(text, encoding="utf-8")
    return written


def list_pages(root: Path = ROOT) -> list[Path]:
    """List the README and all pages of the documentation."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
