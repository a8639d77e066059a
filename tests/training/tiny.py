"""Learning sets of each task that are made in no time: plans of two rooms; hypotheses, evidence and features out of numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from topomerge.datasets.pairs.drawing import TRUE_CLASSES
from topomerge.datasets.pairs.plan_examples import PlanExample, PlanItem, PlanRecipe, build_example_arrays
from topomerge.datasets.pairs.wall_examples import WallExample, WallItem, build_wall_arrays

from topomerge import archive
from topomerge.embedding.engineered import FEATURES
from topomerge.embedding.quarter_turns import FACTS, TurnedRows
from topomerge.extraction.elevations.elevation import ALONG, BANDS, DEPTHS, FACE_DTYPE, STRIP_CHANNELS
from topomerge.extraction.plans.passages import Passage
from topomerge.extraction.plans.plan import build_profile_bands
from topomerge.extraction.plans.storey_plan import StoreyPlan
from topomerge.extraction.room_odds import GRID_FEATURES, POSE_FEATURES, ROOM_FEATURES
from topomerge.fusion.match_belief import BELIEVED_METHODS
from topomerge.matching.consistency import compute_hypothesis_features
from topomerge.registration.places import LOOKED, SIDE
from topomerge.training.feature_scale import PairFeatures
from topomerge.training.match_belief import MatchRows
from topomerge.training.match_odds import MatchEvidence
from topomerge.training.packed_pairs import GraphPair
from topomerge.training.passages import PassageExamples
from topomerge.training.room_matcher import MatcherExample, MatcherView
from topomerge.types import EDGE_DTYPE, ROOM_DTYPE, STOREY_DTYPE, Array, Sim3, TopometricMap, VoxelGrid

EDGE = 0.1  # m


def plan_files(folder: Path, count: int) -> list[Path]:
    """Files of scans of two rooms beside each other with a door between them, each wider than the one before."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for k in range(count):
        path = folder / f"{k}.npz"
        archive.write(build_example_arrays(PlanItem(k, "procedural", 0, "", ""), [two_rooms(4 * k)]), path)
        paths.append(path)
    return paths


