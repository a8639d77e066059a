"""Batches made on a device: those of the host where nothing is changed, and the same changes whatever the batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from topomerge.models.embedder import rotate_quarter_turns

from tests.graphs import pair, write_set
from tests.training.test_batches import turned_pair
from topomerge.embedding.graph import find_columns_of_power
from topomerge.embedding.network import Geometry, Network, Node
from topomerge.embedding.surroundings import CROP_SHAPES
from topomerge.errors import InputError
from topomerge.training import device_batches
from topomerge.training.batches import make_batch, mirror_graph
from topomerge.training.device_batches import DevicePairs, concatenate_ranges
from topomerge.training.embedding import EmbeddingJob, fit
from topomerge.training.hashed_random import draw_normal, draw_uniform, draw_uniforms
from topomerge.training.settings import Augment, Training

NAMES = ("x", "edge_index", "edge_attr", "edge_way", *CROP_SHAPES)
TRUTH = ("side", "true", "clear", "building", "match_index", "batch", "room_counts")
STILL = Augment(0.0, 0.0, 0.0, noise=0.0, shift=0.0, walks=0.0, slices=0.0, rough=0.0, tilt=0.0, zoom=0.0, bend=0.0)
CPU = torch.device("cpu")


@pytest.fixture
def whole(monkeypatch):
    """Maps that lack nothing, and doors that stay."""
    monkeypatch.setattr(device_batches, "SEEN_AS", (((), 1.0),))
    monkeypatch.setattr(device_batches, "DOOR_SHIFT", 0.0)
    monkeypatch.setattr(device_batches, "PATCH", (0, 1))


def test_unchanged_batches_are_those_of_the_host_to_the_bit():
    pairs = [pair(k, 5 + k) for k in range(4)]
    host, device = (
        make_batch([pairs[k] for k in (2, 0, 3)], NAMES),
        DevicePairs(pairs, NAMES, None, CPU).make_batch([2, 0, 3], int),
    )
    assert all(torch.equal(host[name], device[name]) for name in (*NAMES, *TRUTH))
    assert torch.equal(host.truth.same, device.truth.same) and torch.equal(host.truth.piece, device.truth.piece)


@pytest.mark.parametrize("quarters", range(4))
def test_maps_stand_as_they_truly_do_and_b_comes_once_more_turned_wrongly(quarters, whole):
    one = turned_pair(3, quarters)
    batch = DevicePairs([one], NAMES, STILL, CPU).make_batch([0], lambda number: 11 + quarters)
    count = len(one.a["x"])
    seen = [
        dict(zip(CROP_SHAPES, crops, strict=True)) for crops in zip(*(batch[p].split(count) for p in CROP_SHAPES), strict=True)
    ]
    assert torch.equal(seen[0]["surroundings"], seen[1]["surroundings"])
    wrong = [k for k in range(4) if all(torch.equal(rotate_quarter_turns(seen[1], k)[p], seen[2][p]) for p in CROP_SHAPES)]
    assert len(wrong) == 1 and wrong != [0]
    assert (batch.true[2 * count :] == -1).all() and not batch["clear"][2 * count :].any()


def test_crops_and_ways_of_a_map_are_turned_and_mirrored_alike(whole):
    host = make_batch([pair(1)], NAMES)
    count, seen = len(pair(1).a["x"]), set()
    edges = pair(1).a["edge_index"].shape[1]
    plain = {name: host[name][: edges if name.startswith("edge") else count] for name in NAMES if name != "edge_index"}
    for seed in range(12):
        batch = DevicePairs([pair(1)], NAMES, STILL, CPU).make_batch([0], lambda number, seed=seed: seed)
        views = {
            (k, flip): mirror_graph(rotate_quarter_turns(plain, k)) if flip else rotate_quarter_turns(plain, k)
            for k in range(4)
            for flip in (False, True)
        }
        fits = [
            key
            for key, view in views.items()
            if torch.equal(view["surroundings"], batch["surroundings"][:count])
            and torch.equal(view["door_surroundings"], batch["door_surroundings"][:count])
            and torch.allclose(view["edge_way"], batch["edge_way"][:edges], atol=1e-5)
            and torch.allclose(view["edge_attr"], batch["edge_attr"][:edges])
        ]
        assert len(fits) == 1
        seen |= set(fits)
    assert len({k for k, _ in seen}) > 2 and len({flip for _, flip in seen}) == 2


def test_changes_depend_on_the_pairs_seed_only():
    pairs = [pair(k, 8) for k in range(4)]
    device = DevicePairs(pairs, NAMES, Augment(), CPU)
    together, alone, later = (
        device.make_batch([3, 1], int),
        device.make_batch([1], int),
        device.make_batch([1], lambda k: k + 100),
    )
    count = len(alone.x)
    assert all(torch.equal(together[name][-count:], alone[name]) for name in ("x", *CROP_SHAPES))
    assert not torch.equal(alone.x[:2], later.x[:2])


def test_lost_rooms_take_their_edges_and_matches_along():
    batch = DevicePairs([pair(0, 12)], NAMES, Augment(rooms=0.9, edges=0.5), CPU).make_batch([0], int)
    counts = batch.room_counts.tolist()
    assert sum(counts) < 24 and min(counts) >= 2 and len(batch.x) == counts[0] + 2 * counts[1]
    first, second = batch.match_index
    assert (
        torch.equal(batch.true[first], batch.true[second]) and (batch.side[first] == 0).all() and (batch.side[second] == 1).all()
    )
    assert batch.edge_index.max() < len(batch.x)
    part = torch.repeat_interleave(torch.arange(3), torch.tensor([counts[0], counts[1], counts[1]]))
    assert torch.equal(part[batch.edge_index[0]], part[batch.edge_index[1]])


def test_sizes_are_jittered_and_nothing_else():
    batch = DevicePairs([pair(0, 9)], NAMES, Augment(rooms=0.0, edges=0.0, jitter=0.1), CPU).make_batch([0], int)
    plain, count = make_batch([pair(0, 9)], NAMES), len(pair(0, 9).a["x"])
    lengths = [column for power in (1, 2, 3) for column in find_columns_of_power("x", power)]
    others = [column for column in range(batch.x.shape[1]) if column not in lengths]
    assert torch.equal(batch.x[:count, others], plain.x[:count, others])
    ratio = (batch.x[:count, lengths] / plain.x[:count, lengths]).log()
    assert 0.05 < float(ratio.std()) < 0.2


def test_a_planes_and_patches_are_missing_where_they_were_drawn(monkeypatch):
    monkeypatch.setattr(device_batches, "SEEN_AS", ((("ceiling",), 1.0),))
    monkeypatch.setattr(device_batches, "PATCH", (1000, 1001))
    batches = [DevicePairs([pair(0)], NAMES, Augment(), CPU).make_batch([0], lambda k, s=s: s) for s in range(8)]
    assert all((batch.surroundings[..., 5] == 0).all() for batch in batches)
    shares = [float((batch.surroundings[..., 0] > 0).float().mean()) for batch in batches]
    assert min(shares) < 0.5 * max(shares)


def test_a_zoom_moves_what_stands_far_from_the_middle(whole):
    changes = Augment(0.0, 0.0, 0.0, shift=0.0, tilt=0.0, zoom=0.3, bend=0.0)
    one, still = (DevicePairs([pair(0)], NAMES, a, CPU).make_batch([0], int).surroundings for a in (changes, STILL))
    same = (one == still)[..., -1].float()  # the room itself: its border moves away from the middle
    assert same[:, 28:36, 28:36].mean() > same.mean() and same.mean() < 0.99


def test_random_numbers_are_spread_evenly_and_alike_on_host_and_device():
    seed, index = np.arange(20_000, dtype=np.uint64), np.zeros(20_000)
    uniform = draw_uniform(seed, 3, index)
    device = draw_uniforms(torch.arange(20_000), 3, torch.zeros(1, dtype=torch.long))
    assert np.allclose(uniform, device.numpy(), atol=1e-6)
    assert abs(uniform.mean() - 0.5) < 0.01 and abs(np.corrcoef(uniform[1:], uniform[:-1])[0, 1]) < 0.03
    normal = draw_normal(torch.arange(20_000), 4, torch.zeros(1, dtype=torch.long))
    assert abs(float(normal.mean())) < 0.03 and abs(float(normal.std()) - 1) < 0.03


def test_ranges_behind_each_other():
    assert concatenate_ranges(np.array([5, 0, 9]), np.array([2, 0, 3])).tolist() == [5, 6, 9, 10, 11]
    assert concatenate_ranges(np.zeros(0, int), np.zeros(0, int)).tolist() == []


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    write_set(folder, "some", 6)
    return folder


def test_what_the_device_cannot_make_is_refused(cache, tmp_path):
    network = Network(Geometry(["scalars"], width=8), Node("none"), size=8)
    common = {"runs": str(tmp_path), "cache": str(cache), "data": "some", "validation": "", "logger": []}
    settings = Training(**common, batches="device", network=network)
    with pytest.raises(InputError, match="batches=host"):
        fit(settings, lambda text: None)


@pytest.mark.longer
def test_a_training_with_batches_of_the_device_learns_and_repeats(cache, tmp_path, monkeypatch):
    monkeypatch.setattr(EmbeddingJob, "export_best", lambda self, folder: None)  # seconds
    network = Network(
        Geometry(["scalars", "surroundings"], width=8), Node("gat", 1, heads=2, around=10.0, ways=True, width=8), size=8
    )
    common = {"cache": str(cache), "data": "some", "validation": "", "logger": [], "epochs": 2, "batch": 2}
    settings = [Training(**common, runs=str(tmp_path / name), batches="device", network=network) for name in "ab"]
    rows = [fit(one, lambda text: None) for one in settings]
    assert np.isfinite(rows[0]["train/loss"]) and rows[0]["train/loss"] == rows[1]["train/loss"]
    files = [one.folder / "best" / "embedder.safetensors" for one in settings]
    assert files[0].read_bytes() == files[1].read_bytes()
