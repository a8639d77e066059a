"""Batches that are filled up to a few shapes mean the same, and steps as graphs do the same."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from topomerge.models.embedder import Embedder
from topomerge.models.losses import LossSettings, Objective

from tests.graphs import pair
from topomerge.embedding.network import Geometry, Network, Node, list_tensors
from topomerge.embedding.surroundings import CROP_SHAPES
from topomerge.training.captured_step import STEP_UP, BatchShape, CapturedStep, can_capture
from topomerge.training.descent import build_optimizer, set_rate
from topomerge.training.device_batches import DevicePairs
from topomerge.training.embedding import EmbeddingJob
from topomerge.training.loop import State
from topomerge.training.processes import start_fabric
from topomerge.training.settings import Augment, Training

NETWORK = Network(Geometry(["scalars", *CROP_SHAPES], width=8), Node("gat", 1, heads=2, around=10.0, ways=True, width=8), size=8)
KERNEL = """
import torch
from tests.graphs import pair
from tests.training.test_device_batches import NAMES
from topomerge.training.crop_kernel import sample_by_kernel
from topomerge.training.crop_sampling import sample_by_torch
from topomerge.training.device_batches import DevicePairs
from topomerge.training.settings import Augment
def compare(storeys, views, crops):
    expected = sample_by_torch(storeys, views, crops)
    few = crops.take(slice(0, 3))
    assert torch.equal(sample_by_kernel(storeys, views, few), expected[:3]) and expected.any()
    print("equal", crops.side, crops.step)
    return expected
for augment in (None, Augment()):
    device = DevicePairs([pair(1, 4)], NAMES, augment, torch.device("cpu"))
    device.sample = compare
    device.make_batch([0], int)
"""


def test_a_shape_holds_the_batch_and_padding_and_there_are_few():
    mean = BatchShape(500, 5000, 0)
    rng = np.random.default_rng(0)
    chosen = set()
    for rooms in rng.integers(400, 600, 200).tolist():
        shape = BatchShape(rooms, 10 * rooms, 0).pad_to_few(mean)
        assert shape.rooms > rooms and shape.edges >= 10 * rooms and shape.rooms < STEP_UP * rooms + 65
        chosen.add(shape)
    assert 3 < len(chosen) < 8


def test_padding_changes_neither_losses_nor_gradients():
    pairs = [pair(k, 5 + k) for k in range(4)]
    device = DevicePairs(pairs, list_tensors(NETWORK), Augment(), torch.device("cpu"))
    torch.manual_seed(0)
    objective = Objective(Embedder(NETWORK), LossSettings()).eval()  # in training padding counts in the statistics of norms
    plain = device.make_batch([3, 1], int)
    device.mean_shape = device.measure_mean(2)
    padded = device.make_batch([3, 1], int)
    assert len(padded.x) > len(plain.x) and padded.rooms == plain.rooms
    assert int(padded.edge_index.max()) == len(padded.x) - 1 and (padded["batch"][len(plain.x) :] == -1).all()
    gradients = []
    for batch in (plain, padded):
        objective.zero_grad()
        losses = objective(batch.tensors, batch.truth)
        losses["loss"].backward()
        gradients.append((losses, {name: w.grad.clone() for name, w in objective.named_parameters() if w.grad is not None}))
    (losses, grads), (padded_losses, padded_grads) = gradients
    assert all(torch.allclose(losses[name], padded_losses[name]) for name in losses)
    assert grads.keys() == padded_grads.keys()
    assert all(torch.allclose(grads[name], padded_grads[name], atol=1e-5) for name in grads)


def test_crops_of_doors_that_a_batch_lists_are_those_that_are_there():
    device = DevicePairs([pair(k, 6) for k in range(2)], list_tensors(NETWORK), Augment(), torch.device("cpu"))
    batch = device.make_batch([0, 1], int)
    torch.manual_seed(0)
    encoder = Embedder(NETWORK).geometry.parts["door_surroundings"].eval()
    crops = batch["door_surroundings"]
    assert torch.allclose(encoder(crops, batch["door_rows"], batch["door_slots"]), encoder(crops), atol=1e-6)


def test_a_rate_is_set_where_a_graph_reads_it():
    weight = torch.nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.SGD([weight], lr=1.0)
    set_rate(optimizer, 0.5)
    assert optimizer.param_groups[0]["lr"] == 0.5
    kept = optimizer.param_groups[0]["lr"] = torch.tensor(1.0)
    set_rate(optimizer, 0.25)
    assert optimizer.param_groups[0]["lr"] is kept and float(kept) == 0.25


def test_a_processor_takes_steps_as_they_are():
    settings = Training(network=NETWORK)
    assert not can_capture(settings, start_fabric(settings), build_optimizer(settings, Embedder(NETWORK), capturable=True))


@pytest.mark.longer
def test_the_kernel_samples_what_torch_does_to_the_bit():
    pytest.importorskip("triton")
    run = subprocess.run(
        [sys.executable, "-c", KERNEL], env={**os.environ, "TRITON_INTERPRET": "1"}, capture_output=True, text=True, timeout=600
    )
    assert run.returncode == 0, run.stderr
    assert sorted(run.stdout.split("\n"))[1:] == sorted(2 * ["equal 64 1", "equal 32 4", "equal 32 1"])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a card")
def test_steps_as_graphs_train_as_others_do():
    pairs, losses = [pair(k, 5 + k) for k in range(4)], {}
    for graphs in (False, True):
        settings = Training(network=NETWORK, batch=2, accelerator="cuda", precision="32-true", graphs=graphs, epochs=1)
        fabric = start_fabric(settings)
        torch.manual_seed(0)
        network = Embedder(NETWORK)
        job = EmbeddingJob(
            settings, fabric, network, build_optimizer(settings, network, fused=True, capturable=True), (pairs * 20, [])
        )
        assert isinstance(job.take_step, CapturedStep) == graphs
        state, losses[graphs] = State(), []
        for batch in job.iter_batches(State()):
            losses[graphs].append(float(job.train_step(batch, state)["loss"]))
            state.step += 1
    assert np.mean(losses[True][-10:]) < 0.9 * np.mean(losses[True][:10])
    assert abs(np.mean(losses[True][-10:]) - np.mean(losses[False][-10:])) < 0.2
