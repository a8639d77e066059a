"""How much maps of each sensor bend: relative shift and turn of places that lie some metres apart.

    python -m benchmarks.merging.drift 24 topomerge/registration/bend/drift.json

Simulated maps of buildings to train on, of which the drift is known at every place, are cut into pieces of 3 m. The drift moves
each piece by a rigid move. The moves of two pieces carry the point in the middle between them to two places: the distance of
those is the relative shift (each of its two coordinates counts), and the difference of their yaw the relative turn. Neither
depends on how the map lies as a whole. A walk that goes astray at random has variances that grow with the distance d:
shift² = s² d, turn² = t² d.

Of the office floor to choose by (`datasets.real.office_floor`) key points tell the drift, against its drawing: a piece is a key
point with those nearest to it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from topomerge.datasets.pairs.bent_pairs import BENT_SENSORS, DRAWING, BentMaker, Undrift, bent_items, drifted_scan
from topomerge.datasets.pairs.items import plans_of
from topomerge.datasets.real.halmstad import fit_points
from topomerge.datasets.real.office_floor import OFFICE_PIXEL

from benchmarks.real_data import real_data
from topomerge.errors import InputError
from topomerge.io.atomic import replacing
from topomerge.types import Array

UNKNOWN = "unknown"  # sensor: as the captures of the office floor
PIECE = 3.0  # m
FEWEST_PLACES = 12  # of a piece: of slices, walls only
DISTANCES = (2.0, 4.0, 7.0, 12.0, 20.0, 35.0)  # m, ends of the classes
FITTED = (2.0, 12.0)  # m, classes that stiffness is fitted to: as far apart as neighbouring pieces are
FITTED_MARKED = (7.0, 20.0)  # m, of the office floor, whose pieces are wider
RAYS = 60_000  # of a map
KEY_POINTS = 8  # of a piece of the office floor: fewer tell how well they were marked (0.16 m), not how the map bends
FEWEST_MARKED = 12  # key points that a capture and the drawing must have in common


@dataclass(frozen=True, eq=False)
class Relative:
    """Pairs of pieces: distance (n,) m, shift (n, 2) m and turn (n,) rad of the one relative to the other."""

    distance: Array
    shift: Array
    turn: Array


def rigid_moves(points: Array, shifts: Array, owner: Array, fewest: int = FEWEST_PLACES) -> tuple[Array, Array]:
    """Middles (k, 2) and moves (k, 3: dx, dy, turn) of pieces, each fitted to the shifts of its points with least squares.

    Args:
        points, shifts: (n, 2) m.
        owner: (n,) piece of each point.
        fewest: points of a piece; those with fewer are left out.
    """
    _, of, count = np.unique(owner, return_inverse=True, return_counts=True)
    x, u = points @ (1, 1j), shifts @ (1, 1j)
    mean_x, mean_u = (np.bincount(of, v.real) / count + 1j * np.bincount(of, v.imag) / count for v in (x, u))
    rel = x - mean_x[of]
    cross = np.bincount(of, (np.conj(rel) * (rel + u - mean_u[of])).imag)
    along = np.bincount(of, (np.conj(rel) * (rel + u - mean_u[of])).real)
    many = count >= fewest
    moves = np.column_stack([mean_u.real, mean_u.imag, np.arctan2(cross, along)])[many]
    return np.column_stack([mean_x.real, mean_x.imag])[many], moves


def relative(middles: Array, moves: Array) -> Relative:
    """Every pair of pieces, once."""
    i, j = np.triu_indices(len(middles), 1)
    apart = middles[j] - middles[i]
    half = apart / 2

    def carried(k: Array, arm: Array) -> Array:
        z = arm @ (1, 1j) * (np.exp(1j * moves[k, 2]) - 1)
        return moves[k, :2] + np.column_stack([z.real, z.imag])

    return Relative(np.hypot(*apart.T), carried(j, -half) - carried(i, half), moves[j, 2] - moves[i, 2])


def pieces_of(undrift: Undrift) -> Relative:
    """The pairs of pieces of a map, of each storey and room by itself."""
    shown = undrift.rooms >= 0
    xy, shifts = undrift.places[shown, :2], undrift.shifts[shown, :2]
    cells = np.column_stack([np.floor(xy / PIECE).astype(np.int64), undrift.rooms[shown]])
    owner = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    middles, moves = rigid_moves(xy, shifts, owner)
    return relative(middles, moves)


def classes(pairs: Sequence[Relative]) -> list[dict[str, float]]:
    """By distance: number of pairs, their mean distance, standard deviation of shift (one coordinate) and turn.

    Each map counts alike in a class: large maps have most pairs.
    """
    rows = []
    for low, high in pairwise(DISTANCES):
        values = []
        for p in pairs:
            in_class = (p.distance >= low) & (p.distance < high)
            if in_class.any():
                shift2, turn2 = (p.shift[in_class] ** 2).mean(), (p.turn[in_class] ** 2).mean()
                values.append((p.distance[in_class].mean(), shift2, turn2, in_class.sum()))
        if values:
            d, shift2, turn2, _ = np.mean(values, axis=0)
            rows.append(
                {
                    "low": low,
                    "high": high,
                    "maps": len(values),
                    "pairs": float(np.sum(values, axis=0)[3]),
                    "distance": float(d),
                    "shift": float(np.sqrt(shift2)),
                    "turn": float(np.sqrt(turn2)),
                }
            )
    return rows


def stiffness(rows: Sequence[dict[str, float]], fitted: tuple[float, float] = FITTED) -> dict[str, float]:
    """m and rad per square root of a metre: the root of the mean of variance over distance in the classes within `fitted`, m."""
    near = [r for r in rows if fitted[0] <= r["low"] and r["high"] <= fitted[1]]
    return {k: float(np.sqrt(np.mean([r[k] ** 2 / r["distance"] for r in near]))) for k in ("shift", "turn")}


def simulated(maps: int, folder: str) -> dict[str, list[Relative]]:
    """The pieces of simulated maps by every sensor, each of the same buildings and rooms."""
    items, plans = bent_items("train", folder, maps)
    out: dict[str, list[Relative]] = {sensor: [] for sensor in BENT_SENSORS}
    for item in items:
        maker = BentMaker(replace(item, storeys=1), list(plans_of(item, plans)))
        for sensor in BENT_SENSORS:
            try:
                building, visited, frames = maker.place
                _, undrift = drifted_scan(building, sensor, 1.0, visited[0], [item.seed, 0], frames[0], RAYS)
                out[sensor].append(pieces_of(undrift))
            except InputError as error:  # no such parts, or a room that can't be reached
                print(f"{sensor}: {error}", file=sys.stderr)
    return out


def office_floor(folder: Path) -> list[Relative]:
    """The pieces of the captures of the office floor, against its drawing: each key point and those nearest to it."""
    listed = json.loads((folder / "ground_truth_pairs.json").read_bytes())
    points = {name: np.array(p, float).reshape(-1, 2) * OFFICE_PIXEL for name, p in listed["keypoints_px"].items()}
    out = []
    for pair in listed["pairs"]:
        if not pair["b"].endswith("layout") or len(pair["idx"]) < FEWEST_MARKED:
            continue
        same = np.array(pair["idx"], int)
        capture, drawn = points[pair["a"]][same[:, 0]], points[pair["b"]][same[:, 1]]
        true = fit_points(capture, drawn).apply(np.column_stack([drawn, np.zeros(len(drawn))]))[:, :2]
        near = cKDTree(capture).query(capture, KEY_POINTS)[1]
        owner = np.repeat(np.arange(len(capture)), KEY_POINTS)
        out.append(relative(*rigid_moves(capture[near.ravel()], (true - capture)[near.ravel()], owner, 2)))
    return out


def main(maps: str = "24", target: str = "") -> None:
    """Print the tables, and write the stiffness of each sensor."""
    folder = real_data()
    measured = simulated(int(maps), str(folder))
    measured[UNKNOWN] = office_floor(folder / "halmstad_office_f5")
    out: dict[str, dict[str, float]] = {DRAWING: {"shift": 0.0, "turn": 0.0}}
    for sensor, pairs in measured.items():
        rows = classes(pairs)
        out[sensor] = {k: round(v, 5) for k, v in stiffness(rows, FITTED_MARKED if sensor == UNKNOWN else FITTED).items()}
        print(f"{sensor}: shift {out[sensor]['shift']:.4f} m/sqrt(m), turn {out[sensor]['turn']:.5f} rad/sqrt(m)")
        for r in rows:
            root = np.sqrt(r["distance"])
            values = [r[k] for k in ("low", "high", "maps", "pairs", "distance")]
            apart = "{:4.0f}-{:2.0f} m  maps {:3.0f}  pairs {:7.0f}  mean {:5.1f} m".format(*values)
            shift, turn = f"{r['shift']:.4f} m ({r['shift'] / root:.4f})", f"{np.degrees(r['turn']):.3f} deg"
            print(f"  {apart}  shift {shift}  turn {turn} ({r['turn'] / root:.5f})")
    if target:
        with replacing(Path(target)) as beside:
            beside.write_text(json.dumps(out, indent=1, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
