"""Small scorers in NumPy against torch."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge import numpy_nn
from topomerge.types import Array

RANDOM = np.random.default_rng(0)


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch")


def normal(*shape: int) -> Array:
    return RANDOM.standard_normal(shape)


def test_probabilities(torch):
    x = normal(7, 5)
    for ours, theirs in ((numpy_nn.sigmoid, torch.sigmoid), (numpy_nn.softmax, lambda t: t.softmax(dim=-1))):
        assert np.allclose(ours(x), theirs(torch.from_numpy(x)))
    assert numpy_nn.softmax(np.array([[1e4, 0.0]])).tolist() == [[1.0, 0.0]]


def test_a_perceptron_is_rectified_between_its_layers_only(torch):
    layers = [(normal(4, 6), normal(6)), (normal(6, 6), normal(6)), (normal(6, 2), normal(2))]
    x = normal(9, 4)
    requested = torch.from_numpy(x)
    for k, (weight, bias) in enumerate(layers):
        requested = torch.nn.functional.linear(
            requested.relu() if k else requested, torch.from_numpy(weight.T.copy()), torch.from_numpy(bias)
        )
    out = numpy_nn.apply_mlp(x, layers)
    assert np.allclose(out, requested) and (out < 0).any()
