"""Batches of plans, walls and places that are gathered out of packed tables: each as a slow twin cuts it, the same again for the
same numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from topomerge.datasets.pairs.wall_examples import WallExample

from tests.training import tiny
from topomerge.extraction.elevations.elevation import BANDS, DEPTHS, STRIP_CHANNELS
from topomerge.registration.places import PLANES, SIDE, UPPER_PLANES
from topomerge.training.loop import State
from topomerge.training.place_evidence import PlaceJob, Places, augment_planes
from topomerge.training.plan_segmentation import OUTSIDE, PackedPlans, build_plan_tensors
from topomerge.training.scan_settings import PlanAugment, PlanLoss, WallAugment, WallSegmentation
from topomerge.training.task_settings import PlaceAugment, PlaceEvidence
from topomerge.training.wall_segmentation import PackedWalls
from topomerge.types import Array

CPU = torch.device("cpu")
PLANS = [build_plan_tensors(tiny.two_rooms(wider), PlanLoss()) for wider in (0, 6)]
CROP = 64
ALIKE = PlanAugment(upper=0.0, columns=0.0)


def cut_crop(number: int, place: int, off: Sequence[int], turn: int, mirror: bool) -> list[Array]:
    """The crop of a plan, cut, padded, turned and mirrored one after the other."""
    x, truth, weight = PLANS[number]
    inside = np.argwhere(x[..., 0] > 0)
    i, j = inside[place] - off + CROP
    around = [(CROP, CROP)] * 2
    wide = np.pad(x, [*around, (0, 0)]), np.pad(truth, around, constant_values=OUTSIDE), np.pad(weight, around)
    return [np.rot90(array[i : i + CROP, j : j + CROP], turn)[:: -1 if mirror else 1] for array in wide]


def test_crops_are_those_that_are_cut_one_by_one() -> None:
    plans = np.array([0, 1] * 12)
    x, truth, weight = PackedPlans(PLANS, CROP, ALIKE, CPU).sample_crops(plans, np.random.default_rng(3))
    rng, count = np.random.default_rng(3), len(plans)  # draws the same numbers
    places = (rng.random(count) * [(PLANS[k][0][..., 0] > 0).sum() for k in plans]).astype(int)
    offsets, turns = rng.integers(CROP // 4, 3 * CROP // 4, (2, count)).T, rng.integers(4, size=count)
    mirrors = rng.random(count) < 0.5
    assert len({*zip(turns.tolist(), mirrors.tolist(), strict=True)}) == 8
    for k, given in enumerate(zip(plans, places, offsets, turns, mirrors, strict=True)):
        expected = cut_crop(*given)
        for got, want in zip((x[k].permute(1, 2, 0), truth[k], weight[k]), expected, strict=True):
            assert (got.numpy() == want).all()


def test_crops_are_the_same_for_the_same_numbers_and_lose_what_they_are_to_lose() -> None:
    packed = PackedPlans(PLANS, CROP, PlanAugment(upper=0.5, columns=0.5, lost=0.6, grid_noise=0.5), CPU)
    plans = np.zeros(32, int)
    batches = [packed.sample_crops(plans, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert all(torch.equal(a, b) for a, b in zip(*batches[:2], strict=True)) and not torch.equal(batches[0][0], batches[2][0])
    packed.augment = PlanAugment(upper=0.0, columns=0.5, lost=0.6)
    whole, lossy = PackedPlans(PLANS, CROP, ALIKE, CPU), packed
    x, y = (of.sample_crops(plans, np.random.default_rng(1))[0] for of in (whole, lossy))
    assert torch.equal(x[:, [0, 10]], y[:, [0, 10]])
    share = 1 - y[:, 1:10].sum((1, 2, 3)) / x[:, 1:10].sum((1, 2, 3))
    assert 8 <= (share > 0).sum() <= 24 and share.max() < 0.65 and share[share > 0].std() > 0.05
    packed.augment = PlanAugment(upper=1.0, columns=0.0)
    lost = (packed.sample_crops(plans, np.random.default_rng(1))[0] == 0).all(dim=(2, 3))
    assert (lost[:, 5] != lost[:, 6]).all() and 3 <= lost[:, 6].sum() <= 16


def make_walls() -> list[WallExample]:
    """Scans with walls of 60 and 100 places, whose strips tell where they are from."""
    out = []
    for k in range(2):
        truth = np.repeat([0, 1, 0, 2], 40).astype(np.uint8)
        strips = np.zeros((160, DEPTHS, STRIP_CHANNELS), np.uint8)
        strips[..., 0], strips[..., 1], strips[..., 16] = np.arange(160)[:, None], np.arange(DEPTHS), 1 + k
        strips[20:24] = 0
        out.append(WallExample(np.array([0, 60, 160]), strips, truth, np.zeros((0, 3)), None, (), None, ""))
    return out


PLAIN = WallAugment(shift=0, sparse=0.0, hidden=0.0, walk=0.0, rays=0.0)


def test_stretches_lie_in_one_wall_with_their_truth() -> None:
    scans, options = make_walls(), WallSegmentation(length=96, augment=PLAIN)
    x, truth, weight = PackedWalls(scans, options, CPU).sample_stretches(40, np.random.default_rng(0))
    strips, mirrored = (255 * x.permute(0, 2, 3, 1)).round().to(torch.uint8).numpy(), 0
    for strip, right, w in zip(strips, truth.numpy(), weight.numpy(), strict=True):
        present = np.flatnonzero(strip[..., 16].any(axis=1))
        scan = scans[int(strip[present[0], 0, 16]) - 1]
        at = strip[present, 0, 0].astype(int)
        if back := at[-1] < at[0]:
            strip, right, w, at = strip[::-1], right[::-1], w[::-1], at[::-1]
        low, high = (0, 60) if at[0] < 60 else (60, 160)
        start = int(at[0] - np.flatnonzero(strip[..., 16].any(axis=1))[0])
        stop = min(start + 96, high)
        assert start % 2 == 0 and low <= start and at[-1] < high
        assert (strip[: stop - start] == scan.strips[start:stop]).all() and not strip[stop - start :].any()
        count = (stop - start) // 2
        assert (right[:count] == scan.truth[start:stop:2]).all()
        seen = scan.strips[start:stop].any(axis=(1, 2)).reshape(-1, 2).any(axis=1)
        expected = np.array(options.classes)[right[:count]] * np.where(seen, 1.0, options.unseen)
        assert np.allclose(w[:count], expected) and not w[count:].any()
        mirrored += back
    assert 8 < mirrored < 32


def test_stretches_are_changed_as_asked_for_and_the_same_for_the_same_numbers() -> None:
    scans = make_walls()
    for scan in scans:
        scan.strips[:] = 255

    def sample(seed: int = 0, **changes: float) -> torch.Tensor:
        options = WallSegmentation(length=32, augment=WallAugment(**{**vars(PLAIN), **changes}))
        return PackedWalls(scans, options, CPU).sample_stretches(64, np.random.default_rng(seed))[0]

    assert torch.equal(sample(sparse=0.5, hidden=0.5, shift=2), sample(sparse=0.5, hidden=0.5, shift=2))
    assert not torch.equal(sample(sparse=0.5), sample(1, sparse=0.5)) and (sample() == 1).all()
    share = 1 - sample(sparse=0.5, lost=0.6).mean(dim=(1, 2, 3))
    assert 20 <= (share > 0).sum() <= 44 and share.max() <= 0.62 and share[share > 0].std() > 0.1
    hidden = sample(hidden=1.0) == 0
    assert hidden[:, 0].all(dim=2).any(dim=1).all() and not hidden[:, BANDS - 1 :].any()
    size = hidden[:, 0, :, 0].sum(dim=1)
    assert (hidden == hidden[..., :1]).all() and size.max() <= 15 and 4 <= size.median() <= 12
    assert not sample(walk=1.0)[:, BANDS].any() and sample(walk=1.0)[:, BANDS + 1 :].all()
    assert not sample(rays=1.0)[:, BANDS + 1 :].any() and sample(rays=1.0)[:, : BANDS + 1].all()


def test_a_face_is_moved_nearer_or_farther_as_a_whole() -> None:
    options = WallSegmentation(length=32, augment=WallAugment(**{**vars(PLAIN), "shift": 2}))
    x = PackedWalls(make_walls(), options, CPU).sample_stretches(32, np.random.default_rng(0))[0]
    depths = (255 * x[:, 1]).round().long()
    seen = depths.any(dim=2)
    moves = {tuple(row.tolist()) for row in depths[seen]}
    assert moves == {tuple(np.roll(np.arange(DEPTHS), shift).tolist()) for shift in range(-2, 3)}


@pytest.mark.parametrize("seed", range(4))
def test_squares_are_turned_mirrored_and_weighed(seed: int) -> None:
    x = np.random.default_rng(9).random((6, SIDE, SIDE, PLANES)).astype(np.float32)
    got = augment_planes(torch.from_numpy(x), PlaceAugment(upper=0.5, noise=0.1), np.random.default_rng(seed))
    rng = np.random.default_rng(seed)  # draws the same numbers
    expected = np.rot90(x, int(rng.integers(4)), axes=(1, 2))
    expected = np.array(expected[:, ::-1] if rng.random() < 0.5 else expected)
    blind = rng.random(6) < 0.5
    for plane in UPPER_PLANES:
        expected[blind, :, :, plane] = 0
    expected *= rng.normal(1.0, 0.1, (6, 1, 1, PLANES))
    assert np.allclose(got.numpy(), expected, rtol=1e-5) and blind.any()


def test_a_step_of_places_depends_on_nothing_drawn_before() -> None:
    """What drops out was drawn from where the process was: a resumed run went another way."""
    rng = np.random.default_rng(0)
    planes, right = rng.random((8, SIDE, SIDE, PLANES)).astype(np.float16), np.arange(8) % 2 > 0
    places = Places(planes, right, np.ones(8), np.zeros(8, int), ["b"])
    losses = []
    for before in (0, 3):
        torch.manual_seed(0)
        job = PlaceJob(PlaceEvidence(widths=[4, 4, 8], dropout=0.5, batch=8), places, places)
        torch.rand(before)
        losses.append(job.train_step(next(job.iter_batches(State(1, 2))), State(1, 2))["loss"])
    assert losses[0] == losses[1]
