"""Train the judge of doors (topomerge/extraction/judge.py) on simulated scans of training buildings.

    python benchmarks/train_judge.py gather --scans 400      # cache/judge/*.npz, about 4 s of a core each; goes on where it was
    python benchmarks/train_judge.py fit                     # writes topomerge/extraction/judge.json, prints the cross-validation

A scan is cut into regions as the extraction does. Two neighbouring regions are an example: 1 where most of them lie in different
true rooms. Regions of one true room are then merged, as a perfect judge would, and what remains gives more examples: the judge is
asked about half-merged rooms, too. Procedural buildings and, with TOPOMERGE_DATA set, real plans; never one of the evaluation
split.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from topomerge.datasets import splits
from topomerge.datasets.building import Building
from topomerge.datasets.buildings import KINDS, make_building
from topomerge.datasets.difficulty import Difficulty
from topomerge.datasets.erect import erect
from topomerge.datasets.floorplans import Refusal, iter_plans
from topomerge.datasets.scanner import scan
from topomerge.datasets.walk import part

from topomerge.errors import InputError
from topomerge.extraction.extract import PRESETS, navigable_volume
from topomerge.extraction.passages import FEATURES, clearance_of, features, find_passages, regions_of
from topomerge.extraction.plan import Plan, storey_plan
from topomerge.extraction.storeys import find_storeys, floor_to_ceiling
from topomerge.extraction.voxels import voxelise
from topomerge.types import Array, PointCloud

CACHE = Path("cache/judge")
WEIGHTS = Path("topomerge/extraction/judge.json")
SEED = 100_000  # of the first building; training seeds end at 799,999
MOST_ROOMS = 16
PURE = 0.7  # share of a region in its true room; regions between rooms are no example
EDGES = (0.1, 0.1, 0.1, 0.08, 0.15)  # m
LEVEL = 0.6  # m between a storey and the true floor


def gather(scans: int) -> None:
    """Examples of so many scans, a file each."""
    CACHE.mkdir(parents=True, exist_ok=True)
    plans = real_plans()
    for seed in range(SEED, SEED + scans):
        path = CACHE / f"{seed}.npz"
        if path.exists():
            continue
        try:
            x, y, source = examples(seed, plans)
        except InputError as error:
            print(f"{seed}: {error}", flush=True)
            continue
        np.savez(CACHE / "new.npz", x=x, y=y, source=source)
        os.replace(CACHE / "new.npz", path)
        print(f"{seed}: {len(y)} examples, {np.mean(y) if len(y) else 0:.2f} of them doors", flush=True)


def real_plans() -> dict[str, list[Any]]:
    """Training plans of apartments, schools and offices, if there are any."""
    data = os.environ.get("TOPOMERGE_DATA", "")
    out: dict[str, list[Any]] = {}
    for source in ("r2v", "campus") if data else ():
        wanted = set(splits.members("train", source))
        found = iter_plans(Path(data) / splits.FOLDERS[source], wanted)
        out[source] = [plan for _, plan in found if not isinstance(plan, Refusal)][:300]
    return out


def examples(seed: int, plans: dict[str, list[Any]]) -> tuple[Array, Array, str]:
    """(n, 15) features, (n,) is it a door, and where the building is from."""
    rng = np.random.default_rng(seed)
    difficulty = draw_difficulty(rng)
    source = str(rng.choice(["procedural", "r2v", "campus"], p=[0.6, 0.25, 0.15]))
    if plans.get(source):
        building = erect([plans[source][rng.integers(len(plans[source]))]], difficulty, rng, f"{source}-{seed}")
    else:
        building = make_building(str(rng.choice(KINDS)), seed, int(rng.choice([1, 1, 2])), difficulty)
    rooms = None if len(building.rooms) <= MOST_ROOMS else part(building, MOST_ROOMS, rng)
    cloud = scan(building, str(rng.choice(["tls", "depth", "lidar"])), rooms, seed)
    visited = set(range(len(building.rooms)) if rooms is None else rooms)
    storeys = plans_and_truth(building, cloud, EDGES[seed % len(EDGES)])
    found = [regions_and_links(plan, truth, visited) for plan, truth in storeys]
    x = [row for rows, _ in found for row in rows]
    return np.array(x).reshape(-1, len(FEATURES)), np.array([y for _, ys in found for y in ys], bool), source


def draw_difficulty(rng: np.random.Generator) -> Difficulty:
    """From tidy to hard, all kinds at once."""
    wide = {"ceiling_spread": 0.4, "furniture": 2.0, "clutter": 1.0, "glass": 0.2, "lamps": 1.0, "beams": 0.5, "columns": 1.0}
    drawn = {name: float(rng.uniform(0, most)) for name, most in (wide | {"slopes": 0.5, "curved": 0.4}).items()}
    ajar = float(rng.uniform(0.4, 0.9))
    lintels = float(rng.choice([0, 0.5, 0.9, 1.0]))
    return Difficulty(**drawn, open=ajar, half=float(rng.uniform(0, 1 - ajar)), lintels=lintels)


def plans_and_truth(building: Building, cloud: PointCloud, edge: float) -> list[tuple[Plan, Array]]:
    """The plan of each storey of a scan and the true room of each of its columns, -1 none."""
    grid = voxelise(cloud.points, edge, [])
    preset = PRESETS["default"]
    navigable = navigable_volume(grid, preset)
    storeys, storey = find_storeys(navigable, floor_to_ceiling(grid, navigable, preset.stem_height + preset.body_height))
    out = []
    for k, height in enumerate(storeys["floor"]):
        if not (storey == k).any():
            continue
        plan = storey_plan(grid, navigable, storey, k)
        truth = np.full(plan.wall.shape, -1)
        middles = (grid.origin[a] + (np.arange(n) + plan.low[a] + 0.5) * edge for a, n in enumerate(truth.shape))
        x, y = np.meshgrid(*middles, indexing="ij")
        for i, room in enumerate(building.rooms):
            if abs(room.floor - height) <= LEVEL:
                shape = shapely.Polygon(room.polygon)
                shapely.prepare(shape)
                truth[shapely.contains_xy(shape, x, y)] = i
        out.append((plan, truth))
    return out


def regions_and_links(plan: Plan, truth: Array, visited: set[int]) -> tuple[list[Array], list[bool]]:
    """Features and answers for the neighbouring regions of one plan, before and while those of one room are merged."""
    clearance = clearance_of(plan)
    region = regions_of(clearance)
    count, rooms = int(region.max(initial=-1)) + 1, int(truth.max(initial=-1)) + 1
    votes = np.zeros((count, rooms + 1))
    known = region >= 0
    np.add.at(votes, (region[known], truth[known]), 1)
    room = np.where(votes.max(axis=1) >= PURE * votes.sum(axis=1), votes.argmax(axis=1), -1) if count else np.zeros(0, int)
    room[room == rooms] = -1
    area = votes.sum(axis=1) * plan.edge**2
    peak = np.zeros(count)
    np.maximum.at(peak, region[known], clearance[known])
    links = dict(find_passages(plan, clearance, region))
    x: list[Array] = []
    y: list[bool] = []

    def tell(pairs: list[tuple[int, int]]) -> None:
        for a, b in pairs:
            if room[a] >= 0 and room[b] >= 0 and (room[a] in visited or room[b] in visited):
                x.append(features(links[a, b], (peak[a], peak[b]), (area[a], area[b])))
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
    files = sorted(CACHE.glob("[0-9]*.npz"))
    parts = [np.load(f) for f in files]
    x = np.concatenate([p["x"] for p in parts])
    y = np.concatenate([p["y"] for p in parts]).astype(np.float32)
    scan_of = np.repeat(np.arange(len(parts)), [len(p["y"]) for p in parts])
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
    beside.write_text(json.dumps({"features": FEATURES, **about}))
    os.replace(beside, WEIGHTS)


def train(z: Array, y: Array, scan_of: Array, hidden: int, epochs: int = 60) -> list[tuple[Array, Array]]:
    """Weights and biases of a network with one hidden layer; scans with many examples count less than proportionally."""
    import torch

    torch.manual_seed(0)
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
    return [(m.weight.detach().numpy().T, m.bias.detach().numpy()) for m in linear]


def forward(z: Array, layers: list[tuple[Array, Array]]) -> Array:
    """(n,) probabilities."""
    (w, b), (v, c) = layers
    return np.asarray(1 / (1 + np.exp(-(np.maximum(z @ w + b, 0) @ v + c)[:, 0])))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=["gather", "fit"])
    parser.add_argument("--scans", type=int, default=400)
    arguments = parser.parse_args()
    gather(arguments.scans) if arguments.step == "gather" else fit()
