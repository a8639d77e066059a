"""Losses against examples reckoned by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from topomerge.models.embedder import Embedder
from topomerge.models.losses import (
    LossSettings,
    Objective,
    Truth,
    check,
    compute_dustbin_loss,
    compute_info_nce,
    compute_matching_loss,
    compute_triplet_loss,
)

from tests.graphs import graph
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.embedding.surroundings import CROP_SHAPES
from topomerge.errors import InputError

E = math.exp


def truth(matches, pair, side, true=None) -> Truth:
    """Rooms that are all clear."""
    n = len(pair)
    same = torch.zeros((n, n), dtype=torch.bool)
    for i, j in matches:
        same[i, j] = same[j, i] = True
    map, true = 2 * torch.tensor(pair) + torch.tensor(side), torch.tensor(true if true else range(n))
    piece = (map[:, None] == map[None]) & (true[:, None] == true[None]) & ~torch.eye(n, dtype=torch.bool)
    return Truth(torch.tensor(pair), torch.tensor(side), same, piece, torch.ones(n, dtype=torch.bool), torch.tensor(pair))


FLAT = torch.tensor([[1.0, 0], [0, 1], [1, 0], [0, 1]])  # a: rooms 0 and 1, b: rooms 2 and 3, 0 looks like 2
ONE = truth([(0, 2)], [0, 0, 0, 0], [0, 0, 1, 1])


def test_info_nce_with_negatives_of_both_maps():
    loss, has = compute_info_nce(FLAT, torch.tensor(1.0), ONE)
    assert has.tolist() == [True, False, True, False]
    # Room 0: its partner has cosine 1, room 1 of its own map and room 3 of the other have 0.
    assert loss.tolist() == pytest.approx([math.log((E(1) + 2) / E(1)), 0, math.log((E(1) + 2) / E(1)), 0])


def test_a_room_in_two_pieces():
    """Both pieces are partners, and no negatives of each other."""
    embedding = torch.tensor([[1.0, 0], [1, 0], [0, 1]])  # a: room 0; b: its pieces 1 and 2
    loss, has = compute_info_nce(embedding, torch.tensor(1.0), truth([(0, 1), (0, 2)], [0, 0, 0], [0, 1, 1], [0, 5, 5]))
    assert has.all() and loss.tolist() == pytest.approx([0, 0, 0], abs=1e-6)


def test_easy_negatives_count_less():
    embedding = torch.tensor([[1.0, 0], [1, 0], [0, 1]])
    other = truth([(0, 1)], [0, 0, 1], [0, 1, 0])
    for easy in (0.0, 0.3, 1.0):
        loss, _ = compute_info_nce(embedding, torch.tensor(0.5), other, easy)
        assert loss[0].item() == pytest.approx(math.log((E(2) + easy * E(0)) / E(2)), abs=1e-6)


def test_rooms_of_two_pairs_of_one_building_are_no_negatives():
    """Room 2 looks like room 0 and may be it; room 3 is of another building."""
    embedding = torch.tensor([[1.0, 0], [1, 0], [1, 0], [0, 1]])
    other = truth([(0, 1)], [0, 0, 1, 2], [0, 1, 0, 0])
    one_building = replace(other, building=torch.tensor([7, 7, 7, 8]))
    apart, _ = compute_info_nce(embedding, torch.tensor(1.0), other, 0.5)
    together, _ = compute_info_nce(embedding, torch.tensor(1.0), one_building, 0.5)
    assert apart[0].item() == pytest.approx(math.log((E(1) + 0.5 * E(1) + 0.5) / E(1)), abs=1e-6)
    assert together[0].item() == pytest.approx(math.log((E(1) + 0.5) / E(1)), abs=1e-6)


class _Recorded:
    """One of two processes, whose other one has these rows."""

    def __init__(self, embedding: torch.Tensor, building: torch.Tensor, mean: float) -> None:
        self.rows, self.mean = [embedding, building], mean

    def gather_others(self, rows: torch.Tensor) -> torch.Tensor:
        return self.rows[0 if rows.is_floating_point() else 1]

    def average(self, value: torch.Tensor) -> torch.Tensor:
        return torch.tensor(self.mean)


@pytest.mark.parametrize("kind", ["infonce", "ntxent", "triplet"])
def test_the_mean_loss_of_two_processes_is_that_of_one_with_all_pairs(kind):
    """Three pairs, of which the second and the third show one building and are in two processes."""
    rows = torch.nn.functional.normalize(torch.randn(12, 4, generator=torch.manual_seed(0)), dim=1)
    bins, hot = torch.randn(12), torch.tensor(0.2)
    matches, pairs = [(0, 2), (4, 6), (8, 10), (9, 11)], [0] * 4 + [1] * 4 + [2] * 4
    whole = replace(truth(matches, pairs, [0, 0, 1, 1] * 3), building=torch.tensor(pairs).clamp(max=1))
    settings = LossSettings(kind, dustbin=0.0)
    expected = compute_matching_loss(settings, rows, bins, hot, whole)["loss"]
    halves = []
    for mine, other in ((slice(0, 8), slice(8, 12)), (slice(8, 12), slice(0, 8))):
        square = {name: getattr(whole, name)[mine, mine] for name in ("same", "piece")}
        part = Truth(**{name: getattr(whole, name)[mine] for name in ("pair", "side", "clear", "building")}, **square)
        others = _Recorded(rows[other], whole.building[other], 4.0)  # rooms with a partner: four in each
        halves.append(compute_matching_loss(settings, rows[mine], bins[mine], hot, part, others)["loss"])
    assert sum(halves) / 2 == pytest.approx(expected.item(), rel=1e-5)


def test_the_dustbin():
    loss = compute_dustbin_loss(FLAT, torch.tensor([0.0, 1.0, 0.0, 1.0]), torch.tensor(1.0), ONE)
    # Room 0 sees 2 (cosine 1), 3 (0) and its dustbin (0); room 1, that has no partner, sees 2 (0), 3 (1) and its dustbin (1).
    assert loss[0].item() == pytest.approx(math.log((E(1) + 2) / E(1)))
    assert loss[1].item() == pytest.approx(math.log((1 + E(1) + E(1)) / E(1)))


def test_triplets():
    loss, has = compute_triplet_loss(FLAT, ONE, 0.3)
    assert has.tolist() == [True, False, True, False] and loss[0].item() == 0  # both negatives are sqrt 2 away, the partner 0
    swapped = torch.tensor([[1.0, 0], [1, 0], [0, 1], [0, 1]])
    # Room 0: its partner is sqrt 2 away, room 1 is 0 and room 3 sqrt 2; room 2 sees 3 at 0 and 1 at sqrt 2.
    expected = ((math.sqrt(2) + 0.3) + 0.3) / 2
    assert compute_triplet_loss(swapped, ONE, 0.3)[0].tolist() == pytest.approx([expected, 0, expected, 0], abs=2e-3)


def test_triplets_that_are_met_do_not_count():
    """a: rooms 0 and 1; b: its pieces 2 and 3 of room 0, and room 4."""
    embedding = torch.tensor([[1.0, 0], [-1, 0], [1, 0], [0, 1], [0, 1]])
    what = truth([(0, 2), (0, 3)], [0] * 5, [0, 0, 1, 1, 1], [0, 1, 0, 0, 2])
    loss, has = compute_triplet_loss(embedding, what, 0.3)
    # Room 0: from piece 2 (0 away) nothing is wrong with 1 (2 away) or 4 (sqrt 2); from piece 3 (sqrt 2) only 4 is too near.
    assert has.tolist() == [True, False, True, True, False]
    assert loss[0].item() == pytest.approx((0 + 0.3) / 2, abs=2e-3)


def test_triplets_part_rooms_that_are_at_one_point():
    """Rooms that are nearly at one point leave it."""
    rows = torch.nn.Parameter(torch.tensor([[1.0, 0, 0]]).repeat(4, 1) + 0.01 * torch.randn(4, 3, generator=torch.manual_seed(0)))
    optimizer = torch.optim.Adam([rows], 0.05)
    for _ in range(100):
        loss = compute_triplet_loss(torch.nn.functional.normalize(rows, dim=1), ONE, 0.3)[0].sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss.item() == 0


@pytest.mark.parametrize("kind", ["infonce", "ntxent", "triplet"])
def test_each_kind_learns_and_stays_finite(kind):
    torch.manual_seed(0)
    rows, bins = torch.randn(8, 4, requires_grad=True), torch.zeros(8, requires_grad=True)
    hot = torch.tensor(0.1, requires_grad=True)
    what = truth([(0, 2), (4, 6)], [0, 0, 0, 0, 1, 1, 1, 1], [0, 0, 1, 1, 0, 0, 1, 1])
    optimizer = torch.optim.Adam([rows, bins], 0.05)
    losses = []
    for _ in range(60):
        parts = compute_matching_loss(LossSettings(kind), torch.nn.functional.normalize(rows, dim=1), bins, hot, what)
        optimizer.zero_grad()
        parts["loss"].backward()
        assert all(torch.isfinite(p.grad).all() for p in (rows, bins, hot))
        optimizer.step()
        losses.append(parts["loss"].item())
    assert losses[-1] < 0.5 * losses[0]
    nothing = truth([], [0, 0], [0, 1])
    alone = compute_matching_loss(LossSettings(kind), torch.eye(2), torch.zeros(2), hot, nothing)
    assert torch.isfinite(alone["loss"])


def test_faint_rooms_count_less():
    clear = torch.tensor([False, False, True, True])
    faint = replace(ONE, clear=clear)
    embedding, bins = torch.nn.functional.normalize(torch.tensor([[1.0, 0.5], [0, 1], [1, 0], [0.3, 1]]), dim=1), torch.zeros(4)
    single, _ = compute_info_nce(embedding, torch.tensor(1.0), ONE, 0.3)
    losses = compute_matching_loss(LossSettings(faint=0.25, dustbin=0.0), embedding, bins, torch.tensor(1.0), faint)
    assert losses["loss"].item() == pytest.approx(((0.25 * single[0] + single[2]) / 1.25).item())


def test_bad_settings_name_their_key():
    for wrong, said in (
        (LossSettings("cosine"), "loss.kind"),
        (LossSettings(easy=-1), "loss.easy"),
        (LossSettings(temperature=0), "temper"),
    ):
        with pytest.raises(InputError, match=said):
            check(wrong)


def test_in_half_precision_the_loss_is_nearly_the_same_and_every_gradient_finite():
    """`precision=bf16-mixed`; crops of doors once did not run so."""
    torch.manual_seed(0)
    network = Embedder(Network(Geometry(["scalars", *CROP_SHAPES]), Node(ways=True), dropout=0.0))
    objective, both = Objective(network, LossSettings()), truth([(0, 4), (1, 5)], [0] * 8, [0] * 4 + [1] * 4)
    losses = []
    for half in (False, True):
        objective.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            losses.append(objective(graph(8), both)["loss"])
        losses[-1].backward()
        assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())
    assert losses[1].dtype == torch.float32 and losses[1].item() == pytest.approx(losses[0].item(), rel=0.02)