def wall_files(folder: Path, count: int) -> list[Path]:
    """Files of scans of two rooms, the wall between them with an open door and a shut one, 0.1 m farther along in each."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for k in range(count):
        map, faces, strips, truth, doors = two_doors(2 * k)
        example = WallExample(np.array([0, len(truth)]), strips, truth, doors, map, (), faces, "tls/procedural")
        path = folder / f"{k}.npz"
        archive.write(build_wall_arrays(WallItem(k, "procedural", 0, "", ""), example), path)
        paths.append(path)
    return paths


def two_doors(later: int) -> tuple[TopometricMap, Array, Array, Array, Array]:
    """The map of two rooms of 8 x 3 m without cells, the face of the wall between them, its strip, truth and doors.

    Args:
        later: places by which both doors are farther along.
    """
    x, y = np.meshgrid(np.arange(80), np.arange(61), indexing="ij")
    columns = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size, int)])
    columns = columns[columns[:, 1] != 30]
    floor = VoxelGrid.from_cells(columns, np.zeros(3), 0.1)
    rooms = np.zeros(2, ROOM_DTYPE)
    rooms["completeness"] = 1.0
    edge = np.zeros(1, EDGE_DTYPE)
    edge["rooms"], edge["centre"], edge["width"], edge["kind"] = (0, 1), (2.4 + later * ALONG, 3.05, 0.0), 0.9, "door"
    edge["open"], edge["confidence"] = True, 0.9
    label = (floor.cells[:, 1] > 30).astype(np.int32)
    none = np.zeros(0, np.int32)
    empty = floor.replace_cells(np.zeros((0, 3), np.int32))
    map = TopometricMap(empty, none, floor, label, rooms, edge, np.zeros(1, STOREY_DTYPE))
    face = np.array([(0, (0, 3), (1, 0), (0, 1), 8.0, 0.0)], FACE_DTYPE)
    truth, strip = np.zeros(160, np.uint8), np.zeros((160, DEPTHS, STRIP_CHANNELS), np.uint8)
    truth[40 + later : 58 + later], truth[100 + later : 118 + later] = 1, 2
    strip[:, 12, :BANDS] = 200
    strip[truth == 1, :, :BANDS] = 0
    strip[truth == 2, 12, :BANDS], strip[truth == 2, 16, :BANDS] = 0, 200
    doors = np.array([[2.45, 3.05, 0.0], [5.45, 3.05, 0.0]]) + (later * ALONG, 0, 0)
    return map, face, strip, truth, doors


def two_rooms(wider: int) -> PlanExample:
    """5 m and a little by 4 m each, with a door of 0.9 m."""
    nx, ny, middle = 106 + 2 * wider, 46, 52 + wider
    wall = np.zeros((nx, ny), bool)
    wall[1:3], wall[-3:-1], wall[:, 1:3], wall[:, -3:-1], wall[middle : middle + 2] = True, True, True, True, True
    wall[middle : middle + 2, 18:27] = False
    inside = ~wall
    inside[[0, -1]] = inside[:, [0, -1]] = False
    bands = build_profile_bands(EDGE)
    profile = np.where(wall, bands.build_mask(-0.3, 2.4), np.where(inside, bands.build_mask(-0.3, 0.3), 0)).astype(np.uint64)
    nowhere = np.full(wall.shape, np.nan)
    plan = StoreyPlan(np.zeros(2), EDGE, wall, inside, profile, bands, np.zeros(wall.shape), nowhere)
    room = np.full(wall.shape, -1, np.int16)
    room[inside] = (np.argwhere(inside)[:, 0] > middle).astype(np.int16)
    truth = np.full(wall.shape, TRUE_CLASSES.index("outside"), np.uint8)
    truth[inside], truth[wall] = TRUE_CLASSES.index("inside"), TRUE_CLASSES.index("wall")
    truth[middle : middle + 2, 18:27] = TRUE_CLASSES.index("doorway")
    return PlanExample(plan, room, truth, np.array([0, 1]), "drawn/procedural")


def door_tables(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features, answers that the first feature tells, and scans."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(count, 17))
    return x, x[:, 0] > 0, np.arange(count) % 8


def belief_rows(*_: Any) -> list[dict[str, Any]]:
    """Pairs with and without slices, whose right hypothesis brings more walls together, mostly."""
    rng, rows = np.random.default_rng(0), []
    for k in range(40):
        flat, hypotheses = k % 2 == 1, []
        for number in range(4):
            right = number == 0 and k % 3 > 0
            features = {name: float(abs(rng.normal())) for name in AMOUNTS} | {n: float(rng.uniform(0.2, 0.5)) for n in SHARES}
            features |= {"walls": 10.0 + 20 * right + rng.random(), "conflict": 1.0, "met": 0.5, "chance": 0.3}
            features["sliced"] = float(flat)
            closely = {"bent": {**features, **{name: float(rng.uniform(0.1, 1.0)) for name in WINNER_INPUTS}}}
            error = [0.1, 0.0, 1.0] if right else [5.0, 0.0, 90.0]
            pose = Sim3(0.0, (10.0 * number, 0.0, 0.0)).matrix.tolist()
            closely |= {"label": int(right), "rival": number < 3, "bent_pose": pose}
            hypotheses.append({**features, **closely, "err": error})
        row = {"name": str(k), "common": 30.0 + k, "kind": "overlap", "building": f"b{k}", "hyps": hypotheses}
        row["middle"] = [0.0, 0.0, 0.0]
        rows.append({**row, "sensors": ["tls", "laser2d" if flat else "depth"]})
    return rows


def place_files(folder: Path) -> list[Path]:
    """Pairs whose right hypothesis lays a square on itself, and whose wrong one on another square."""
    folder.mkdir(parents=True)
    rng, paths = np.random.default_rng(0), []
    for k in range(12):
        ground = rng.choice(np.array([1, 2, 2, 4], np.uint8), (8, 1, SIDE // 8, SIDE // 8)).repeat(8, axis=2).repeat(8, axis=3)
        parts = np.concatenate([ground, ground], axis=1)
        parts[4:, 1] = rng.permutation(parts[4:, 1].reshape(-1)).reshape(4, SIDE, SIDE)
        hyps = [{"label": 1, "bent": {}}, {"label": 0, "bent": {}}]
        row = {"building": f"b{k}", "kind": "overlap", "common": 90.0, "sensors": ["tls", "depth"], "hyps": hyps}
        arrays = {"row": np.frombuffer(json.dumps(row).encode(), np.uint8), "owner": np.repeat([0, 1], 4).astype(np.int16)}
        arrays |= {"parts": parts, "ceiling": np.full((8, 2, SIDE, SIDE), 60, np.uint8), "area": np.full(8, 20.0)}
        arrays |= {"looked": np.ones((8, 2, LOOKED), np.float32), "middle": np.zeros((8, 3)), "about": np.zeros(1, np.uint8)}
        paths.append(folder / f"{k}.npz")
        archive.write(arrays, paths[-1])
    return paths


AMOUNTS = ("free", "clutter", "level", "ceilings", "ceiling_area")
SHARES = ("ratio", "opposed", "conflict_share", "worst_conflict", "share")
WINNER_INPUTS = (
    "in_place", "by_chance", "pieces", "free", "tall_conflict", "crossing", "worst_ratio", "squares", "bad_squares",
    "moved_walls", "hanging_met", "hanging", "strain", "doubted", "repeats", "place_mean", "place_worst", "place_area",
)  # fmt: skip


def evidence(*_: Any) -> list[MatchEvidence]:
    """Hypotheses of which that with more evidence is right, and rooms of which those that fit are one."""
    rng, pairs = np.random.default_rng(0), []
    for k in range(12):
        right = np.array([k % 4 > 0, False, False])
        metres = np.column_stack([rng.uniform(1, 5, 3) + 30 * right, rng.uniform(1, 5, 3), rng.uniform(1, 20, 3)])
        one = rng.random(8) < 0.5
        rooms = np.column_stack([np.ones(8), one + rng.random(8), rng.random(8), np.zeros(8), np.zeros(8)])
        pairs.append(MatchEvidence(f"b{k}", compute_hypothesis_features(metres), right, rooms, one))
    return pairs


def match_rows(*_: Any) -> list[MatchRows]:
    """Matches that are as sure in each pair, and right in those whose places speak for it."""
    rng, rows = np.random.default_rng(0), []
    for k in range(12):
        sure, right = rng.random(6), np.full(6, k % 2 > 0)
        places = np.full(6, 9.0 if k % 2 else -9.0)
        x = np.column_stack([np.ones(6), np.log(sure / (1 - sure)), places, rng.random(6), *np.full((2, 6), 0.5)])
        rows.append(MatchRows(f"b{k}", k % 2 > 0, *(dict.fromkeys(BELIEVED_METHODS, v) for v in (x, sure, right))))
    return rows


def room_scans(recipe: PlanRecipe, *_: Any) -> list[dict[str, Any]]:
    """Rooms of scans of which those with a higher first feature were entered; every third scan has no poses."""
    rng, scans = np.random.default_rng(0), []
    for k in range(16):
        x = rng.random((9, len(GRID_FEATURES if recipe.flat and recipe.surroundings else ROOM_FEATURES)))
        p = rng.random((9, len(POSE_FEATURES)))
        scan = {"x": x, "one": x[:, 1] > 0.3, "whole": x[:, 2] > 0.5, "entered": x[:, 0] > 0.5, "outside": x[:, 3] < 0.1}
        scan["building"] = np.array(f"b{k}")
        scans.append(scan if k % 3 == 0 else {**scan, "posed.x": x, "posed.p": p, "posed.entered": p[:, 0] > 0.5})
    return scans


def feature_pairs(*_: Any) -> list[PairFeatures]:
    """Rooms whose features hardly differ between two maps."""
    rng, pairs = np.random.default_rng(0), []
    for k in range(6):
        a = rng.normal(size=(9, len(FEATURES)))
        b = a + 0.05 * rng.normal(size=a.shape)
        rows = np.arange(9)
        pairs.append(PairFeatures(f"b{k}", a, b, rows == 0, rows == 1, np.column_stack([rows, rows]), rows > 1))
    return pairs


def room_examples(count: int) -> list[MatcherExample]:
    """Pairs of maps of five rooms, of which the second one lacks the last room; it stands a quarter turn away."""
    rng = np.random.default_rng(0)
    out = []
    for _ in range(count):
        rows, places = rng.normal(size=(5, 4, 64)).astype(np.float32), rng.uniform(0, 20, (5, 2))
        rows /= np.linalg.norm(rows, axis=2, keepdims=True)
        back = places @ np.array([1, 1j]) * -1j
        away = np.column_stack([back.real, back.imag])
        sides = [(rows, places, 5), (np.roll(rows, 1, axis=1), away, 4)]
        views = [
            [
                MatcherView(TurnedRows(r[:n], p[:n] * (1, 1 - 2 * (k % 2)), "", np.zeros((n, FACTS))), np.arange(n))
                for k in range(2)
            ]
            for r, p, n in sides
        ]
        graphs = [{"x": torch.from_numpy(rng.uniform(5, 30, (n, 16)))} for _, _, n in sides]
        matches = torch.arange(4).repeat(2, 1).T
        truth = (torch.arange(5), torch.arange(4)), (torch.ones(5), torch.ones(4))
        pair = GraphPair(graphs[0], graphs[1], matches, *truth, {"file": "", "sides": "ab"}, torch.eye(4))
        out.append(MatcherExample(views[0], views[1], pair, 1))
    return out


def passages(count: int) -> list[Passage]:
    """Passages of which nothing but the plan speaks."""
    return [Passage((0, 0), 0.8, (1.0, 0.0), (0.0,) * 12)] * count


def passage_scans(count: int) -> list[PassageExamples]:
    """Scans with walls, in which a door is what the plan and, surer, the evidence says."""
    scans = []
    for k in range(count):
        rng = np.random.default_rng(k)
        shown = np.maximum(rng.normal(0, 3, 40), 0)
        parted = shown + rng.normal(0, 0.5, 40) > 0.5
        plan = np.where(parted, 1.0, -1.0) + rng.normal(0, 2, 40)
        scans.append(PassageExamples(rng.random((40, 17)), plan, shown, parted, "walls", f"b{k}"))
    return scans
