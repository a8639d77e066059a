"""Tasks of `train.py` and `evaluate.py`; every learned part that ships is one (`topomerge.registry.TASKS`)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, make_dataclass
from functools import cache
from pathlib import Path
from typing import Any

from topomerge.archive import find_weights_file, replace_on_success
from topomerge.errors import InputError
from topomerge.registry import NO_LOGGER, TASKS, load_plugins
from topomerge.types import LogFn

DEFAULT_TASK = "embedding"  # of `train.py`


def check_settings(settings: Any) -> Any:
    """Check composed settings, and return them."""
    settings.check()
    return settings


def refuse_judgement(settings: Any, file: Path, log_line: LogFn) -> dict[str, Any]:
    """Tell that a task cannot be judged on its own.

    Raises:
        InputError: always.
    """
    raise InputError(f"task={settings.task}: has no judge; its scores stand in {settings.folder / 'metrics.jsonl'}")


@dataclass(frozen=True)
class Task:
    """A part that is learned: its module, which registers it in `topomerge.registry.TASKS`, has its data, network and loss.

    Args:
        settings: dataclass of its settings, beside `TaskSettings`; what `fit` and `judge` take.
        fit: trains, leaves a run's folder and exports (`training.loop.run_network`, `training.closed_form.run_fit`).
        scores: of validation, that may be watched; the more, the better, but of those in `lower`.
        judge: scores of a file of weights on buildings that trained nothing.
        package, file: where its weights ship, and their name in `best/` of a run.
        hours: that `make weights` takes for it on two cores, about; 0: it does not ship.
        words: beside the defaults, by which what ships is trained; sets: of pairs, that are built before.
        schema: what Hydra composes, where that is not `settings`; convert: that into checked settings.
        is_descriptor: what it trains is a descriptor of rooms (`tm.load_embedder`), which `evaluate.py run=` compares.
        describe: columns of a table of runs, out of the settings of one.
    """

    settings: type[Any]
    fit: Callable[[Any, LogFn], Mapping[str, float]]
    scores: Sequence[str]
    judge: Callable[[Any, Path, LogFn], Mapping[str, Any]] = refuse_judgement
    package: str = ""
    file: str = ""
    hours: float = 0.0
    lower: Sequence[str] = ()
    words: Sequence[str] = ()
    sets: Sequence[str] = ()
    schema: Callable[[], type[Any]] | None = None
    convert: Callable[[Any], Any] = check_settings
    is_descriptor: bool = False
    describe: Callable[[Mapping[str, Any]], dict[str, Any]] = lambda config: {}

    def get_schema(self) -> type[Any]:
        """Return the dataclass that Hydra composes."""
        return self.settings if self.schema is None else self.schema()


RANKINGS = tuple(f"recall@{k}{of}" for k in (1, 5) for of in ("", "_single", "_twin"))


def get_word(overrides: Sequence[str], key: str, default: str = "") -> str:
    """Return the value of the last word ``key=value``."""
    return next((word[len(key) + 1 :] for word in reversed(overrides) if word.startswith(f"{key}=")), default)


LISTS = ("logger", "plugins")  # keys that take several values, or one without brackets


def bracket_lists(overrides: Sequence[str]) -> list[str]:
    """Return words of a command line in which ``logger=csv`` is ``logger=[csv]``, as Hydra has it."""
    out = []
    for word in overrides:
        key, _, value = word.partition("=")
        single = key.lstrip("+") in LISTS and value and not value.startswith(("[", "'", '"'))
        out.append(f"{key}=[{value}]" if single else word)
    return out


def prepare_words(overrides: Sequence[str]) -> list[str]:
    """Import the plugins that words of a command line name, let Hydra know the keys of the tasks, and find YAML of plugins.

    Raises:
        InputError: a plugin cannot be imported, or there is no such task.
    """
    from topomerge.config import SEARCH, find_plugins, register
    from topomerge.training.settings import Search

    register("optuna", Search, group=SEARCH, package=SEARCH)
    ready = bracket_lists(find_plugins(overrides))
    for task in get_word(overrides, "task", DEFAULT_TASK).split(","):
        register(task, _add_search_key(TASKS[task].get_schema()), group="task")
    return ready


@cache
def _add_search_key(schema: type[Any]) -> type[Any]:
    """Add the key of a search for settings to those of a task."""
    from topomerge.config import SEARCH

    return make_dataclass("Composed", [(SEARCH, Any, None)], bases=(schema,))


def compose_settings(overrides: Sequence[str] = ()) -> Any:
    """Return settings of a task from `configs/train.yaml` and words like ``task=plan_segmentation data.scans=20``, by Hydra.

    Raises:
        InputError: one line with the key's name.
    """
    from topomerge.config import compose

    ready = prepare_words(overrides)
    task = TASKS[get_word(overrides, "task", DEFAULT_TASK)]
    return task.convert(compose("train", task.get_schema(), ready))


def convert_settings(config: Any) -> Any:
    """Return settings of a task from what Hydra composed.

    Raises:
        InputError: one line with the key's name.
    """
    from topomerge.config import convert_to_dataclass

    load_plugins(list(config.get("plugins", [])))
    task = TASKS[str(config.task)]
    return task.convert(convert_to_dataclass(config, task.get_schema()))


def train(settings: Any, log_line: LogFn) -> Mapping[str, float]:
    """Train a task, and leave a run's folder (`training.run_folder`).

    Returns:
        The scores of what is best.

    Raises:
        InputError: settings that make no sense, data or a state that can't be read.
        KeyboardInterrupt: after Ctrl-C or SIGTERM.
    """
    check_start(settings)
    return TASKS[settings.task].fit(settings, log_line)


def check_start(settings: Any) -> None:
    """Refuse, before any data is made, what a training would stumble over later.

    Raises:
        InputError: a score to watch that there is not, an accelerator or compiler that is not here, a folder that holds another
            run.
    """
    from topomerge.training.run_folder import check_folder

    possible = TASKS[settings.task].scores
    if settings.watch not in possible:
        raise InputError(f"watch: unknown {settings.watch!r}; {', '.join(possible)} are possible for task={settings.task}")
    check_accelerator(settings)
    if getattr(settings, "compile", False):
        from topomerge.training.compilation import check_compilation

        check_compilation(settings)
    if getattr(settings, "init_from", "") and not TASKS[settings.task].is_descriptor:
        find_start(settings.task, settings.init_from)
    if names := [name for name in settings.logger if name != NO_LOGGER]:
        from topomerge.training.instruments import check_installed

        check_installed(names)
    check_folder(settings.folder, asdict(settings))


def check_accelerator(settings: Any) -> None:
    """Refuse an accelerator that is not here.

    Raises:
        InputError: names the key.
    """
    name, requested = getattr(settings, "accelerator", "cpu"), getattr(settings, "devices", 1)
    scaled = name == "auto" and getattr(settings, "precision", "") == "16-mixed"  # which no processor has
    if name not in ("cuda", "gpu") and not scaled:
        return
    import torch

    if not torch.cuda.is_available():
        raise InputError(f"accelerator={name}: torch finds no such device here; leave it out to train on the processor")
    if torch.cuda.device_count() < requested:
        raise InputError(f"devices={requested}: torch finds {torch.cuda.device_count()} here")


def find_weights(task: str, run: str) -> Path:
    """Find the file of weights of a run, a folder or a file; of the package where `run` is empty.

    Raises:
        InputError: there is none.
    """
    name = TASKS[task].file
    if not run:
        return find_weights_file(TASKS[task].package, name)
    return _find_in_run(task, run, "run")


def find_start(task: str, start: str) -> Path:
    """Find the file of weights that a training starts from: `pretrained`, a run, a folder or a file.

    Raises:
        InputError: there is none.
    """
    from topomerge.embedding.learned import PRETRAINED  # here: wrong words are told before the networks are imported

    if start == PRETRAINED and not Path(start).exists():
        return find_weights_file(TASKS[task].package, TASKS[task].file)
    return _find_in_run(task, start, "init_from")


def _find_in_run(task: str, run: str, key: str) -> Path:
    name = TASKS[task].file
    places = (Path(run), Path(run) / "best" / name, Path(run) / name)
    path = next((path for path in places if path.is_file()), None)
    if path is None:
        raise InputError(f"{key}={run}: holds no {name}; name a run of task={task}, or what it exported")
    return path


@dataclass(frozen=True)
class EvaluationResult:
    """Scores, as numbers and as a Markdown table, and the folder that they are written to."""

    scores: dict[str, Any]
    summary: str
    folder: Path


def evaluate_task(task: str, overrides: Sequence[str], log_line: LogFn) -> EvaluationResult:
    """Judge the weights that ship, or those of a run (``run=runs/x``), on the task's `heldout` data.

    Args:
        overrides: as those of `train.py`; besides ``run=`` and ``folder=`` (runs/eval).

    Raises:
        InputError: a wrong word, no such weights, or no data.
    """
    named = {key: word[len(key) + 1 :] for key in ("run", "folder") for word in overrides if word.startswith(f"{key}=")}
    rest = [word for word in overrides if not word.startswith(("run=", "folder="))]
    settings = compose_settings(rest)  # which imports plugins
    file = find_weights(task, named.get("run", ""))
    scores = dict(TASKS[task].judge(settings, file, log_line))
    own = getattr(settings, "path", "")
    heldout = Path(own).resolve().name if own else getattr(getattr(settings, "heldout", None), "name", "own")
    folder = Path(named.get("folder", "runs/eval")) / f"{task}-{heldout}"
    digest = hashlib.sha256(file.read_bytes()).hexdigest()
    record = {"task": task, "weights": str(file), "sha256": digest, "heldout": heldout, "scores": scores}
    texts = {name: f"{value:.3f}" if isinstance(value, float) else str(value) for name, value in scores.items()}
    rows = [f"| {name} | {text} |" for name, text in texts.items()]
    head = f"{task}: {file.name} of {named.get('run') or 'the package'} on {heldout}"
    summary = "\n".join([f"{head}\n", "| score | value |", "|---|---|", *rows])
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("scores.json", json.dumps(record, indent=1)), ("report.md", f"# {summary}")):
        with replace_on_success(folder / name) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")
    return EvaluationResult(scores, summary, folder)
