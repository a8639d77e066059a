"""Settings of an evaluation: the pairs, the predictor, and the report."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from topomerge.archive import convert_to_plain
from topomerge.datasets.pairs.items import Recipe
from topomerge.embedding.engineered import CONTEXT_KINDS
from topomerge.embedding.learned import EMBEDDER_FILE, EMBEDDERS, PRETRAINED, find_embedder, read_embedder_card
from topomerge.errors import InputError
from topomerge.fusion.inputs import POSE_SOURCES

LEARNED_METHODS = ("mutual", "attention")  # of a trained embedder only
EVALUATED_METHODS = ("full", "assignment", "growing", "consistent", *LEARNED_METHODS)
TABLES = (
    *("ranking", "matching", "merging", "kinds", "decides", "sites", "independence", "reliability"),
    *("overlap", "area", "sensors", "modality", "source", "seen"),
)
PREDICTIONS_FORMAT = 2  # raised when predictions on disk change what they hold


@dataclass
class Pairs(Recipe):
    """The pairs: simulated ones of a recipe, or real ones.

    Args:
        real: sources of real pairs (`datasets.real.sources.REAL_SOURCES`); the recipe then only gives the name,
            the folder and the voxel size.
        trained: sources that trained something; the others are reported apart.
    """

    real: list[str] = field(default_factory=list)
    trained: list[str] = field(default_factory=lambda: ["procedural", "r2v", "campus"])


@dataclass
class Evaluation:
    """Settings of an evaluation.

    Args:
        run: trained embedders: runs, what was exported of them, or folders of runs (a sweep's), of which each is taken.
        name: folder below `folder`; empty: from the data and the runs.
        path: of ``data=folder``: a folder of captures with a `pairs.yaml`, of which the part ``data.split`` is evaluated.
        cache: of the pairs and of descriptors; one's own pairs lie where those of the training do, in the folder above.
        limit: only the first so many pairs; 0: all.
        jobs: processes.
        descriptors: name -> options of `embedder`, its `name` among them.
        only: those of them that are evaluated.
        k: steps of context of these; context: how it is put together.
        methods: "full" (every room that can have a partner gets one: the thesis' assignment), "assignment" (dear pairs stay
            alone), "growing" (the thesis'), "consistent" (one transform must explain the matches), "mutual" (each other's
            likeliest, by the probabilities of a trained embedder), "attention" (what rooms look like and how they lie to each
            other, by a network, without walls; of the embedder that ships).
        slow_k: "consistent" is run for these k only.
        merge: merge the maps, too, with each of the `mergers` among the descriptors, at k = 0, and each run.
        walls_alone: and by registration of walls and free space alone, without descriptors of rooms.
        poses: of the merges: "search", "rooms" (of matched rooms alone), "surfaces" (of each pair of rooms, as in the thesis).
        baseline: variant that the others are compared with.
        titles: call runs by what they are made of and not by their folders: "scalars, gat, infonce".
        tables: those of the short report, of `TABLES`.
        rounds: of the bootstrap.
        write: a Markdown file, to the marked section of which a short table goes; empty: none.
        section: the name of that mark.
        headline: a file of figures for the README, of which ``ranking`` or ``ranking-real`` is written; empty: none.
        remake: make predictions again that are there.
        plugins: modules that are imported first, as they register something (`topomerge.registry`).
    """

    data: Pairs = field(default_factory=Pairs)
    run: list[str] = field(default_factory=list)
    name: str = ""
    folder: str = "runs/eval"
    path: str = ""
    cache: str = "cache/evaluation"
    limit: int = 0
    jobs: int = 1
    descriptors: dict[str, dict[str, Any]] = field(default_factory=dict)
    only: list[str] = field(default_factory=list)
    k: list[int] = field(default_factory=lambda: [0])
    context: list[str] = field(default_factory=lambda: ["join"])
    methods: list[str] = field(default_factory=lambda: ["full", "assignment", "growing", "consistent"])
    slow_k: list[int] = field(default_factory=lambda: [0])
    merge: bool = True
    walls_alone: bool = True
    mergers: list[str] = field(default_factory=lambda: ["engineered"])
    poses: str = "search"
    baseline: str = "engineered"
    titles: bool = False
    tables: list[str] = field(default_factory=lambda: ["ranking", "matching", "seen", "merging", "decides"])
    rounds: int = 2000
    write: str = ""
    section: str = "evaluation"
    headline: str = ""
    remake: bool = False
    plugins: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Variant:
    """A way to describe rooms, and how it is matched."""

    name: str
    descriptor: str
    k: int = 0
    context: str = "join"
    methods: tuple[str, ...] = ()
    run: str = ""


def check(settings: Evaluation) -> None:
    """Refuse what can't be evaluated.

    Raises:
        InputError: names the key.
    """
    for name, options in settings.descriptors.items():
        if options.get("name") not in EMBEDDERS:
            raise InputError(f"descriptors.{name}.name {options.get('name')!r}: {', '.join(EMBEDDERS)} are possible")
    for key, choices in (("methods", EVALUATED_METHODS), ("context", CONTEXT_KINDS), ("tables", TABLES)):
        for value in getattr(settings, key):
            if value not in choices:
                raise InputError(f"{key}: unknown {value!r}; {', '.join(choices)} are possible")
    if settings.poses not in POSE_SOURCES:
        raise InputError(f"poses: unknown {settings.poses!r}; {', '.join(POSE_SOURCES)} are possible")
    if any(k < 0 for k in settings.k) or settings.limit < 0 or settings.rounds < 1 or settings.jobs < 1:
        raise InputError("k and limit must be 0 or more, rounds and jobs 1 or more")
    for name in (*settings.only, *settings.mergers):
        if name not in settings.descriptors:
            raise InputError(f"only, mergers: {name!r} is none of the descriptors {', '.join(settings.descriptors)}")
    if not settings.only and not settings.run:
        raise InputError("nothing to evaluate: name descriptors with only=[...], or run=runs/x")
    for run in settings.run:
        if run != PRETRAINED and not Path(run).exists():
            raise InputError(f"run={run}: no such folder or file; name a run that was trained")
        if not list_runs(run):
            raise InputError(f"run={run}: no run, and no folder of runs; name a run that was trained")
    names = [v.name for v in iter_variants(settings)]
    if repeated := next((name for name in names if names.count(name) > 1), ""):
        raise InputError(f"run: two are called {repeated!r}; rename a folder, or set titles=true")


def iter_variants(settings: Evaluation) -> Iterator[Variant]:
    """Yield everything that describes rooms: each descriptor at each k (with k = 0 there is one context), then each run."""
    for name in settings.only:
        for k in settings.k:
            for how in settings.context if k else settings.context[:1]:
                methods = tuple(m for m in settings.methods if m not in LEARNED_METHODS)
                methods = tuple(m for m in methods if m != "consistent" or k in settings.slow_k)
                title = name if not k else f"{name} k={k} {how}"
                yield Variant(title, name, k, how, methods)
    for run in (each for folder in settings.run for each in list_runs(folder)):
        name = format_run_title(run) if settings.titles else get_run_name(run)
        yield Variant(name, name, methods=tuple(settings.methods), run=run)


def list_runs(run: str) -> list[str]:
    """Return the run itself, or those in a folder of runs that have a trained embedder, by name."""
    path = Path(run)
    runs = sorted(path.glob(f"*/best/{EMBEDDER_FILE}"))
    if not runs or (path / EMBEDDER_FILE).exists() or (path / "best" / EMBEDDER_FILE).exists():
        return [run]
    return [str(best.parent.parent) for best in runs]


def get_run_name(run: str) -> str:
    """Return the name of a run in tables: that of its folder."""
    path = Path(run)
    return path.parent.name if path.is_file() or path.name in ("best", "last") else path.name


def format_run_title(run: str) -> str:
    """Describe a run: geometry, node encoder, loss, and the seed if it is not 0.

    Node encoders: `bare` has no features of edges, `paper` has them in the attention only, `doors` pairs of doors, `around` the
    rooms nearby, `ways` in which direction they are.

    Raises:
        InputError: no trained embedder there.
    """
    card = read_embedder_card(run)
    network, about, node = card.network, card.about, card.network.node
    features = {
        "bare": not node.edges,
        "paper": not node.edge_values,
        "doors": node.doors,
        "around": node.around,
        "ways": node.ways,
    }
    text = [node.kind, *(word for word, so in features.items() if so and node.kind != "none")]
    seed = f", seed {about['seed']}" if about.get("seed") else ""
    return f"{' + '.join(network.geometry.parts)}, {' '.join(text)}, {about.get('loss', 'infonce')}{seed}"


def get_folder(settings: Evaluation) -> Path:
    """Return the folder that the evaluation is written to."""
    name = settings.name or "-".join([settings.data.name, *(get_run_name(r) for r in settings.run)])
    return Path(settings.folder) / name


def collect_prediction_settings(settings: Evaluation) -> dict[str, Any]:
    """Collect the settings that predictions depend on, as plain values; weights of runs as a digest."""
    keys = ("data", "limit", "descriptors", "k", "context", "methods", "slow_k", "merge", "walls_alone", "mergers")
    options = {k: v for k, v in asdict(settings).items() if k in keys}
    options["data"].pop("trained")
    options["data"].pop("folder")
    options["descriptors"] = {name: settings.descriptors[name] for name in settings.only}
    if settings.poses != "search":
        options["poses"] = settings.poses
    if not settings.run:
        options["methods"] = [m for m in settings.methods if m not in LEARNED_METHODS]
    runs = {v.name: compute_digest(v.run) for v in iter_variants(settings) if v.run}
    plain_settings: dict[str, Any] = convert_to_plain({"format": PREDICTIONS_FORMAT, **options, "run": runs})
    return plain_settings


def compute_digest(run: str) -> str:
    """Return hash of a trained embedder's weights."""
    return hashlib.sha256(find_embedder(run).read_bytes()).hexdigest()[:16]


def find_difference(old: Mapping[str, Any], new: Mapping[str, Any], at: str = "") -> str:
    """Return the first key in which two settings differ, with both values; empty where they do not."""
    for key in sorted({*old, *new}):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            if nested_difference := find_difference(a, b, f"{at}{key}."):
                return nested_difference
        elif json.dumps(a) != json.dumps(b):
            return f"{at}{key}: {json.dumps(a)} there, {json.dumps(b)} now"
    return ""
