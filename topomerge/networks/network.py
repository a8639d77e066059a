"""Load a network and run it: one thread, the same numbers every time, not a word on the terminal.

A file `NAME.onnx` stands beside its card `NAME.card.json`: what it does, its inputs and outputs with shapes and units, by which
command and from what it was trained, and the digest of the file. A graph of ONNX is data: nothing in it is Python, and operators
that ONNX Runtime does not bring along are refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from topomerge.archive import convert_to_plain, find_weights_file, replace_on_success
from topomerge.errors import InputError, is_memory_short
from topomerge.types import Array

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
        """Describe it as JSON has it."""
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
        """Describe it as JSON has it: what a card begins with."""
        sides = {"inputs": self.inputs, "outputs": self.outputs}
        return {"what": self.what, **{side: {n: t.describe() for n, t in some.items()} for side, some in sides.items()}}


WEIGHTS_PACKAGE = "topomerge.networks"  # where the files ship
CARD = ".card.json"
LARGEST_FILE = 1 << 28  # bytes; an embedder has 3 MB
QUIET = 4  # of ONNX Runtime's levels: what fails is raised, nothing is printed
DTYPES = {"float32": "tensor(float)", "uint8": "tensor(uint8)", "int64": "tensor(int64)"}


class Run(Protocol):
    """Run a network on arrays by name; the outputs, all of them or those that are named."""

    def __call__(self, outputs: Sequence[str] | None = None, /, **inputs: Array) -> list[Array]:
        """Compute the outputs."""
        ...


class Network:
    """A network that ONNX Runtime runs: a `Run`.

    Args:
        card: what is known of it.
    """

    def __init__(self, session: Any, signature: Signature, path: Path, card: Mapping[str, Any]) -> None:
        self.session, self.signature, self.path, self.card = session, signature, path, card

    def __reduce__(self) -> tuple[Any, ...]:
        """Send it to another process as its file, which is opened there."""
        return open_network, (self.path, str(self.card.get("sha256")), self.signature, self.card)

    def __call__(self, outputs: Sequence[str] | None = None, /, **inputs: Array) -> list[Array]:
        """Compute the outputs; of those that are not named, only what the others need.

        Raises:
            InputError: the graph does not compute what it should.
            MemoryError: there is not enough memory.
        """
        import onnxruntime

        feeds = {n: np.ascontiguousarray(inputs[n], dtype=tensor.dtype) for n, tensor in self.signature.inputs.items()}
        options = onnxruntime.RunOptions()
        options.log_severity_level = QUIET
        options.only_execute_path_to_fetches = outputs is not None
        try:
            computed: list[Array] = self.session.run(None if outputs is None else list(outputs), feeds, options)
        except Exception as error:  # ONNX Runtime has a dozen kinds
            raise _failure(self.path, "can't be run", error) from error
        return computed


@lru_cache(maxsize=16)
def load_network(path: Path, signature: Signature) -> Network:
    """Load a network with its card; once for each file.

    Raises:
        InputError: no such file, no card, damaged, or with other inputs or outputs than expected.
    """
    card = read_card(path)
    return open_network(path, str(card.get("sha256")), signature, card)


def load_shipped_network(name: str, signature: Signature) -> Network:
    """Load a network that ships, or the one in its place (`archive.find_weights_file`)."""
    return load_network(find_weights_file(WEIGHTS_PACKAGE, name), signature)


def card_of(path: Path) -> Path:
    """Return the card beside a file of weights."""
    return path.with_name(f"{path.stem}{CARD}")


def read_card(path: Path) -> dict[str, Any]:
    """Read the card of a file of weights.

    Raises:
        InputError: there is none, or it is damaged.
    """
    card = card_of(path)
    try:
        values = json.loads(card.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{card}: {error.strerror or error}; copy a network together with its card") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{card}: damaged or cut off ({' '.join(str(error).split())[:80]}); copy both files again") from error
    if not isinstance(values, dict):
        raise InputError(f"{card}: is no card of a network; copy both files again")
    return values


def write_card(path: Path, values: Mapping[str, Any]) -> Path:
    """Write the card of a file of weights beside it, with its digest; the same values give the same bytes."""
    card = card_of(path)
    known = {"file": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    with replace_on_success(card) as temporary:
        temporary.write_text(json.dumps(convert_to_plain({**values, **known}), indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return card


def open_network(path: Path, digest: str, signature: Signature, card: Mapping[str, Any]) -> Network:
    """Open a network whose digest is known.

    Args:
        digest: SHA-256 of the file.

    Raises:
        InputError: no such file, another one, damaged, or with other inputs or outputs than expected.
    """
    import onnxruntime

    onnxruntime.set_default_logger_severity(QUIET)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # what runs beside it has the other cores
    options.log_severity_level = QUIET
    options.enable_cpu_mem_arena = False  # it would keep the memory of the largest plan for good
    options.use_deterministic_compute = True
    try:
        session = onnxruntime.InferenceSession(read_checked_bytes(path, digest), options, providers=["CPUExecutionProvider"])
    except InputError:
        raise
    except Exception as error:  # ONNX Runtime has a dozen kinds
        raise _failure(path, "is no network that can be run", error) from error
    for kind, expected, present in (
        ("input", signature.inputs, session.get_inputs()),
        ("output", signature.outputs, session.get_outputs()),
    ):
        found = {value.name: (value.type, value.shape) for value in present}
        for name in sorted({*expected, *found}):
            tensor = expected.get(name)
            if tensor is None or name not in found or not _fits(tensor.shape, DTYPES[tensor.dtype], *found[name]):
                requested = f"{tensor.dtype} {list(tensor.shape)}" if tensor else "none"
                has = " ".join(map(str, found[name])) if name in found else "none"
                raise InputError(f"{path}: is of other {kind}s: {name[:40]} is {has[:80]}, not {requested}; export it again")
    return Network(session, signature, path, card)


def read_checked_bytes(path: Path, digest: str) -> bytes:
    """Read the bytes of a file, if they are those of its card.

    Raises:
        InputError: no such file, cut off, damaged, or another one.
    """
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{path}: has more than {LARGEST_FILE >> 20} MB, no network is as large; copy both files again")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}; copy a network together with its card") from error
    if hashlib.sha256(data).hexdigest() != digest:
        raise InputError(f"{path}: cut off, damaged, or not the network that its card is about; copy both files again")
    return data


def _fits(shape: Sequence[int | str], dtype: str, type_found: str, shape_found: Sequence[Any]) -> bool:
    """Return whether a tensor is of the type, and of the shape wherever both name a number."""
    pairs = zip(shape, shape_found, strict=False)
    numbers = all(a == b for a, b in pairs if isinstance(a, int) and isinstance(b, int))
    return type_found == dtype and len(shape) == len(shape_found) and numbers


def _failure(path: Path, what: str, error: Exception) -> Exception:
    """Return the error to raise for one of ONNX Runtime's."""
    reason = " ".join(str(error).split())[:160]
    if is_memory_short(error):
        return MemoryError(f"{path}: {reason}")
    return InputError(f"{path}: {what} ({reason}); export it again, or install topomerge again")
