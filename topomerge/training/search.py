"""Search for settings: ``train.py search=optuna search.space.rate=[1e-4,1e-2,log] search.trials=20``.

A trial is a run like any other, in a folder `trial_000` of the run's. What is asked and told is kept in `search.log` (Optuna's
journal), so that a search goes on after a kill, and several processes share it.
"""

from __future__ import annotations

import json
import math
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from topomerge.archive import replace_on_success
from topomerge.config import compose_config, convert_to_dataclass
from topomerge.errors import InputError
from topomerge.progress import Stopwatch
from topomerge.registry import TASKS
from topomerge.training.instruments import REPORT
from topomerge.training.loop import derive_seed
from topomerge.training.run_folder import write_settings
from topomerge.training.settings import Search
from topomerge.training.table import format_table
from topomerge.training.tasks import check_start, compose_settings, prepare_words, train
from topomerge.types import LogFn

JOURNAL, SPACE_FILE, TABLE_FILE, STUDY = "search.log", "search.json", "table.md", "search"
LOG, CHOICE = "log", "choice"  # last words of an entry of the space
OWN_WORDS = ("search", "name", "runs", "resume", "overwrite")  # which a trial has others of


@dataclass(frozen=True)
class Plan:
    """The plan of a search, as each of its processes needs it.

    Args:
        overrides: of every trial, ``key=value``.
        folder: of the search; the trials are folders in it.
        watch: score that is compared; lower: less of it is better.
    """

    search: Search
    overrides: Sequence[str]
    folder: Path
    seed: int
    watch: str
    lower: bool


@dataclass(frozen=True)
class SearchResult:
    """The best trial's folder, score and settings, and the table of all trials."""

    best: Path
    watch: str
    score: float
    found: dict[str, Any]
    table: Path

    def describe(self) -> str:
        """Name the best trial in one line."""
        found = " ".join(f"{key}={_format_value(value)}" for key, value in self.found.items())
        return f"best: {self.best}: {self.watch} {self.score:.3f} with {found}; the table: {self.table}"


def compose_search(overrides: Sequence[str]) -> Search | None:
    """Return the search that overrides, or an experiment that they name, ask for; None where they ask for none.

    Raises:
        InputError: one line with the key's name.
    """
    if not any(word.lstrip("+").startswith(("search", "experiment=")) for word in overrides):
        return None
    if {"-m", "--multirun"} & set(overrides):
        names = [word.partition("=")[2] for word in overrides if word.lstrip("+").startswith("experiment=")]
        alone = [word for word in overrides if word.lstrip("+").startswith(("search", "plugins"))]
        tried = [[*alone, f"experiment={name}"] for name in ",".join(names).split(",") if name] or [alone]
        if any(compose_config("train", prepare_words(one)).get("search") is not None for one in tried):
            raise InputError("search: runs several trainings by itself; leave out -m")
        return None
    composed = compose_config("train", prepare_words([word for word in overrides if not word.startswith("-")]))
    given = None if {"-c", "--cfg"} & set(overrides) else composed.get("search")
    if given is None:
        return None
    return convert_to_dataclass(given, Search)


def search_settings(search: Search, overrides: Sequence[str], log_line: LogFn) -> SearchResult:
    """Run the trials that are left, and write a table of all.

    Args:
        overrides: of the command line, ``key=value``.

    Raises:
        InputError: a space that makes no sense, settings that cannot train, a folder that holds another run or search.
        KeyboardInterrupt: after Ctrl-C or SIGTERM; ``resume=true`` goes on.
    """
    _check_search(search)
    kept = [word for word in overrides if word.lstrip("+").partition("=")[0].partition(".")[0] not in OWN_WORDS]
    settings = compose_settings(overrides)
    space = parse_space(search.space)
    _check_space(space, kept)
    folder = settings.folder
    if (folder / JOURNAL).exists() and not (settings.resume or settings.overwrite):
        raise InputError(
            f"{folder}: holds a search; resume=true goes on with it, overwrite=true replaces it, or give another name="
        )
    check_start(settings)
    plan = Plan(search, kept, folder, settings.seed, settings.watch, settings.watch in TASKS[settings.task].lower)
    _begin(plan, settings)
    with _quiet_optuna():
        study = _open_study(plan)
        stale = [trial.number for trial in study.get_trials(deepcopy=False) if trial.state.name == "RUNNING"]
        fresh = max(search.trials - len(study.get_trials(deepcopy=False)), 0)
        log_line(f"{folder}: {len(stale) + fresh} trials over {', '.join(space)}")
        from joblib import Parallel, delayed

        numbers = [*stale, *[None] * fresh]
        Parallel(n_jobs=min(search.jobs, max(len(numbers), 1)))(delayed(run_trial)(plan, n, log_line) for n in numbers)
        return _write_result(plan, study)


