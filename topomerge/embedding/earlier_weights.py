"""Embedders of format 1, whose layers were the program's own, as what torch-geometric's layers take: the embeddings stay.

| format 1 | format 2 |
|---|---|
| `gat`: `here`, `there`, `edge`, `score` | `lin_r`, `lin_l`, `lin_edge`, `att` (1, heads, channels) |
| `gat`: `value`, `edge_value`, `out` | `lin_value`, `lin_edge_value`, `lin_out` of `EdgeValueConv` |
| `sage`: `own`, `around`, `beside.0` | `lin_r` and the bias of `lin_l`, `lin_l`, `lin_message` of `EdgeSAGEConv` |
| option `told` | option `edge_values` |

`GATv2Conv` has no matrix of values: attention of format 1 becomes `EdgeValueConv` in any case. Where `told` was false, edges add
0 to the values.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from topomerge.types import Array

ATTENTION_NAMES = {
    "here.weight": "lin_r.weight",
    "here.bias": "lin_r.bias",
    "there.weight": "lin_l.weight",
    "there.bias": "lin_l.bias",
    "edge.weight": "lin_edge.weight",
    "score": "att",
    "value.weight": "lin_value.weight",
    "value.bias": "lin_value.bias",
    "edge_value.weight": "lin_edge_value.weight",
    "out.weight": "lin_out.weight",
    "out.bias": "lin_out.bias",
}
SAGE_NAMES = {
    "own.weight": "lin_r.weight",
    "own.bias": "lin_l.bias",
    "around.weight": "lin_l.weight",
    "beside.0.weight": "lin_message.weight",
    "beside.0.bias": "lin_message.bias",
}


def format_2_network(network: Mapping[str, Any]) -> dict[str, Any]:
    """The table of a network of format 1 with the keys of today."""
    node = network.get("node", {})
    if not isinstance(node, Mapping) or "told" not in node:
        return dict(network)
    renamed = {key: value for key, value in node.items() if key != "told"} | {"edge_values": True}
    return {**network, "node": renamed}


def format_2_weights(network: Mapping[str, Any], weights: Mapping[str, Array]) -> dict[str, Array]:
    """Weights of format 1 by their names of today.

    Args:
        network: the table of format 1, as it stood beside the weights.

    Raises:
        ValueError: a layer is of another shape than any network's.
    """
    node = network.get("node", {})
    names = {"gat": ATTENTION_NAMES, "sage": SAGE_NAMES}.get(str(node.get("kind", "gat")), {})
    converted: dict[str, Array] = {}
    for name, array in weights.items():
        words = name.split(".", 3)
        if words[:2] != ["node", "layers"] or len(words) < 4:
            converted[name] = array
            continue
        layer = ".".join(words[:3])
        converted[f"{layer}.{names.get(words[3], words[3])}"] = array[None] if words[3] == "score" else array
        if words[3] == "edge.weight" and f"{layer}.edge_value.weight" not in weights:
            converted[f"{layer}.lin_edge_value.weight"] = np.zeros_like(array)
    return converted
