"""Exports of one process of tests share the table of ONNX functions, which torch builds anew, in 1.5 s, for each of them."""

from __future__ import annotations

import functools
import importlib
import sys

REGISTRATION = "torch.onnx._internal.exporter._registration"


def share_registry() -> None:
    """Build the table once from now on, where something was exported already; nothing writes to it."""
    registry = getattr(sys.modules.get(REGISTRATION), "ONNXRegistry", None)
    if registry is not None and not hasattr(registry, "is_shared"):
        registry.from_torchlib, registry.is_shared = staticmethod(functools.cache(registry.from_torchlib)), True


def build_registry() -> None:
    """Build it now, for forks of this process."""
    from topomerge.models.export import ONNX_OPSET

    importlib.import_module(REGISTRATION)
    share_registry()
    sys.modules[REGISTRATION].ONNXRegistry.from_torchlib(opset_version=ONNX_OPSET)
