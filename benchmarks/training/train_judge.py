"""Train the judge of doors (topomerge/extraction/plans/door_classifier.py) on simulated scans of training buildings.

    python -m benchmarks.training.training_plans --of judge --scans 300       # cache/plans/*.npz
    python -m benchmarks.training.train_judge  # topomerge/extraction/plans/door_classifier.json; tells how right it is

A plan is cut into regions as the extraction does. Two neighbouring regions are an example: 1 where most of them lie in different
true rooms. Regions of one true room are then merged, as a perfect judge would, and what remains gives more examples: the judge is
asked about half-merged rooms, too. The network of the plans (`train_plan_network.py`) is trained first: the judge hears it.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.training.training_plans import files_of, load
from topomerge.extraction.plans.passages import DOOR_FEATURES, clearance_of, door_features, find_passages, regions_of
from topomerge.extraction.plans.plan_network import column_probabilities, without_furniture
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.types import Array

WEIGHTS = Path("topomerge/extraction/plans/door_classifier.json")
SEEDS = 5  # networks that are averaged
PURE = 0.7  # share of a region in its true room; regions between rooms are no example


def regions_and_links(plan: StoreyPlan, truth: Array, visited: set[int]) -> tuple[list[Array], list[bool]]:
    """Features and answers for the neighbouring regions of one plan, before and while those of one room are merged."""
    chance = column_probabilities(plan)
    plan = without_furniture(plan, chance)
    clearance = clearance_of(plan)
    region = regions_of(plan, chance)
    count, rooms = int(region.max(initial=-1)) + 1, int(truth.max(initial=-1)) + 1
    votes = np.zeros((count, rooms + 1))
    known = region >= 0
    np.add.at(votes, (region[known], truth[known]), 1)
    room = np.where(votes.max(axis=1) >= PURE * votes.sum(axis=1), votes.argmax(axis=1), -1) if count else np.zeros(0, int)
    room[room == rooms] = -1
    area = votes.sum(axis=1) * plan.edge**2
    peak = np.zeros(count)
    np.maximum.at(peak, region[known], clearance[known])
    links = dict(find_passages(plan, clearance, region, chance))
    x: list[Array] = []
    y: list[bool] = []

    def tell(pairs: list[tuple[int, int]]) -> None:
        for a, b in pairs:
            if room[a] >= 0 and room[b] >= 0 and (room[a] in visited or room[b] in visited):
                x.append(door_features(links[a, b], (peak[a], peak[b]), (area[a], area[b])))
                y.append(bool(room[a] != room[b]))

    tell(list(links))
    while same := [p for p in links if room[p[0]] >= 0 and room[p[0]] == room[p[1]]]:
        keep, gone = max(same, key=lambda p: (links[p].width / min(peak[p[0]], peak[p[1]]), p))
        del links[keep, gone]
        peak[keep], area[keep] = max(peak[keep], peak[gone]), area[keep] + area[gone]
        for old in [p for p in links if gone in p]:
            other = old[0] if old[1] == gone else old[1]
            new, passage = (min(keep, other), max(keep, other)), links.pop(old)
            if new not in links or passage.width > links[new].width:
                links[new] = passage
        tell([p for p in links if keep in p])
    return x, y


def fit(hidden: int = 16) -> None:
    """Train on all examples and write the weights; before that, print what three-fold cross-validation over scans says."""
    scans = [load(f) for f in files_of("judge")]
    found = [[regions_and_links(e.plan, e.room, set(e.visited.tolist())) for e in scan] for scan in scans]
    parts = [([x for xs, _ in of for x in xs], [y for _, ys in of for y in ys]) for of in found]
    x = np.concatenate([np.array(xs).reshape(-1, len(DOOR_FEATURES)) for xs, _ in parts])
    y = np.concatenate([ys for _, ys in parts]).astype(np.float32)
    scan_of = np.repeat(np.arange(len(parts)), [len(ys) for _, ys in parts])
    low, high = np.quantile(x, [0.005, 0.995], axis=0)
    x = np.clip(x, low, high)
    mean, scale = x.mean(axis=0), x.std(axis=0) + 1e-6
    z = (x - mean) / scale
    fold = np.random.default_rng(0).permutation(len(parts))[scan_of] % 3
    right, loss = [], []
    for k in range(3):
        layers = train(z[fold != k], y[fold != k], scan_of[fold != k], hidden)
        p = forward(z[fold == k], layers)
        right.append(np.mean((p > 0.5) == (y[fold == k] > 0.5)))
        loss.append(-np.mean(np.log(np.where(y[fold == k] > 0.5, p, 1 - p) + 1e-6)))
    print(f"{len(y)} examples of {len(parts)} scans, {y.mean():.3f} of them doors")
    print(f"held-out scans: {np.mean(right):.3f} right, loss {np.mean(loss):.3f}")
    weights = {"low": low, "high": high, "mean": mean, "scale": scale}
    about: dict[str, Any] = {name: values.round(4).tolist() for name, values in weights.items()}
    about["layers"] = [[w.round(4).tolist(), b.round(4).tolist()] for w, b in train(z, y, scan_of, hidden)]
    beside = WEIGHTS.with_suffix(".new")
    beside.write_text(json.dumps({"features": DOOR_FEATURES, **about}))
    os.replace(beside, WEIGHTS)


def train(z: Array, y: Array, scan_of: Array, hidden: int) -> list[tuple[Array, Array]]:
    """The mean of the scores of several networks that differ by their seed: one network with as many times the hidden units."""
    (first, second) = zip(*(train_one(z, y, scan_of, hidden, seed) for seed in range(SEEDS)), strict=True)
    w, b = np.concatenate([w for w, _ in first], axis=1), np.concatenate([b for _, b in first])
    return [(w, b), (np.concatenate([v for v, _ in second]) / SEEDS, np.mean([c for _, c in second], axis=0))]


def train_one(
    z: Array, y: Array, scan_of: Array, hidden: int, seed: int, epochs: int = 60
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Weights and biases of a network with one hidden layer; scans with many examples count less than proportionally."""
    import torch

    torch.manual_seed(seed)
    net = torch.nn.Sequential(torch.nn.Linear(z.shape[1], hidden), torch.nn.ReLU(), torch.nn.Linear(hidden, 1))
    optimiser = torch.optim.AdamW(net.parameters(), lr=5e-3, weight_decay=3e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, epochs)
    weight = 1 / np.sqrt(np.bincount(scan_of)[scan_of])
    inputs, target, weight = (torch.tensor(v, dtype=torch.float32) for v in (z, y, weight / weight.mean()))
    for _ in range(epochs):
        for rows in torch.randperm(len(inputs)).split(256):
            noisy = inputs[rows] + 0.1 * torch.randn_like(inputs[rows])
            each = torch.nn.functional.binary_cross_entropy_with_logits(net(noisy)[:, 0], target[rows], reduction="none")
            optimiser.zero_grad()
            (each * weight[rows]).mean().backward()
            optimiser.step()
        schedule.step()
    linear = [m for m in net if isinstance(m, torch.nn.Linear)]
    one, two = ((m.weight.detach().numpy().T, m.bias.detach().numpy()) for m in linear)
    return one, two


def forward(z: Array, layers: list[tuple[Array, Array]]) -> Array:
    """(n,) probabilities."""
    (w, b), (v, c) = layers
    return np.asarray(1 / (1 + np.exp(-(np.maximum(z @ w + b, 0) @ v + c)[:, 0])))


if __name__ == "__main__":
    fit()