def parse_space(space: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Return a distribution of Optuna of each key.

    Args:
        space: key -> [low, high] of whole or other numbers, [low, high, log], or choices: words, three or more numbers, or
            [16, 32, choice].

    Raises:
        InputError: names the key.
    """
    out: dict[str, Any] = {}
    for key, value in space.items():
        name = f"{above}{key}"
        out |= parse_space(value, f"{name}.") if isinstance(value, Mapping) else {name: _parse_values(name, value)}
    return out


def _parse_values(name: str, given: Any) -> Any:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    wrong = f"search.space.{name}={given}"
    if not isinstance(given, Sequence) or isinstance(given, str) or not given:
        raise InputError(f"{wrong}: give [low, high], [low, high, log], or choices such as [a, b, c]")
    kind = given[-1] if given[-1] in (LOG, CHOICE) and len(given) > 2 else ""
    values = list(given[:-1] if kind else given)
    if any(value is None or (isinstance(value, Sequence | Mapping) and not isinstance(value, str)) for value in values):
        raise InputError(f"{wrong}: choices are numbers, words, true or false")
    if any(isinstance(value, float) and not math.isfinite(value) for value in values):
        raise InputError(f"{wrong}: numbers must be finite")
    is_range = len(values) == 2 and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    if kind == LOG and not is_range:
        raise InputError(f"{wrong}: log is of two numbers, [low, high, log]")
    if not is_range or kind == CHOICE:
        if len({json.dumps(value) for value in values}) < len(values) or len(values) < 2:
            raise InputError(f"{wrong}: choices must be two or more, and differ")
        return CategoricalDistribution(values)
    low, high = values
    if not low < high:
        raise InputError(f"{wrong}: the first number must be below the second")
    if kind == LOG and low <= 0:
        raise InputError(f"{wrong}: a logarithmic range begins above 0")
    whole = all(isinstance(value, int) for value in values)
    return (IntDistribution if whole else FloatDistribution)(low, high, log=kind == LOG)


def _check_search(search: Search) -> None:
    try:
        import optuna  # noqa: F401
    except ImportError as error:
        raise InputError("search=optuna needs optuna: pip install topomerge[search]") from error
    if not search.space:
        raise InputError("search.space: is empty; give keys to search, such as search.space.rate=[1e-4,1e-2,log]")
    for key in ("trials", "jobs", "startup"):
        if getattr(search, key) < 1:
            raise InputError(f"search.{key} must be 1 or more, not {getattr(search, key)}")


def _check_space(space: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """Compose settings with both ends, or every choice, of each key.

    Raises:
        InputError: a key is given as well, there is no such key, or a value is refused.
    """
    given = {word.lstrip("+").partition("=")[0] for word in overrides}
    for key, distribution in space.items():
        if key in given or key in OWN_WORDS or key == "seed":
            raise InputError(f"search.space.{key}: cannot be searched, or is given as {key}=, too; leave out one of them")
        values = getattr(distribution, "choices", None) or (distribution.low, distribution.high)
        for value in values:
            try:
                compose_settings([*overrides, _format_word(key, value)])
            except InputError as error:
                raise InputError(f"search.space.{key}: {_format_value(value)} is refused: {error}") from error


def _format_word(key: str, value: Any) -> str:
    return f"{key}={json.dumps(value) if not isinstance(value, str) else value}"


def _format_value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _begin(plan: Plan, settings: Any) -> None:
    """Write what the search begins with, or refuse to go on with another space."""
    path = plan.folder / SPACE_FILE
    if settings.resume and path.exists():
        before = json.loads(path.read_text(encoding="utf-8"))
        if before != plan.search.space:
            raise InputError(f"search.space: resume=true goes on with {json.dumps(before)}; start anew with overwrite=true")
    elif settings.overwrite:
        for trial in plan.folder.glob("trial_*"):
            shutil.rmtree(trial)
        for name in (JOURNAL, TABLE_FILE, SPACE_FILE):
            (plan.folder / name).unlink(missing_ok=True)
    write_settings(plan.folder, {**asdict(settings), "resume": False, "overwrite": False})
    with replace_on_success(path) as temporary:
        temporary.write_text(json.dumps(plan.search.space) + "\n", encoding="utf-8")


@contextmanager
def _quiet_optuna() -> Iterator[None]:
    import optuna

    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        try:
            yield
        finally:
            optuna.logging.set_verbosity(before)


def _open_study(plan: Plan) -> Any:
    """Open the study in the journal, with a sampler seeded by the run's seed and the number of trials so far: a search that goes
    on asks what it would have asked."""
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    storage = JournalStorage(JournalFileBackend(str(plan.folder / JOURNAL)))
    pruner: Any = optuna.pruners.NopPruner()
    if plan.search.prune:
        pruner = optuna.pruners.MedianPruner(n_startup_trials=plan.search.startup, n_warmup_steps=1)
    direction: Any = "minimize" if plan.lower else "maximize"
    study = optuna.create_study(storage=storage, study_name=STUDY, direction=direction, pruner=pruner, load_if_exists=True)
    seed = derive_seed(plan.seed, len(study.get_trials(deepcopy=False))) % (1 << 32)
    study.sampler = optuna.samplers.TPESampler(
        seed=seed, n_startup_trials=plan.search.startup, constant_liar=plan.search.jobs > 1
    )
    return study


def run_trial(plan: Plan, number: int | None, log_line: LogFn) -> None:
    """Ask for settings, train with them, tell the score; a trial that fails is told as failed, with its reason.

    Args:
        number: of a trial that was cut off, which goes on; None: a new one.
    """
    import optuna

    with _quiet_optuna():
        study = _open_study(plan)
        if number is None:
            trial = study.ask(parse_space(plan.search.space))
        else:
            trial = optuna.trial.Trial(study, study.get_trials(deepcopy=False)[number]._trial_id)
        name = f"trial_{trial.number:03d}"
        found = [_format_word(key, value) for key, value in trial.params.items()]
        goes_on = "resume=true" if (plan.folder / name / "last").exists() else "overwrite=true"

        settings = compose_settings([*plan.overrides, *found, f"runs={plan.folder}", f"name={name}", goes_on])

        def report(row: dict[str, Any]) -> None:
            trial.report(row[f"val/{plan.watch}"], row["epoch"])
            if row["epoch"] + 1 < settings.epochs and trial.should_prune():
                raise optuna.TrialPruned

        token, watch = REPORT.set(report), Stopwatch()
        log_line(f"{name}: {' '.join(found)}")
        try:
            value = train(settings, lambda text: log_line(f"{name}: {text}"))[f"val/{plan.watch}"]
            study.tell(trial, value)
            log_line(f"{name}: {plan.watch} {value:.3f} in {watch.elapsed:.0f} s")
        except optuna.TrialPruned:
            study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            log_line(f"{name}: ended early, as it is worse than most")
        except InputError as error:
            trial.set_user_attr("reason", str(error))
            study.tell(trial, state=optuna.trial.TrialState.FAIL)
            log_line(f"{name}: failed: {error}")
        finally:
            REPORT.reset(token)


def _write_result(plan: Plan, study: Any) -> SearchResult:
    """Write the table of all trials, best first.

    Raises:
        InputError: no trial has a score.
    """
    sign = 1 if plan.lower else -1
    trials = study.get_trials(deepcopy=False)
    ended = sorted((t for t in trials if t.state.name == "COMPLETE"), key=lambda t: (sign * t.value, t.number))
    if not ended:
        reason = next((t.user_attrs["reason"] for t in trials if "reason" in t.user_attrs), "all were cut off")
        raise InputError(f"{plan.folder}: no trial has ended with a score: {reason}")
    rest = sorted((t for t in trials if t.state.name != "COMPLETE"), key=lambda t: t.number)
    rows = [
        {
            "trial": f"trial_{trial.number:03d}",
            **{key: _format_value(value) for key, value in trial.params.items()},
            plan.watch: trial.value if trial.value is not None else "–",
            "epochs": len(trial.intermediate_values) or "–",
            "state": {"COMPLETE": "ended", "PRUNED": "pruned", "FAIL": "failed"}.get(trial.state.name, "cut off"),
        }
        for trial in [*ended, *rest]
    ]
    table = plan.folder / TABLE_FILE
    with replace_on_success(table) as temporary:
        temporary.write_text("\n".join(format_table(rows, list(rows[0]))) + "\n", encoding="utf-8")
    best = ended[0]
    return SearchResult(plan.folder / f"trial_{best.number:03d}", plan.watch, float(best.value), dict(best.params), table)
