"""Noise of robots' grids: what stands where may change, what is true does not, and floor is never wall."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage

from tests.training.tiny import two_rooms
from topomerge.extraction.plans.plan_network import compute_evidence
from topomerge.training.grid_noise import (
    add_furniture,
    add_grid_noise,
    cut_share,
    dilate,
    draw_seat_rows,
    erode,
    pick_places,
    smooth_fields,
    warp,
)

EXAMPLE = two_rooms(10)
CROPS = 12
EVIDENCE = torch.from_numpy(compute_evidence(EXAMPLE.plan)).expand(CROPS, -1, -1, -1).clone()
ROOM = torch.from_numpy(EXAMPLE.room >= 0).expand(CROPS, -1, -1)
SQUARE = np.ones((3, 3))


def test_noise_leaves_evidence_of_a_grid() -> None:
    before = EVIDENCE.clone()
    out = add_grid_noise(EVIDENCE, ROOM, np.random.default_rng(1))
    known, wall = out[..., 0] > 0, out[..., 1] > 0
    assert torch.equal(EVIDENCE, before) and out.shape == EVIDENCE.shape and not (known & wall).any()
    assert (out[..., 2:6] == wall[..., None]).all() and (out[..., 6] == (known | wall)).all()
    assert (out[..., 10] == EVIDENCE[..., 10]).all()
    assert (known.sum((1, 2)) > 0.4 * (EVIDENCE[..., 0] > 0).sum((1, 2))).all()
    assert torch.equal(add_grid_noise(EVIDENCE, ROOM, np.random.default_rng(1)), out)
    assert not torch.equal(add_grid_noise(EVIDENCE, ROOM, np.random.default_rng(2)), out)


def test_it_changes_walls_and_floor_of_most_crops() -> None:
    out = add_grid_noise(EVIDENCE, ROOM, np.random.default_rng(0))
    assert sum(not torch.equal(a[..., 1], b[..., 1]) for a, b in zip(out, EVIDENCE, strict=True)) >= 8
    assert sum(not torch.equal(a[..., 0], b[..., 0]) for a, b in zip(out, EVIDENCE, strict=True)) >= 7


def test_masks_grow_and_shrink_as_scipy_has_it() -> None:
    masks = np.random.default_rng(0).random((3, 20, 17)) < [[[0.1]], [[0.8]], [[1.0]]]
    for mask, wide, one, six in zip(
        masks, dilate(torch.from_numpy(masks)), *(erode(torch.from_numpy(masks), k) for k in (1, 6)), strict=True
    ):
        assert (wide.numpy() == ndimage.binary_dilation(mask, SQUARE)).all()
        assert (one.numpy() == ndimage.binary_erosion(mask, SQUARE)).all()
        assert (six.numpy() == ndimage.binary_erosion(mask, SQUARE, 6)).all()


@pytest.mark.parametrize("sigma", [1.0, 2.5, 6.0])
def test_fields_are_smoothed_as_scipy_does(sigma: float) -> None:
    white = np.random.default_rng(0).standard_normal((2, 32, 48)).astype(np.float32)
    got = smooth_fields(torch.from_numpy(white), torch.full((2,), sigma)).numpy()
    for field, noise in zip(got, white, strict=True):
        expected = ndimage.gaussian_filter(noise, sigma, mode="wrap", truncate=6.0)
        assert np.abs(field - expected / expected.std()).max() < 0.02  # of 1: the Gaussian is sampled there


def test_patches_cover_the_share_that_is_asked_for() -> None:
    fields = torch.rand(2, 32, 32, generator=torch.Generator().manual_seed(0))
    assert (cut_share(fields, torch.tensor([0.1, 0.5])).float().mean((1, 2)) - torch.tensor([0.1, 0.5])).abs().max() < 0.002


def test_columns_come_from_where_they_are_moved_to_and_places_lie_in_their_mask() -> None:
    mask = torch.rand(2, 9, 7, generator=torch.Generator().manual_seed(0)) < 0.3
    down = torch.zeros(2, 9, 7)
    assert torch.equal(warp(mask, down + 1.2, down), mask[:, [1, 2, 3, 4, 5, 6, 7, 8, 8]])
    assert torch.equal(warp(mask, down, down - 20), mask[:, :, :1].expand(-1, -1, 7))
    i, j = pick_places(mask, torch.tensor([[0.0, 0.5, 1.0]]).expand(2, -1))
    assert mask[torch.arange(2)[:, None], i, j].all()
    assert [i[0, 0].item(), j[0, 0].item()] == mask[0].nonzero()[0].tolist()
    assert [i[1, 2].item(), j[1, 2].item()] == mask[1].nonzero()[-1].tolist()


def test_furniture_stands_in_rooms_full_hollow_or_unseen() -> None:
    inside = torch.ones(3, 12, 12, dtype=torch.bool)
    room = inside.clone()
    room[:, :, 9:] = False
    boxes = torch.tensor([[[0.55, 5.0, 4.0, kind, 1.0], [0.5, 9.0, 9.0, 0.0, 0.0]] for kind in range(3)])
    floor, wall = add_furniture(inside, ~inside, room, boxes)
    assert (~floor).sum((1, 2)).tolist() == [20, 20, 20] and wall.sum((1, 2)).tolist() == [20, 14, 0]
    assert not (wall & ~room).any() and not (wall & floor).any()
    none = torch.zeros_like(inside)
    assert not add_furniture(none, none, none, boxes)[1].any()


def test_rows_of_seats_stand_on_large_floors_only() -> None:
    floor = torch.ones(2, 30, 30, dtype=torch.bool)
    floor[1, ::6] = False
    seats = [torch.full((2, 1, 1), value) for value in (0.5, 0.0, 9.0, 9.0, 6.0, 2.0, 5.0, float("inf"))]
    rows = draw_seat_rows(floor, seats)
    assert not rows[1].any() and 6 <= rows[0].any(dim=1).sum() <= 7  # two columns of each six, whole
    assert rows[0].any(dim=0).nonzero()[:, 0].tolist() == list(range(15))  # less than 9 from their middle, which is (15, 6)
