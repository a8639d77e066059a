"""Steps with a compiled network (`compile=true`): `torch.compile` turns its operations into few kernels.

Only the steps call what is compiled. Scores and exported files come from the network itself, which keeps its weights under their
own names: resuming, moving averages, `init_from` and ONNX know nothing of it.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.util import find_spec
from typing import Any

import torch

from topomerge.errors import InputError
from topomerge.training.instruments import find_anomaly
from topomerge.training.processes import count_processes

COMPILERS = {"darwin": "clang++", "win32": "cl"}  # where it is not g++; as torch looks for them


def check_compilation(settings: Any) -> None:
    """Refuse to compile where nothing compiles, and where several processes train.

    Raises:
        InputError: names the key, and what is missing.
    """
    if count_processes(settings) > 1:
        raise InputError("compile=true is for one process; leave it out, or train with one")
    if getattr(settings, "accelerator", "cpu") != "cpu" and torch.cuda.is_available():
        if find_spec("triton") is None:
            raise InputError("compile=true needs Triton on a card (pip install triton); leave it out")
    elif shutil.which(name := os.environ.get("CXX") or COMPILERS.get(sys.platform, "g++")) is None:
        raise InputError(f"compile=true needs a compiler of C++, and {name} is not here; install it, or leave compile out")


class CompiledNetwork:
    """A network whose forward pass is compiled when it is first called, with its gradients."""

    def __init__(self, network: torch.nn.Module) -> None:
        self.network, self.forward = network, torch.compile(network.forward)

    @contextmanager
    def apply(self) -> Iterator[None]:
        """Let calls of the network be those of the compiled one for a while.

        Raises:
            InputError: it cannot be compiled.
        """
        vars(self.network)["forward"] = self.forward
        try:
            yield
        except RuntimeError as error:
            if not isinstance(error, torch._dynamo.exc.TorchDynamoException):
                raise
            reason = " ".join(str(error).split())[:160]
            raise InputError(f"compile=true: this network cannot be compiled here ({reason}); leave it out") from error
        finally:
            del vars(self.network)["forward"]


def choose_step_context(settings: Any, network: torch.nn.Module) -> Callable[[], AbstractContextManager[None]]:
    """Return what the steps of a training are taken within: compiled, or watched for anomalies, or neither."""
    if settings.anomaly:
        return find_anomaly
    return CompiledNetwork(network).apply if settings.compile else nullcontext
