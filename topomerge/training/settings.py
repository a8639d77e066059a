"""Settings of a training as one dataclass, and what they may be."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, make_dataclass
from pathlib import Path
from typing import Any

from topomerge.embedding.network import Network, build_network
from topomerge.embedding.network import check as check_network
from topomerge.errors import InputError
from topomerge.models.losses import LossSettings
from topomerge.models.losses import check as check_loss
from topomerge.registry import DATASETS, LOGGERS, NO_LOGGER, OPTIMIZERS, SAMPLERS, SCHEDULES, load_plugins


def check_numbers(settings: Mapping[str, Any], above: str = "") -> None:
    """Refuse numbers that are not finite.

    Raises:
        InputError: names the key.
    """
    for key, value in settings.items():
        if isinstance(value, Mapping):
            check_numbers(value, f"{above}{key}.")
        elif isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"{above}{key} must be a finite number, not {value}")


def check_descent(settings: NetworkSettings) -> None:
    """Refuse optimizers and schedules that are not registered, and numbers that train nothing.

    Raises:
        InputError: names the key.
    """
    OPTIMIZERS.check(settings.optimizer)
    SCHEDULES.check(settings.schedule)
    if not settings.rate > 0:
        raise InputError(f"rate must be above 0, not {settings.rate}")
    if settings.decay < 0:
        raise InputError(f"decay must be 0 or more, not {settings.decay}")
    if not 0 <= settings.ema < 1:
        raise InputError(f"ema must be 0 or more and below 1, not {settings.ema}")
    for key in ("epochs", "batch", "devices", "top"):
        if getattr(settings, key) < 1:
            raise InputError(f"{key} must be 1 or more, not {getattr(settings, key)}")
    if settings.compile:
        _check_compile(settings)


def _check_compile(settings: NetworkSettings) -> None:
    """Refuse settings that compiled steps cannot be combined with."""
    if settings.devices > 1:
        raise InputError(f"compile=true is for one process, not devices={settings.devices}; leave one of them out")
    if settings.anomaly:
        raise InputError("compile=true hides the operations that anomaly=true names; leave one of them out")
    if getattr(settings, "graphs", False) and getattr(settings, "accelerator", "cpu") != "cpu":
        raise InputError("compile=true cannot be combined with steps as CUDA graphs; add graphs=false, or leave it out")


def _check_run(settings: RunSettings) -> None:
    """Refuse a name of no folder, and loggers that are not registered."""
    if not settings.name or Path(settings.name).is_absolute() or ".." in Path(settings.name).parts:
        raise InputError(f"name must name a folder inside {settings.runs}, not {settings.name!r}")
    for name in settings.logger:
        if name != NO_LOGGER:
            LOGGERS.check(name)


@dataclass
class RunSettings:
    """Settings of every run.

    Args:
        task: which of the learned parts.
        name: of the run; its folder is `runs`/`name`.
        cache: folder of the data.
        plugins: modules that are imported first, as they register something (`topomerge.registry`).
        logger: of `topomerge.registry.LOGGERS`, beside metrics.jsonl; ``none``: no other.
        resume: go on where the run of this name stopped, with the same settings; overwrite: replace that run.
        export: where the best weights go at the end: `package`, or a folder; empty: they stay in the run's.
    """

    task: str = ""
    name: str = "run"
    runs: str = "runs"
    cache: str = "cache"
    seed: int = 0
    plugins: list[str] = field(default_factory=list)
    logger: list[str] = field(default_factory=lambda: ["tensorboard"])
    resume: bool = False
    overwrite: bool = False
    export: str = ""

    @property
    def folder(self) -> Path:
        """Where the run is written."""
        return Path(self.runs) / self.name


@dataclass
class NetworkSettings(RunSettings):
    """Settings of a run that trains a network.

    Args:
        epochs: at most; rate: of learning; decay: of weights; batch: examples a step, of each process.
        optimizer, schedule: of `topomerge.registry`; optimizer_options: of the optimizer, by name.
        patience: epochs without a better validation after which it ends; 0: never.
        watch: what is best: a score of validation.
        devices: processes that train together.
        ema: decay, a step, of the moving average of the weights that is validated, kept and exported; 0: the weights themselves.
        top: so many of the best epochs are kept, in `top/`; 1: the best one only, in `best/`.
        profile: write a trace of a few steps, `trace.json`.
        anomaly: name the operation whose gradient is no number; slow.
        compile: compile the network for the steps (`training.compilation`).
    """

    epochs: int = 10
    batch: int = 8
    rate: float = 2e-3
    decay: float = 1e-3
    optimizer: str = "adamw"
    optimizer_options: dict[str, float] = field(default_factory=dict)
    schedule: str = "cosine"
    patience: int = 0
    watch: str = ""
    devices: int = 1
    ema: float = 0.0
    top: int = 1
    profile: bool = False
    anomaly: bool = False
    compile: bool = False


@dataclass
class Search:
    """A search for settings (`training.search`), ``search=optuna``.

    Args:
        kind: of what asks.
        space: key of the settings -> [low, high], [low, high, log], or choices.
        trials: in all; jobs: processes that run them.
        startup: trials at random, before which nothing is pruned.
        prune: end a trial whose watched score is below the median of the others.
    """

    kind: str = "optuna"
    space: dict[str, Any] = field(default_factory=dict)
    trials: int = 20
    jobs: int = 1
    startup: int = 5
    prune: bool = True


@dataclass
class TaskSettings(RunSettings):
    """Settings of every task but `embedding`.

    Args:
        jobs: processes that make data that is missing; cluster: scheduler of a Dask cluster that does so.
        part: [k, n]: make every n-th item of the data from the k-th on, for machines that share nothing.
    """

    jobs: int = 1
    cluster: str | None = None
    part: list[int] = field(default_factory=lambda: [1, 1])

    def check(self) -> None:
        """Refuse what makes no sense; a task with keys of its own checks these, too.

        Raises:
            InputError: names the key.
        """
        check_numbers(asdict(self))
        keys = ("steps", "hidden", "networks", "hypotheses", "inspected")
        at_least = {**dict.fromkeys(keys, 1), "jobs": 1, "patience": 0, "seed": 0, "warmup": 0, "folds": 2, "hold_out": 2}
        for key, least in at_least.items():
            if getattr(self, key, least) < least:
                raise InputError(f"{key} must be {least} or more, not {getattr(self, key)}")
        data = getattr(getattr(self, "data", None), "name", "")
        if data in DATASETS and not hasattr(self, "path"):
            raise InputError(f"data={data}: is for tasks that learn from pairs of maps, not for {self.task}")
        _check_run(self)


@dataclass
class NetworkTask(TaskSettings, NetworkSettings):
    """Further settings of tasks that train a network.

    Args:
        hold_out: the scans of every n-th physical building are watched and train nothing.
        init_from: `pretrained`, a run or a file, whose weights the whole network starts from; empty: from random numbers.
    """

    hold_out: int = 8
    init_from: str = ""

    def check(self) -> None:
        """Refuse what makes no sense."""
        super().check()
        check_descent(self)


@dataclass
class RasterTask(NetworkTask):
    """Further settings of tasks whose networks read rasters.

    Args:
        accelerator: cpu or cuda. Only cpu gives the same bytes again for the same seed.
    """

    accelerator: str = "cpu"

    def check(self) -> None:
        """Refuse what makes no sense."""
        super().check()
        if self.accelerator not in ("cpu", "cuda"):
            raise InputError(f"accelerator must be cpu or cuda, not {self.accelerator!r}")


FREEZE = {"": (), "geometry": ("geometry",), "encoders": ("geometry", "node")}  # parts of `Embedder` that stay as they are
ACCELERATORS, PRECISIONS = ("cpu", "cuda", "gpu", "auto"), ("auto", "32-true", "bf16-mixed", "16-mixed")
VALIDATION = "val_small"  # the set that is watched
REPLAYED = "train_walks"  # what the embedder that ships learned from
BATCHES = ("auto", "host", "device")


@dataclass
class Augment:
    """Augmentation of maps while training, drawn anew in each step.

    Args:
        rooms: share of rooms that are lost, drawn for each map between 0 and this.
        edges: share of doors that are lost, likewise.
        jitter: standard deviation of sizes, as logarithms.
        scale: standard deviation of a map's scale, as a logarithm.
        points: of each room that are taken; 0: all.
        noise: m, standard deviation of points.
        shift: pixels, standard deviation of the middles of rooms on their storeys.
        walks: share of maps of which only what another walk would have seen is left (`batches.simulate_partial_walk`).
        slices: share of those that look like slices; rough: of those whose walls have gaps or are thicker.
        tilt: degrees, standard deviation of how far the direction of walls is taken wrong; of some maps four times as much.
        zoom: of a storey's size, likewise, as a logarithm; bend: pixels, of how far places 8 m apart drift.
        signs: share of pairs without landmarks that get invented door signs, where the network reads landmarks.
    """

    rooms: float = 0.15
    edges: float = 0.1
    jitter: float = 0.03
    scale: float = 0.0
    points: int = 256
    noise: float = 0.02
    shift: float = 2.0
    walks: float = 0.0
    slices: float = 0.0
    rough: float = 0.0
    tilt: float = 1.5
    zoom: float = 0.02
    bend: float = 0.5
    signs: float = 0.0


@dataclass
class Training(NetworkSettings):
    """Settings of the task that trains embedders of rooms.

    Args:
        data: name of the set of pairs to train on: `cache`/`data`.jsonl, or the path of a manifest or packed file.
        validation: likewise of the set to watch; empty: a tenth of the training buildings is held out.
        path: of ``data=folder``: a folder of captures with a `pairs.yaml`; its own pairs are watched, where `validation` is not
            set.
        limit: of the first pairs only; 0: all.
        warmup: share of all steps in which the rate rises; then it falls to nothing.
        clip: longest gradient.
        init_from: `pretrained`, a run or a file, whose weights the whole network starts from; its settings are the network's,
            too.
        geometry_from: run whose geometry encoder is the start.
        freeze: of `FREEZE`, what keeps the weights that it starts from: `geometry`, or `encoders`, all but the last layers.
        replay: share of the pairs of an epoch that are drawn from the set `replay_data`, so that what it taught is not forgotten.
        sampler: of `topomerge.registry.SAMPLERS`, which draws the pairs of an epoch.
        overfit: train on one batch, without augmentation, and validate on it.
        threads: that make batches, of each process; beside an accelerator as many as there are cores.
        accelerator: of `ACCELERATORS`.
        precision: of `PRECISIONS`; `auto`: bf16 on CUDA, 32 bits elsewhere.
        batches: made on the `device` (`device_batches`), or by threads of the `host`; `auto`: on the device beside an
            accelerator.
        graphs: run steps as CUDA graphs (`captured_step`) where batches are made on the card.
    """

    task: str = "embedding"
    data: str = "train_small"
    validation: str = VALIDATION
    path: str = ""
    limit: int = 0
    epochs: int = 40
    batch: int = 16
    decay: float = 1e-4
    warmup: float = 0.05
    clip: float = 1.0
    patience: int = 8
    watch: str = "recall@1"
    accelerator: str = "cpu"
    threads: int = 1
    precision: str = "auto"
    batches: str = "auto"
    graphs: bool = True
    init_from: str = ""
    geometry_from: str = ""
    freeze: str = ""
    replay: float = 0.0
    replay_data: str = REPLAYED
    sampler: str = "shuffle"
    overfit: bool = False
    network: Network = field(default_factory=Network)
    loss: LossSettings = field(default_factory=LossSettings)
    augment: Augment = field(default_factory=Augment)


def check(settings: Training) -> None:
    """Refuse what makes no sense.

    Raises:
        InputError: names the key.
    """
    if settings.task != Training.task:
        raise InputError(
            f"task must be {Training.task}, not {settings.task!r}: the other tasks need Hydra, python train.py task=..."
        )
    check_numbers(asdict(settings))
    check_network(settings.network)
    check_loss(settings.loss)
    for key, least in (("threads", 1), ("limit", 0), ("patience", 0), ("seed", 0)):
        if getattr(settings, key) < least:
            raise InputError(f"{key} must be {least} or more, not {getattr(settings, key)}")
    if not settings.clip > 0:
        raise InputError(f"clip must be above 0, not {settings.clip}")
    shares = {
        "warmup": settings.warmup,
        "replay": settings.replay,
        "augment.rooms": settings.augment.rooms,
        "augment.edges": settings.augment.edges,
    }
    shares |= {f"augment.{name}": getattr(settings.augment, name) for name in ("walks", "slices", "rough", "signs")}
    for key, value in shares.items():
        if not 0 <= value < 1:
            raise InputError(f"{key} must be 0 or more and below 1, not {value}")
    for key, possible in (("batches", BATCHES), ("accelerator", ACCELERATORS), ("precision", PRECISIONS)):
        if getattr(settings, key) not in possible:
            raise InputError(f"{key}: unknown {getattr(settings, key)!r}; {', '.join(possible)} are possible")
    if settings.precision == "16-mixed" and settings.accelerator == "cpu":
        raise InputError("precision=16-mixed needs accelerator=cuda; a processor takes bf16-mixed or 32-true")
    SAMPLERS.check(settings.sampler)
    if settings.freeze not in FREEZE:
        raise InputError(f"freeze: unknown {settings.freeze!r}; {' or '.join(filter(None, FREEZE))}, or nothing, are possible")
    if settings.init_from and settings.geometry_from:
        raise InputError("init_from and geometry_from both say what to start from; give one of them")
    if settings.freeze and not (settings.init_from or (settings.freeze == "geometry" and settings.geometry_from)):
        of = "init_from=<run> or geometry_from=<run>" if settings.freeze == "geometry" else "init_from=<run>"
        raise InputError(f"freeze={settings.freeze} needs {of}, or random weights would be frozen")
    check_descent(settings)
    _check_run(settings)


def build_recipe_schema() -> type[Training]:
    """Return `Training` with all of `configs/data/<name>.yaml` in the place of its name, as Hydra composes it."""
    from topomerge.datasets.pairs.items import Recipe

    return make_dataclass("Training", [("data", Recipe, field(default_factory=Recipe))], bases=(Training,))


def convert_composed(given: Any) -> Training:
    """Make `Training` out of what `build_recipe_schema` says: of the data only the name is needed."""
    from topomerge.datasets.pairs.own_pairs import check_own_path

    check_own_path(given.data.name, given.path)
    values = {f.name: getattr(given, f.name) for f in fields(Training)}
    settings = Training(**{**values, "data": given.data.name})
    check(settings)
    return settings


def load_settings(path: str | Path) -> Training:
    """Load settings from a run's `config.json` or `config.yaml`, or one written by hand; missing keys have their defaults.

    Raises:
        InputError: no such file, damaged, or an unknown key.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}; give the config.json of a run") from error
    try:
        if path.suffix == ".json":
            values = json.loads(text)
        else:
            import yaml

            values = yaml.safe_load(text)
    except Exception as error:  # of json or of yaml, which need not be installed for the other
        raise InputError(f"{path}: damaged ({' '.join(str(error).split())[:120]})") from error
    try:
        return parse_settings(values)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def parse_settings(values: Any) -> Training:
    """Parse settings from the output of `convert_to_dict`.

    Raises:
        InputError: an unknown key, or a value of another type.
    """
    if not isinstance(values, Mapping):
        raise InputError(f"settings must be a table of keys, not {type(values).__name__}")
    values = dict(values)
    load_plugins(values["plugins"] if isinstance(values.get("plugins"), list) else [])
    parts: dict[str, Any] = {"network": build_network(values.pop("network", {}))}
    for key, kind in (("loss", LossSettings), ("augment", Augment)):
        parts[key] = _parse_dataclass(kind, values.pop(key, {}), f"{key}.")
    settings: Training = _parse_dataclass(Training, values, "", **parts)
    check(settings)
    return settings


def _parse_dataclass(kind: Any, values: Any, where: str, **given: Any) -> Any:
    if not isinstance(values, Mapping):
        raise InputError(f"{where.rstrip('.')} must be a table of keys, not {values!r}")
    defaults = {f.name: getattr(kind(), f.name) for f in fields(kind)}
    for key, value in values.items():
        if key not in defaults or is_dataclass(defaults[key]):
            raise InputError(f"unknown key {where}{key}; {', '.join(sorted(defaults))} are possible")
        requested = type(defaults[key])
        if not (type(value) is requested or (requested is float and type(value) is int)):
            raise InputError(f"{where}{key} must be {requested.__name__}, not {value!r}")
    return kind(**values, **given)


def convert_to_dict(settings: Training) -> dict[str, Any]:
    """Convert settings to plain values."""
    return asdict(settings)
