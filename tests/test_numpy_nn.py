"""Layers in NumPy against those of torch and torch-geometric."""

from __future__ import annotations

import numpy as np
import pytest

from topomerge import numpy_nn
from topomerge.kernels.convolve import STRETCH
from topomerge.types import Array

RANDOM = np.random.default_rng(0)


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch")


def normal(*shape: int) -> Array:
    return RANDOM.standard_normal(shape)


def test_rows_one_by_one(torch):
    x, weight, bias = normal(7, 5), normal(5, 3), normal(3)
    tensors = [torch.from_numpy(array) for array in (x, weight.T.copy(), bias)]
    wanted = torch.nn.functional.linear(*tensors)
    assert np.allclose(numpy_nn.linear(x, weight, bias), wanted) and np.allclose(numpy_nn.linear(x, weight) + bias, wanted)
    for ours, theirs in (
        (numpy_nn.relu, torch.relu),
        (numpy_nn.leaky_relu, lambda t: torch.nn.functional.leaky_relu(t, 0.2)),
        (numpy_nn.sigmoid, torch.sigmoid),
        (numpy_nn.softmax, lambda t: t.softmax(dim=-1)),
    ):
        assert np.allclose(ours(x), theirs(tensors[0]))
    scale, shift = normal(5), normal(5)
    wanted = torch.nn.functional.layer_norm(tensors[0], (5,), torch.from_numpy(scale), torch.from_numpy(shift))
    assert np.allclose(numpy_nn.layer_norm(x, scale, shift), wanted)
    assert numpy_nn.softmax(np.array([[1e4, 0.0]])).tolist() == [[1.0, 0.0]]


def test_a_perceptron_is_rectified_between_its_layers_only(torch):
    layers = [(normal(4, 6), normal(6)), (normal(6, 6), normal(6)), (normal(6, 2), normal(2))]
    x = normal(9, 4)
    wanted = torch.from_numpy(x)
    for k, (weight, bias) in enumerate(layers):
        wanted = torch.nn.functional.linear(
            wanted.relu() if k else wanted, torch.from_numpy(weight.T.copy()), torch.from_numpy(bias)
        )
    out = numpy_nn.perceptron(x, layers)
    assert np.allclose(out, wanted) and (out < 0).any()


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("shape", [(3, 16, 8), (5, 2, 2), (1, 2, 60), (2, 3 * STRETCH, 4), (4, 3, 10, 6), (0, 3, 4, 4)])
@pytest.mark.parametrize("wide", [4, 7])  # the loop computes four channels at a time
def test_a_convolution(torch, stride, shape, wide):
    x, channels = normal(*shape).astype(np.float32), shape[-3]
    weight, bias = normal(9 * channels, wide).astype(np.float32), normal(wide).astype(np.float32)
    kernel = torch.from_numpy(weight.reshape(3, 3, channels, wide).transpose(3, 2, 0, 1).copy())
    wanted = torch.nn.functional.conv2d(torch.from_numpy(x), kernel, torch.from_numpy(bias), stride, 1).relu()
    out = numpy_nn.convolution(x, weight, bias, stride)
    assert out.dtype == np.float32 and out.shape == wanted.shape and np.allclose(out, wanted, atol=1e-5)


@pytest.mark.parametrize("stride", [1, 2])
def test_a_convolution_of_an_image_in_any_memory_order(stride):
    x, weight, bias = normal(6, 8, 3).astype(np.float32), normal(27, 4).astype(np.float32), normal(4).astype(np.float32)
    turned = np.rot90(np.moveaxis(x, -1, 0), 1, (1, 2))
    assert np.array_equal(
        numpy_nn.convolution(turned, weight, bias, stride), numpy_nn.convolution(turned.copy(), weight, bias, stride)
    )


def test_segments(torch):
    utils = pytest.importorskip("torch_geometric.utils")
    values, index, count = np.abs(normal(12, 3)), RANDOM.integers(0, 5, 12), 7  # nothing has index 5 or 6
    tensor, places = torch.from_numpy(values), torch.from_numpy(index)
    for ours, how in ((numpy_nn.segment_sum, "sum"), (numpy_nn.segment_mean, "mean"), (numpy_nn.segment_max, "max")):
        assert np.allclose(ours(values, index, count), utils.scatter(tensor, places, 0, count, how)), how
    scores = 100 * normal(12, 3)
    wanted = utils.softmax(torch.from_numpy(scores), places, num_nodes=count)
    assert np.allclose(numpy_nn.segment_softmax(scores, index, count), wanted)
    assert numpy_nn.segment_softmax(scores[:0], index[:0], count).shape == (0, 3)
