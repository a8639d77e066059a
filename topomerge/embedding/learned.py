"""Embedders by name: engineered, spectral, learned."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.archive import find_weights_file
from topomerge.embedding.engineered import (
    add_context,
    build_engineered,
    build_feather,
    compute_door_layout,
    compute_point_features,
    compute_point_spectra,
)
from topomerge.embedding.graph import (
    POINTS_PER_ROOM,
    TABLES,
    add_proximity_edges,
    build_graph_arrays,
    count_columns,
    rescale_graph,
)
from topomerge.embedding.network import (
    LANDMARK_PART,
    Network,
    build_embedder_signature,
    build_network,
    find_tensor,
    list_tensors,
)
from topomerge.embedding.quarter_turns import (
    Descriptor,
    Rows,
    TurnedRows,
    compute_edge_positions,
    compute_room_features,
    compute_similarity,
    rotate_graph,
    rotate_to_walls,
)
from topomerge.embedding.shapedna import build_shapedna
from topomerge.embedding.surroundings import CROP_SHAPES, cut_crops
from topomerge.errors import InputError
from topomerge.networks.network import WEIGHTS_PACKAGE, Run, card_of, open_network, read_card
from topomerge.numpy_nn import softmax
from topomerge.types import Array, TopometricMap

EMBEDDER_FORMAT = 3
EMBEDDER_CLASS = "topomerge.models.Embedder"
EMBEDDER_FILE = "embedder.onnx"
PRETRAINED = "pretrained"  # names the embedder that ships
STATE_FILE, STATE_SETTINGS = "embedder.safetensors", "embedder.json"  # of a training under way, and of earlier versions


@dataclass(frozen=True, eq=False)
class EmbedderCard:
    """The card of an embedder.

    Args:
        path: of its network.
        network: what it is made of.
        temperature: that divides similarities.
        about: on what it was trained, how good it is.
        digest: of its file, which its rows are marked with.
        values: all that the card says.
    """

    path: Path
    network: Network
    temperature: float
    about: dict[str, Any]
    digest: str
    values: dict[str, Any]


def find_embedder(path: str | Path | None = None) -> Path:
    """Find the network of an embedder.

    Args:
        path: a file, the folder that it is in, or a run, whose best embedder is taken; `PRETRAINED` or None: the one that ships.

    Raises:
        InputError: there is none.
    """
    if path is None or (str(path) == PRETRAINED and not Path(path).exists()):
        return find_weights_file(WEIGHTS_PACKAGE, EMBEDDER_FILE)
    path = Path(path)
    if path.suffix == Path(EMBEDDER_FILE).suffix:
        return path
    for folder in (path, path / "best"):
        if (folder / EMBEDDER_FILE).exists():
            return folder / EMBEDDER_FILE
    if find_state(path):
        raise InputError(
            f"{path}: holds weights of torch, of a training that has not ended or of an earlier version; run topomerge "
            f"export-embedder {path} -o FOLDER, and give FOLDER"
        )
    raise InputError(f"{path / EMBEDDER_FILE}: No such file; give a run's folder, or one of export-embedder")


def find_state(path: str | Path) -> Path | None:
    """Find the folder with weights of torch: the path itself, that of one of the files, or the best of a run; None without."""
    path = Path(path)
    folder = path.parent if path.name in (STATE_FILE, STATE_SETTINGS) else path
    return next((place for place in (folder, folder / "best") if (place / STATE_SETTINGS).exists()), None)


def read_embedder_card(path: str | Path | None = None) -> EmbedderCard:
    """Read what is known of an embedder; `path` as of `find_embedder`.

    Raises:
        InputError: there is none, its card is damaged, of another format or class, or it was trained on other features.
    """
    file = find_embedder(path)
    values = read_card(file)
    card = card_of(file)
    network = check_settings(card, values, EMBEDDER_FORMAT)
    temperature = values.get("temperature")
    if not isinstance(temperature, float) or not 0 < temperature <= 1:
        raise InputError(f"{card}: temperature must be above 0 and at most 1, not {str(temperature)[:20]}; export it again")
    return EmbedderCard(file, network, temperature, dict(values["about"]), values["sha256"], values)


def describe_embedder(network: Network, about: Mapping[str, Any] | None) -> dict[str, Any]:
    """Describe a network, as both kinds of files do: its architecture, the features that it reads, and its training."""
    features = {name: list(TABLES[name]) for name in list_tensors(network) if name in TABLES}
    return {"class": EMBEDDER_CLASS, "network": asdict(network), "features": features, "about": dict(about or {})}


def build_card(network: Network, temperature: float, about: Mapping[str, Any] | None) -> dict[str, Any]:
    """Build the card of an embedder, but for its file."""
    known = {"format": EMBEDDER_FORMAT, "temperature": temperature, **describe_embedder(network, about)}
    return build_embedder_signature(network).describe() | known


def check_settings(path: Path, values: Mapping[str, Any], format_number: int) -> Network:
    """Return the network that the settings of a file describe; its encoders need not be known here, only what it reads.

    Raises:
        InputError: of another format or class, incomplete, or trained on other features.
    """
    if values.get("class") != EMBEDDER_CLASS:
        of = str(values.get("class") or values.get("task"))[:60]
        raise InputError(f"{path}: is no embedder ({of!r}, not {EMBEDDER_CLASS}); give a run of task=embedding, or {PRETRAINED}")
    if values.get("format") != format_number:
        raise InputError(
            f"{path}: has format {str(values.get('format'))[:20]}, this version reads {format_number}; export it with the "
            f"version that wrote it, or train it again"
        )
    needs = {"network": dict, "sha256": str, "about": dict, "features": dict}
    if not all(isinstance(values.get(key), kind) for key, kind in needs.items()):
        raise InputError(f"{path}: lacks {', '.join(needs)}; export it again")
    try:
        network = build_network(values["network"], known=False)
    except InputError as error:
        raise InputError(f"{path}: {str(error)[:300]}; export it again") from error
    for name, columns in describe_embedder(network, None)["features"].items():
        trained = values["features"].get(name)
        if trained != columns:
            trained = trained if isinstance(trained, list) else []
            differing = [str(column)[:40] for column in (*trained, *columns) if (column in trained) != (column in columns)]
            what = ", ".join(differing[:3]) or "their order"
            raise InputError(
                f"{path}: was trained on {len(trained)} columns of {name}, this version has {len(columns)} (other: {what}); "
                f"train it again"
            )
    return network


POINT_TABLES = {
    "engineered": compute_point_features,
    "shapedna": compute_point_spectra,
}  # computed from the points where a network reads them


def load_embedder(path: str | Path | None = None) -> LearnedEmbedder:
    """Return a trained embedder. Neither torch, Hydra nor the training code is needed.

    Args:
        path: a run, or what `topomerge export-embedder` wrote; None: the one that ships with the package.

    Raises:
        InputError: no embedder there, or damaged, of another format or class, or trained on other features.
    """
    card = read_embedder_card(path)
    run = _open_unchanged(card.path, card.digest, (_read_stamp(card.path), _read_stamp(card_of(card.path))))
    return LearnedEmbedder(run, card.network, card.temperature, card.about, card.digest)


@lru_cache(maxsize=2)
def _open_unchanged(path: Path, digest: str, stamps: tuple[tuple[int, int], ...]) -> Run:
    """Open a network once for all that load it: it takes a tenth of a second, and an atlas does so for each of its maps.

    Args:
        stamps: of the file and its card, so that others in their place are read.
    """
    card = read_embedder_card(path)
    return open_network(path, digest, build_embedder_signature(card.network), card.values)


def _read_stamp(path: Path) -> tuple[int, int]:
    """Return the date and size of a file; zeros where there is none, which who opens it explains."""
    status = path.stat() if path.exists() else None
    return (status.st_mtime_ns, status.st_size) if status else (0, 0)


class LearnedEmbedder:
    """Callable map -> (R, D) float64 of length 1, or `TurnedRows`; the same map gives the same rows.

    Args:
        run: as of `build_embedder_signature`.
        network: what it is made of.
        temperature: that divides similarities.
        about: on what it was trained, how good it is.
        embedder: hash of its weights, which its rows are marked with.
    """

    def __init__(
        self, run: Run, network: Network, temperature: float, about: Mapping[str, Any] | None = None, embedder: str = ""
    ) -> None:
        self.run, self.network, self.temperature, self.about = run, network, temperature, dict(about or {})
        self.embedder = embedder

    def __call__(self, map: TopometricMap) -> Rows:
        return self.embed_views(self.build_views(map))[0]

    def at_scales(self, map: TopometricMap) -> Callable[[float], Rows]:
        """Return a function that embeds a map of unknown scale, given the m that its unit is taken for."""
        of_map = self._build_graph_arrays(map)

        def rows(scale: float) -> Rows:
            return self.embed_views(self._add_sheets(rescale_graph(of_map, scale), map, scale))[0]

        return rows

    def compute_matchability(self, map: TopometricMap) -> Array:
        """Return (R,) float64: how alike a room of another map must at least be, as a cosine, before it is rather this one than
        none."""
        return self.temperature * self.embed_graph(self.build_views(map)[0])[1]

    def compute_probabilities(self, a: TopometricMap, b: TopometricMap) -> tuple[Array, Array]:
        """Compute the probabilities that each room of a (R_a, R_b + 1) is each of b, in the last place none of them; and of b
        likewise (R_b, R_a + 1)."""
        (ea, da), (eb, db) = (self.embed_views(self.build_views(m)) for m in (a, b))
        logits = compute_similarity(ea, eb) / self.temperature
        return softmax(np.column_stack([logits, da])), softmax(np.column_stack([logits.T, db]))

    def embed_views(self, views: Sequence[Mapping[str, Array]]) -> tuple[Rows, Array]:
        """Return embeddings of a map in each direction of its walls (`build_views`), and dustbins of the first one."""
        (first, dustbin), *others = (self.embed_graph(arrays) for arrays in views)
        if not isinstance(first, TurnedRows):
            return first, dustbin
        return replace(first, others=tuple(rows for rows, _ in others if isinstance(rows, TurnedRows))), dustbin

    def embed_graph(self, arrays: Mapping[str, Array]) -> tuple[Rows, Array]:
        """Return embeddings and dustbins (R,), as logits, of what `arrays` gives."""
        turns = self.network.turns
        if not len(arrays["x"]):
            none = np.zeros((0, turns, self.network.size))
            return (none[:, 0] if turns == 1 else TurnedRows(none, np.zeros((0, 2)), self.embedder)), np.zeros(0)
        inputs, names = dict(arrays), list_tensors(self.network)
        if self.network.node.around:
            inputs |= add_proximity_edges(inputs, self.network.node.around)
        inputs |= {n: compute(arrays["room_points"]) for n, compute in POINT_TABLES.items() if n in names and n not in arrays}
        if LANDMARK_PART in names and LANDMARK_PART not in arrays:
            inputs[LANDMARK_PART] = np.zeros((len(arrays["x"]), count_columns(LANDMARK_PART)), np.float32)
        if "near_index" in names and "near_index" not in arrays:
            layout = compute_door_layout(*(arrays[n] for n in ("edge_index", "pos", "edge_pos")))
            inputs |= dict(zip(("near_index", "near_attr"), layout, strict=True))
        inputs |= {part: cut_crops(inputs, part) for part in CROP_SHAPES if part in names and part not in inputs}
        if "edge_way" in names:
            inputs["edge_way"] = compute_edge_positions(inputs)
        read = {name: inputs[name] for name in names}
        # One call a turn: a graph with all four has four times as many nodes to export and to load (docs/adr/0025).
        computed = [self.run(**(rotate_graph(read, k) if k else read)) for k in range(turns)]
        rows, bins = ([array.astype(np.float64) for array in arrays] for arrays in zip(*computed, strict=True))
        if turns == 1:
            return rows[0], bins[0]
        dustbin = np.mean(bins, axis=0)
        features = compute_room_features(arrays["x"], dustbin, arrays["pos"][:, 2])
        direction = float(arrays["turn"][0]) if len(arrays["turn"]) else 0.0
        return TurnedRows(np.stack(rows, axis=1), rotate_to_walls(arrays), self.embedder, features, direction), dustbin

    @property
    def needs_points(self) -> bool:
        """Does the network read the points of rooms, or what is reckoned from them?"""
        return bool({find_tensor(part) for part in self.network.geometry.parts} - {"x", LANDMARK_PART, *CROP_SHAPES})

    def build_views(self, map: TopometricMap) -> list[dict[str, Array]]:
        """Build the arrays of a map that `embed_graph` takes, in each direction of its walls, the first one first."""
        return self._add_sheets(self._build_graph_arrays(map), map, 1.0)

    def _add_sheets(self, arrays: dict[str, Array], map: TopometricMap, scale: float) -> list[dict[str, Array]]:
        if self.network.turns == 1:
            return [arrays]
        from topomerge.embedding.sheets import build_tilted_sheet_arrays  # here: a machine that only trains reads no maps

        return [arrays | sheet for sheet in build_tilted_sheet_arrays(map, scale)]

    def _build_graph_arrays(self, map: TopometricMap) -> dict[str, Array]:
        return build_graph_arrays(map, POINTS_PER_ROOM if self.needs_points else 1)


def load_learned(path: str | None = None) -> Descriptor:
    """Return the trained embedder in a folder (see `topomerge.load_embedder`), or the one that ships with the package."""
    return load_embedder(path)


EMBEDDERS: dict[str, Callable[..., Descriptor]] = {
    "learned": load_learned,
    "engineered": build_engineered,
    "shapedna": build_shapedna,
    "feather": build_feather,
}
DEFAULT = "learned"


def get_descriptor_name(name: str | Descriptor) -> str:
    """Return the name of a descriptor for reports, or that of a callable."""
    return name if isinstance(name, str) else getattr(name, "__name__", type(name).__name__)


def build_embedder(name: str | Descriptor = DEFAULT, k: int = 0, context: str = "join", **options: Any) -> Descriptor:
    """Return a callable map -> (R, D) float64.

    Args:
        name: ``"learned"``, ``"engineered"``, ``"shapedna"``, ``"feather"``, the run or file of a trained one, or a descriptor.
        k: steps of context (see `add_context`).
        context: ``"join"`` or ``"mean"``.
        options: those of the function of that name.

    Raises:
        InputError: unknown name or option.
    """
    if callable(name):
        if options:
            raise InputError(f"options {', '.join(options)} are for embedders that are named, not for a callable")
        return add_context(name, k, context)
    if name and name not in EMBEDDERS and (Path(name).is_dir() or Path(name).suffix == Path(EMBEDDER_FILE).suffix):
        return build_embedder("learned", k, context, path=name, **options)
    if name not in EMBEDDERS:
        raise InputError(f"unknown descriptor {name!r}: {', '.join(EMBEDDERS)} or the run or file of a trained one are possible")
    make = EMBEDDERS[name]
    unknown = set(options) - set(inspect.signature(make).parameters)
    if unknown:
        raise InputError(f"{name} has no option {', '.join(sorted(unknown))}: {', '.join(inspect.signature(make).parameters)}")
    return add_context(make(**options), k, context)
