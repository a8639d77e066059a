"""Cases of a parametrized test that the longer suite tries: the quick one tries the same on those before them."""

from __future__ import annotations

from typing import Any

import pytest


def list_longer(*cases: Any) -> list[Any]:
    """List the cases, marked; a tuple holds the values of several parameters."""
    return [pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.longer) for case in cases]
