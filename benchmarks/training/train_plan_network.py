"""Train the network of the plans (topomerge/extraction/plans/plan_network.py) on simulated scans of training buildings.

    python -m benchmarks.training.training_plans --of network --scans 300     # cache/plans/*.npz
    python -m benchmarks.training.train_plan_network  # topomerge/extraction/plans/plan_network.npz; 60 crops a second

Crops of 12.8 m, turned and mirrored, with things taken away now and then. Every eighth scan is held out: its accuracy a class is
printed. ``--state FILE`` keeps where the training is, and it goes on there. `train_judge.py` comes next.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.training.training_plans import TRUTHS, Example, files_of, load
from topomerge.extraction.classified_storey import COLUMN_CLASSES
from topomerge.extraction.plans.plan_network import DOWN_LEVELS, EVIDENCE_CHANNELS, PLAN_NETWORK_FILE, UP_LEVELS, evidence
from topomerge.types import Array

WEIGHTS = Path("topomerge/extraction/plans") / PLAN_NETWORK_FILE
WIDTHS = {"a": 16, "b": 32, "c": 40, "d": 40, "e": 40, "f": 32, "g": 16, "h": 12}
CROP, BATCH = 128, 8
WEIGHT = (1.0, 2.0, 4.0, 6.0, 1.0)  # of the classes
UNSEEN = 0.05  # weight of columns of which nothing is known
RATE = 2e-3


def network() -> Any:
    """The same network in torch, with batch normalisation that goes into the weights at the end."""
    import torch
    from torch import nn

    def layer(c: int, k: int, stride: int = 1) -> Any:
        return nn.Sequential(nn.Conv2d(c, k, 3, stride, 1, bias=False), nn.BatchNorm2d(k), nn.ReLU())

    class Network(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layers = nn.ModuleDict()
            wide, skips = EVIDENCE_CHANNELS, []
            for name in DOWN_LEVELS:
                skips.append(wide)
                self.layers[f"{name}1"] = layer(wide, WIDTHS[name], 2)
                self.layers[f"{name}2"] = layer(WIDTHS[name], WIDTHS[name])
                wide = WIDTHS[name]
            for name in UP_LEVELS:
                self.layers[f"{name}1"] = layer(wide + skips.pop(), WIDTHS[name])
                wide = WIDTHS[name]
            self.out = nn.Conv2d(wide, len(COLUMN_CLASSES), 1)

        def forward(self, x: Any) -> Any:
            skips = [x]
            for name in DOWN_LEVELS:
                x = self.layers[f"{name}2"](self.layers[f"{name}1"](x))
                skips.append(x)
            x = skips.pop()
            for name in UP_LEVELS:
                x = torch.cat([nn.functional.interpolate(x, scale_factor=2.0), skips.pop()], dim=1)
                x = self.layers[f"{name}1"](x)
            return self.out(x)

    return Network()


def exported(net: Any) -> dict[str, Array]:
    """Weights for `plan_network.forward`: (9 c, k) with the normalisation in them."""
    out: dict[str, Array] = {}
    for name, (conv, norm, _) in net.layers.items():
        scale = (norm.weight / (norm.running_var + norm.eps).sqrt()).detach()
        w = (conv.weight * scale[:, None, None, None]).detach().numpy()
        out[f"{name}.w"] = w.transpose(2, 3, 1, 0).reshape(-1, w.shape[0])
        out[f"{name}.b"] = (norm.bias - norm.running_mean * scale).detach().numpy()
    out["out.w"], out["out.b"] = net.out.weight.detach().numpy()[:, :, 0, 0].T, net.out.bias.detach().numpy()
    return out


def prepared(example: Example) -> tuple[Array, Array, Array]:
    """Evidence, truth and weight of each column."""
    from scipy import ndimage

    known = ndimage.binary_dilation(example.plan.inside | example.plan.wall, np.ones((3, 3)))
    weight = np.array(WEIGHT, np.float32)[example.truth] * np.where(known, 1.0, UNSEEN)
    return evidence(example.plan).astype(np.float16), example.truth, weight.astype(np.float16)


def crop(example: tuple[Array, Array, Array], rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """A square of a plan, turned by quarters, mirrored or not, with some of the evidence taken away."""
    x, truth, weight = example
    at = np.argwhere(x[..., 0] > 0)
    i, j = (at[rng.integers(len(at))] - rng.integers(CROP // 4, 3 * CROP // 4, 2)).tolist()
    box = tuple(slice(max(k, 0), max(k + CROP, 0)) for k in (i, j))
    pad = [(max(-k, 0), CROP - max(-k, 0) - (min(k + CROP, n) - max(k, 0))) for k, n in zip((i, j), truth.shape, strict=True)]
    x = np.pad(x[box], [*pad, (0, 0)])
    truth = np.pad(truth[box], pad, constant_values=TRUTHS.index("outside"))
    weight = np.pad(weight[box], pad)
    turn = int(rng.integers(4))
    x, truth, weight = (np.rot90(v, turn) for v in (x, truth, weight))
    if rng.random() < 0.5:
        x, truth, weight = x[::-1], truth[::-1], weight[::-1]
    x = np.array(x, np.float32)
    if rng.random() < 0.2:  # nothing above, or no floor
        x[..., [5, 7, 8, 9] if rng.random() < 0.7 else [6]] = 0
    if rng.random() < 0.3:  # single columns
        x[..., 1:10] *= rng.random((CROP, CROP, 1)) > rng.uniform(0, 0.3)
    return x, truth, weight


def train(minutes: float, state: Path, total: float) -> None:
    """Train for so many minutes of `total`, and write the weights."""
    import torch

    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    torch.manual_seed(0)
    files = files_of("network")
    held = [e for f in files[::8] for e in load(f)]
    data = [(prepared(e), e.room.size) for k, f in enumerate(files) if k % 8 for e in load(f) if e.plan.inside.sum() > 100]
    chance = np.sqrt([size for _, size in data])
    chance /= chance.sum()
    net = network().to(memory_format=torch.channels_last)
    optimiser = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=1e-3)
    done, steps = 0.0, 0
    if state.exists():
        kept = torch.load(state, weights_only=True)
        net.load_state_dict(kept["net"])
        optimiser.load_state_dict(kept["optimiser"])
        done, steps = kept["done"], kept["steps"]
    rng = np.random.default_rng([1, steps])
    print(f"{len(data)} plans, {sum(p.numel() for p in net.parameters())} weights, {done:.1f} minutes done", flush=True)
    began, first, losses = time.process_time(), done, []
    net.train()

    def keep() -> None:
        torch.save({"net": net.state_dict(), "optimiser": optimiser.state_dict(), "done": done, "steps": steps}, state)

    while done < min(first + minutes, total):
        for group in optimiser.param_groups:
            group["lr"] = RATE * max(0.5 * (1 + math.cos(math.pi * done / total)), 0.01) * min(1.0, (steps + 1) / 100)
        rows = rng.choice(len(data), BATCH, p=chance)
        x, truth, weight = (np.stack(v) for v in zip(*(crop(data[r][0], rng) for r in rows), strict=True))
        score = net(torch.from_numpy(x).permute(0, 3, 1, 2))
        each = torch.nn.functional.cross_entropy(score, torch.from_numpy(truth.astype(np.int64)), reduction="none")
        w = torch.from_numpy(weight.astype(np.float32))
        loss = (each * w).sum() / w.sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
        steps += 1
        done = first + (time.process_time() - began) / 60
        if steps % 200 == 0:
            print(f"{steps} steps, {done:.1f} minutes, loss {np.mean(losses[-200:]):.4f}", flush=True)
            keep()
    keep()
    net.eval()
    write(net)
    report(held)


def write(net: Any) -> None:
    """The weights file."""
    beside = WEIGHTS.with_name("new.npz")
    np.savez_compressed(beside, **{name: v.astype(np.float16) for name, v in exported(net).items()})
    os.replace(beside, WEIGHTS)


def report(held: list[Example]) -> None:
    """Precision and recall of each class over known columns of the held-out scans."""
    from topomerge.extraction.plans.plan_network import column_probabilities

    count: dict[str, Array] = {}
    for e in held:
        known = e.plan.inside | e.plan.wall
        answer = column_probabilities(e.plan).argmax(axis=-1)
        table = count.setdefault(e.source.split("/")[0], np.zeros((5, 5), np.int64))
        np.add.at(table, (e.truth[known], answer[known]), 1)
    for name, table in [*sorted(count.items()), ("all", sum(count.values()))]:
        right = np.diag(table)
        words = [
            f"{c} {r / max(p, 1):.2f}/{r / max(t, 1):.2f}"
            for c, r, p, t in zip(COLUMN_CLASSES, right, table.sum(axis=0), table.sum(axis=1), strict=True)
        ]
        print(f"{name:8s} precision/recall: {', '.join(words)}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0, help="of work now")
    parser.add_argument("--total", type=float, default=30.0, help="of work in all, which the rate of learning falls over")
    parser.add_argument("--state", type=Path, default=Path("cache/plan_network.pt"))
    arguments = parser.parse_args()
    train(arguments.minutes, arguments.state, arguments.total)
