"""What goes into a network and what comes out: one description for its export, its card and the check when it is loaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Dimension = int | str  # a number, or the name of what is counted


@dataclass(frozen=True)
class Tensor:
    """An input or an output of a network.

    Args:
        shape: numbers, and names of sizes that may differ from call to call.
        meaning: what it holds, with units.
        dtype: as NumPy names it.
    """

    shape: tuple[Dimension, ...]
    meaning: str
    dtype: str = "float32"

    def describe(self) -> dict[str, Any]:
        """As JSON has it."""
        return {"shape": list(self.shape), "dtype": self.dtype, "meaning": self.meaning}


@dataclass(frozen=True, eq=False)
class Signature:
    """A network as those who call it see it.

    Args:
        what: it does, in one sentence.
        inputs, outputs: by name, in the order of the network's arguments.
    """

    what: str
    inputs: Mapping[str, Tensor]
    outputs: Mapping[str, Tensor]

    def describe(self) -> dict[str, Any]:
        """As JSON has it: what a card begins with."""
        sides = {"inputs": self.inputs, "outputs": self.outputs}
        return {"what": self.what, **{side: {n: t.describe() for n, t in some.items()} for side, some in sides.items()}}
