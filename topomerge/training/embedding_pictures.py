"""Pictures of an embedder under way, for TensorBoard: its embeddings, and the rooms that it matches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from topomerge.matching.scores import assign_certain, certainty
from topomerge.models.embedder import Embedder, match_scores
from topomerge.training.packed import GraphPair
from topomerge.training.validate import embed

PROJECTED_PAIRS = 12  # in the embedding projector


def show_embedder(board: Any, network: Embedder, pairs: Sequence[GraphPair], epoch: int, least: float, device: Any) -> None:
    """Embedding projector and a figure of matched rooms.

    Args:
        board: TensorBoard's writer; None: nothing is shown.
        least: certainty of a match that is drawn.
    """
    matched_pairs = [pair for pair in pairs if len(pair.matches)][:PROJECTED_PAIRS]
    if board is None or not matched_pairs:
        return
    sides = embed(network, matched_pairs, device)
    labels = [f"{k // 2}{'ab'[k % 2]} {int(t)}" for k, rooms in enumerate(_true_rooms(matched_pairs)) for t in rooms]
    board.add_embedding(np.concatenate([e.numpy() for e, _ in sides]), labels, global_step=epoch, tag="rooms")
    board.add_figure("matched rooms", figure(network, matched_pairs[0], sides[0], sides[1], least), epoch)


def _true_rooms(pairs: Sequence[GraphPair]) -> list[Any]:
    return [true.tolist() for pair in pairs for true in pair.true]


def figure(network: Embedder, pair: GraphPair, a: tuple[Any, Any], b: tuple[Any, Any], least: float) -> Any:
    """Two maps beside each other with the matches that were made: right ones green, wrong ones red, missing ones grey."""
    rows, columns = match_scores(a[0], b[0], a[1], b[1], float(network.temperature.detach()))
    matches = {(i, j) for i, j in assign_certain(certainty(rows.exp().numpy(), columns.exp().numpy()), least).tolist()}
    true = {(i, j) for i, j in pair.matches.tolist()}
    places = [graph["pos"][:, :2].numpy() for graph in (pair.a, pair.b)]
    places = [p - p.min(axis=0) for p in places]
    places[1] = places[1] + [places[0][:, 0].max() + 8, 0]
    out = Figure(figsize=(9, 4), layout="constrained")
    axes = out.add_subplot()
    for graph, place in zip((pair.a, pair.b), places, strict=True):
        for i, j in graph["edge_index"].T.tolist():
            axes.plot(*place[[i, j]].T, color="0.8", lw=1, zorder=0)
        axes.scatter(place[:, 0], place[:, 1], s=4 * graph["x"][:, 0].numpy(), color="0.6", zorder=1)
    for i, j in matches | true:
        color = "tab:green" if (i, j) in matches & true else "tab:red" if (i, j) in matches else "0.6"
        axes.plot(*np.stack([places[0][i], places[1][j]]).T, color=color, lw=1.2, ls="-" if (i, j) in matches else ":", zorder=2)
    axes.set_aspect("equal")
    axes.set_axis_off()
    counts = f"{len(matches & true)} right, {len(matches - true)} wrong, {len(true - matches)} missing"
    axes.set_title(f"{pair.about.get('building', '')}: {counts}")
    return out
