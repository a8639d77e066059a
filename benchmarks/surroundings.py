"""What is seen around rooms, put to the test: walls whose direction is taken wrong, and the crops without a network.

``python -m benchmarks.surroundings [MANIFEST] [--limit N] [--write docs/results/learning.md]``: of a cached set of evaluation
pairs (by default ``cache/evaluation/heldout.jsonl``, as of `retrieval.py`) those with rooms in common and of known scale. Is a
room's true partner the nearest? Beside it: for how many pairs the quarter turn between the maps is the true one.
``--real CACHE``: of real pairs (as of `retrieval.py`), by site.

Wrong axes: the embedder that ships; sheet and crops of the second map are drawn in a direction that is off from its walls.
Untrained: rooms are compared by the correlation of their main crops, pixel by pixel, at the quarter turn of the second map at
which crops are most alike. With them the network that sees both maps, at the turn of which it is surest; and the same as if the
scale of the second map were not known.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import numpy as np
from topomerge.datasets.pairs.evaluation_pair import EvaluationPair, load_set

from benchmarks.retrieval import HELDOUT, building, real_pairs
from topomerge.embedding import sheets
from topomerge.embedding.learned import Learned, load_embedder
from topomerge.embedding.surroundings import CROP_PART, CROP_PLANES, crops, quarter_turned_crops
from topomerge.embedding.turns import QUARTERS, TurnedRows, quarters_between
from topomerge.evaluation.groups import value
from topomerge.evaluation.score import Row, rank_counts
from topomerge.evaluation.tables import cell, write_section
from topomerge.matching.consistency import NEAR_SCALE
from topomerge.matching.costs import descriptor_costs
from topomerge.matching.room_matcher import room_odds
from topomerge.matching.unknown_scale import odds_at_best_scale
from topomerge.types import Array

WRONG_BY = (0, 2, 5, 10, 20, 45)  # degrees
COMPARED = ("wall", "floor", "low", "high")  # planes that are correlated
LEARNED, UNTRAINED, BOTH_SEEN = "embedder that ships", "correlation of crops", "network that sees both maps"
UNSCALED = "network that sees both maps, scale unknown"


def usable(pairs: Sequence[EvaluationPair]) -> list[EvaluationPair]:
    """Those with rooms in common and of known scale."""
    return [pair for pair in pairs if len(pair.matches) and pair.transform is not None and not pair.about["scale_free"]]


@contextmanager
def axes_off(degrees: float) -> Iterator[None]:
    """Sheets that are drawn meanwhile stand in a direction that is off from that of the walls, counter-clockwise."""
    right = sheets.wall_direction
    with patch.object(sheets, "wall_direction", lambda walls: right(walls) + np.radians(degrees)):
        yield


def ranks(pair: EvaluationPair, describe: Learned) -> list[Row]:
    """Counts of a pair's rooms, and is the turn right: with each direction of the second map's walls, then without a network."""
    a, b = pair.maps()
    read, other = describe.arrays(a), describe.arrays(b)
    rows = describe.graph(read)[0]
    head = {"pair": pair.name, "building": building(pair)}
    out = []
    for degrees in WRONG_BY:
        with axes_off(degrees):
            drawn = other | sheets.sheet_arrays(b)
        turned = describe.graph(drawn)[0]
        assert isinstance(rows, TurnedRows) and isinstance(turned, TurnedRows)
        right = quarters_between(rows, turned) == true_quarters(pair, read, drawn)
        counts = rank_counts(pair, descriptor_costs(rows, turned))
        out.append({**head, "way": LEARNED, "degrees": degrees, "turned": right, **counts})
    quarters, alike = likenesses(crops(read), crops(other))
    plain = describe.graph(other)[0]
    surest = max(room_odds(rows, plain), key=lambda turned: turned.sureness)
    scale, odds = odds_at_best_scale(rows, plain, describe.at_scales(b))
    unscaled = max(odds, key=lambda turned: turned.sureness)
    ways = [
        (UNTRAINED, quarters, alike),
        *((way, of.quarters, of.certainty) for way, of in ((BOTH_SEEN, surest), (UNSCALED, unscaled))),
    ]
    for way, turn, score in ways:
        right = turn == true_quarters(pair, read, other)
        out.append({**head, "way": way, "degrees": 0, "turned": right, "scale": scale, **rank_counts(pair, 1 - score)})
    return out


def true_quarters(pair: EvaluationPair, a: Mapping[str, Array], b: Mapping[str, Array]) -> int:
    """Quarter turns by which the sheet of b is truly to be turned so that it stands as that of a does, or nearly so.

    Args:
        a, b: arrays of the maps with the `turn` of their sheets.
    """
    assert pair.transform is not None
    return round((pair.transform.yaw + float(b["turn"][0]) - float(a["turn"][0])) / (np.pi / 2)) % QUARTERS


def likenesses(a: Array, b: Array) -> tuple[int, Array]:
    """Quarter turns of b at which the rooms of both maps have the highest mean likeness to that which is most like them by their
    crops `surroundings`; and (R_a, R_b) from -1 to 1 how alike they are then."""
    one = standard(a)
    turned = [one @ standard(quarter_turned_crops(CROP_PART, b, k)).T for k in range(QUARTERS)]
    best = int(np.argmax([np.concatenate([alike.max(axis=0), alike.max(axis=1)]).mean() for alike in turned]))
    return best, turned[best]


def standard(shown: Array) -> Array:
    """(R, n) pixels of the planes `COMPARED` less their mean, of length 1; zeros of a crop in which all are the same."""
    planes = shown[..., [CROP_PLANES.index(name) for name in COMPARED]]
    pixels = planes.reshape(len(shown), int(np.prod(planes.shape[1:]))).astype(np.float64)
    pixels -= pixels.mean(axis=1, keepdims=True)
    length = np.linalg.norm(pixels, axis=1, keepdims=True)
    out: Array = pixels / np.where(length > 0, length, 1.0)
    return out


def sizes(rows: Sequence[Row]) -> str:
    """What the tables are of."""
    one = [row for row in rows if row["way"] == UNTRAINED]
    queries = sum(row["queries"] for row in one)
    return (
        f"{len(one)} pairs of maps, {len({row['building'] for row in one})} buildings, {queries} rooms with a partner (both "
        f"directions); by chance recall@1 is {sum(row['chance'] for row in one) / max(queries, 1):.2f}. In brackets: 95 % "
        f"intervals over physical buildings; with fewer than eight their range."
    )


def table(title: str, named: Sequence[tuple[str, Sequence[Row]]]) -> str:
    """Named rows as Markdown."""
    lines = [f"| {title} | recall@1 | without twin | with twin | recall@5 | turn right |", "|" + "---|" * 6]
    for name, of in named:
        scores = [cell(value(of, "recall@1")), *(cell(value(of, f"recall@1_{twin}"), False) for twin in ("single", "twin"))]
        turned = f"{sum(row['turned'] for row in of)} of {len(of)} pairs"
        lines.append(f"| {name} | {' | '.join([*scores, cell(value(of, 'recall@5')), turned])} |")
    return "\n".join(lines)


def site_table(rows: Sequence[Row]) -> str:
    """Recall of each way by site, as Markdown."""
    ways = (UNTRAINED, LEARNED, BOTH_SEEN)
    lines = ["| site | pairs | rooms, both directions | " + " | ".join(f"{way}: recall@1 | recall@5" for way in ways) + " |"]
    lines.append("|" + "---|" * 9)
    rows = [row for row in rows if row["degrees"] == 0]
    for site in [*sorted({row["building"] for row in rows}), "all"]:
        of = [row for row in rows if site in (row["building"], "all")]
        each = [[row for row in of if row["way"] == way] for way in ways]
        cells = [cell(value(some, f"recall@{n}"), site == "all") for some in each for n in (1, 5)]
        lines.append(f"| {site} | {len(each[0])} | {sum(row['queries'] for row in each[0])} | {' | '.join(cells)} |")
    return "\n".join(lines)


def sections(rows: Sequence[Row]) -> dict[str, str]:
    """Tables by the marks of the sections that they are written to."""
    learned = {d: [row for row in rows if row["way"] == LEARNED and row["degrees"] == d] for d in WRONG_BY}
    plain, both, free = ([row for row in rows if row["way"] == way] for way in (UNTRAINED, BOTH_SEEN, UNSCALED))
    axes = table("second map's walls taken wrong by", [(f"{d}°", of) for d, of in learned.items()])
    twins = table("rooms compared by", [(UNTRAINED, plain), (LEARNED, learned[0]), (BOTH_SEEN, both), (UNSCALED, free)])
    near = sum(abs(np.log(row["scale"])) < np.log(NEAR_SCALE) for row in free)
    twins += (
        f"\n\nScale unknown: it is taken within {100 * (NEAR_SCALE - 1):.0f} % of the true one in {near} of {len(free)} pairs."
    )
    return {"axes": axes, "untrained": twins}


def main(words: Sequence[str] | None = None) -> int:
    """Measure, print, and write where asked."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.surroundings", description=__doc__)
    parser.add_argument("manifest", nargs="?", type=Path, default=HELDOUT)
    parser.add_argument("--limit", type=int, help="pairs that are measured, the first ones; all if left out")
    parser.add_argument("--real", type=Path, metavar="CACHE", help="real pairs, which are in this cache, by site")
    parser.add_argument("--write", type=Path, help="file whose sections `axes` and `untrained`, or `sites`, are replaced")
    args = parser.parse_args(words)
    describe = load_embedder()
    pairs = usable(real_pairs(args.real) if args.real else load_set(args.manifest))[: args.limit]
    rows = [row for pair in pairs for row in ranks(pair, describe)]
    command = " ".join(["python -m benchmarks.surroundings", *(sys.argv[1:] if words is None else words)])
    for mark, text in ({"sites": site_table(rows)} if args.real else sections(rows)).items():
        print(f"{sizes(rows)}\n\n{text}\n")
        if args.write:
            write_section(args.write, mark, f"`{command}`\n\n{sizes(rows)}\n\n{text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
