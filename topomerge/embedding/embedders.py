"""Embedders by name: what `match`, `merge` and the command line take."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

from topomerge.embedding.context import with_context
from topomerge.embedding.engineered import engineered
from topomerge.embedding.feather import feather
from topomerge.embedding.learned import load_embedder
from topomerge.embedding.room_cells import Descriptor
from topomerge.embedding.shapedna import shapedna
from topomerge.errors import InputError


def learned(path: str | None = None) -> Descriptor:
    """The trained embedder in a folder (see `topomerge.load_embedder`), or the one that ships with the package."""
    return load_embedder(path)


EMBEDDERS: dict[str, Callable[..., Descriptor]] = {
    "learned": learned,
    "engineered": engineered,
    "shapedna": shapedna,
    "feather": feather,
}
DEFAULT = "learned"


def descriptor_name(name: str | Descriptor) -> str:
    """What a report says of a descriptor: its name, or that of a callable."""
    return name if isinstance(name, str) else getattr(name, "__name__", type(name).__name__)


def embedder(name: str | Descriptor = DEFAULT, k: int = 0, context: str = "join", **options: Any) -> Descriptor:
    """A callable map -> (R, D) float64.

    Args:
        name: ``"learned"``, ``"engineered"``, ``"shapedna"``, ``"feather"``, the folder of a trained one, or a descriptor.
        k: steps of context (see `with_context`).
        context: ``"join"`` or ``"mean"``.
        options: those of the function of that name.

    Raises:
        InputError: unknown name or option.
    """
    if callable(name):
        if options:
            raise InputError(f"options {', '.join(options)} are for embedders that are named, not for a callable")
        return with_context(name, k, context)
    if name and name not in EMBEDDERS and Path(name).is_dir():
        return embedder("learned", k, context, path=name, **options)
    if name not in EMBEDDERS:
        raise InputError(f"unknown descriptor {name!r}: {', '.join(EMBEDDERS)} or the folder of a trained one are possible")
    make = EMBEDDERS[name]
    unknown = set(options) - set(inspect.signature(make).parameters)
    if unknown:
        raise InputError(f"{name} has no option {', '.join(sorted(unknown))}: {', '.join(inspect.signature(make).parameters)}")
    return with_context(make(**options), k, context)
