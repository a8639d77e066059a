"""The sealed set: what no script of training, fitting, choosing or looking may read, and the one gate to it.

`splits/sealed.txt` lists seeds of procedural buildings, files of real data that nothing here was made or judged by, and buildings
of published sets that nobody here has. A line seals a building and all that lies below its name; one that begins with "-" takes
out a file that was looked at, whatever it ends in. Whatever reads plans, grids, published sets or makes procedural buildings asks
`refuse_building` or `refuse_file` first; both let pass what is asked within `open_sealed_set` only, which
`topomerge/evaluation/sealed.py` alone enters (a test reads the sources), once a release.

What is outside cannot be held: a person who opens a sealed file with a program of their own (``topomerge extract`` among them)
has looked at it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import resources
from pathlib import Path

from topomerge.errors import InputError

SEALED = "sealed"  # the split's name
SEALED_FOLDERS = {  # source -> folders of the real data
    "utexas": ("utexas_amrl_vectormaps",),
    "strands": ("grids_rose2_homes_strands",),
    "mall": ("plans_malls",),
}
_opened = 0  # runs of the sealed set that are under way in this process


@contextmanager
def open_sealed_set() -> Iterator[None]:
    """Open the sealed set: within, nothing is refused. For the sealed run alone; each of its processes enters by itself."""
    global _opened
    _opened += 1
    try:
        yield
    finally:
        _opened -= 1


@cache
def read_list(split: str) -> tuple[frozenset[str], frozenset[str], tuple[int, int]]:
    """Read buildings, whole sources and seeds of a split; an empty range where it has no seeds."""
    text = resources.files("topomerge.datasets.plans").joinpath("splits", f"{split}.txt").read_text(encoding="utf-8")
    lines = {line.strip() for line in text.splitlines()} - {""}
    lines = {line for line in lines if not line.startswith("#")}
    whole = {line.removesuffix("/*") for line in lines if line.endswith("/*")}
    ranges = [m for line in lines if (m := re.fullmatch(r"procedural/(\d+)\.\.(\d+)", line))]
    first, last = (int(ranges[0][1]), int(ranges[0][2])) if ranges else (0, -1)
    names = lines - {f"{w}/*" for w in whole} - {m[0] for m in ranges}
    return frozenset(names), frozenset(whole), (first, last)


def is_sealed(source: str, name: str) -> bool:
    """Return whether a building, or what its name lies below, is in the sealed list.

    Args:
        source: as of `splits`, or of `datasets.public`.
        name: of the building within its source; of a procedural one its seed.
    """
    names, whole, (first, last) = read_list(SEALED)
    if source == "procedural":
        return name.isdecimal() and first <= int(name) <= last
    parts = name.split("/")
    if any(f"-{source}/{file.removesuffix('_pgm')}" in names for file in (name, name.rpartition(".")[0])):
        return False
    return source in whole or any(f"{source}/{'/'.join(parts[:k])}" in names for k in range(1, len(parts) + 1))


def is_sealed_file(path: str | Path) -> bool:
    """Return whether a file or a folder holds sealed data, by the folder of the real data that it lies in."""
    parts = Path(path).absolute().parts
    for source, folders in SEALED_FOLDERS.items():
        for k in (k for k, part in enumerate(parts) if part in folders):
            below = "/".join(parts[k + 1 :])
            if is_sealed(source, below) or is_sealed(source, below.rpartition(".")[0]):
                return True
    return False


def refuse_building(source: str, name: str) -> None:
    """Let nobody but the sealed run at a building.

    Raises:
        InputError: it is sealed.
    """
    if not _opened and is_sealed(source, name):
        what = f"seed {name}" if source == "procedural" else f"{source}/{name}"
        raise InputError(f"sealed: {what} is kept for `make sealed`, once a release; take another one")


def refuse_file(path: str | Path) -> None:
    """Let nobody but the sealed run at a file.

    Raises:
        InputError: it is sealed.
    """
    if not _opened and is_sealed_file(path):
        raise InputError(f"sealed: {Path(path).name} is kept for `make sealed`, once a release; take another one")


def refuse_split(split: str) -> None:
    """Let nobody but the sealed run draw from the sealed list.

    Raises:
        InputError: the split is the sealed one.
    """
    if not _opened and split == SEALED:
        raise InputError("sealed: split 'sealed' is kept for `make sealed`, once a release; take train, validation or test")
