"""The files of an embedder: where its network is, and what its card says of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from topomerge.archive import find_weights_file
from topomerge.embedding.graph import TABLES
from topomerge.embedding.network import Network, build_embedder_signature, build_network, list_tensors
from topomerge.errors import InputError
from topomerge.networks.network import WEIGHTS_PACKAGE, card_of, read_card

EMBEDDER_FORMAT = 3
EMBEDDER_CLASS = "topomerge.models.Embedder"
EMBEDDER_FILE = "embedder.onnx"
PRETRAINED = "pretrained"  # names the embedder that ships
STATE_FILE, STATE_SETTINGS = "embedder.safetensors", "embedder.json"  # of a training under way, and of earlier versions


@dataclass(frozen=True, eq=False)
class EmbedderCard:
    """What is known of an embedder.

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
    """What both kinds of files say of a network: of its architecture, of the features that it reads, and of its training."""
    features = {name: list(TABLES[name]) for name in list_tensors(network) if name in TABLES}
    return {"class": EMBEDDER_CLASS, "network": asdict(network), "features": features, "about": dict(about or {})}


def build_card(network: Network, temperature: float, about: Mapping[str, Any] | None) -> dict[str, Any]:
    """What the card of an embedder says, but for its file."""
    known = {"format": EMBEDDER_FORMAT, "temperature": temperature, **describe_embedder(network, about)}
    return build_embedder_signature(network).describe() | known


def check_settings(path: Path, values: Mapping[str, Any], format_number: int) -> Network:
    """Return the network that the settings of a file describe; its encoders need not be known here, only what it reads.

    Raises:
        InputError: of another format or class, incomplete, or trained on other features.
    """
    if values.get("class") != EMBEDDER_CLASS:
        raise InputError(f"{path}: is of class {str(values.get('class'))[:60]!r}, not {EMBEDDER_CLASS}")
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
