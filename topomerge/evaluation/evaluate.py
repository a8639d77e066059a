"""An evaluation from beginning to end: pairs, predictions, scores, tables, figures."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.archive import replace_on_success
from topomerge.code_digest import compute_code_digest
from topomerge.datasets.pairs.build import Build, build
from topomerge.datasets.pairs.items import Recipe
from topomerge.datasets.pairs.own_pairs import build_own_sets, check_own_path
from topomerge.datasets.real.maps import build_real_pairs
from topomerge.errors import InputError
from topomerge.evaluation.documents import build_stamp, write_headline
from topomerge.evaluation.merge_report import (
    select_last_variant,
    tabulate_descriptor_effect,
    tabulate_independence,
    tabulate_merging,
    tabulate_reliability,
    tabulate_sites,
)
from topomerge.evaluation.predict import CODE, predict_all
from topomerge.evaluation.score import OVERLAPS, Row, score_all
from topomerge.evaluation.settings import Evaluation, check, collect_prediction_settings, find_difference, get_folder
from topomerge.evaluation.tables import (
    BY,
    Table,
    compute_value,
    format_value,
    group_by_variant,
    iter_long_rows,
    tabulate_groups,
    tabulate_matching,
    tabulate_methods,
    tabulate_ranking,
    write_csv,
    write_section,
)
from topomerge.statistics import measure_calibration
from topomerge.types import LogFn

ROUNDS = 500


def save_figures(ranks: Sequence[Row], matches: Sequence[Row], merges: Sequence[Row], folder: Path) -> list[str]:
    """Draw what there is something to draw of; names of the files."""
    done = []
    for name, draw in (
        ("reliability", _draw_reliability),
        ("overlap", _draw_overlap),
        ("pr", _draw_precision_recall),
    ):
        figure = draw(ranks, matches, merges)
        if figure is not None:
            with replace_on_success(folder / f"{name}.png") as temporary:
                figure.savefig(temporary, dpi=120, bbox_inches="tight", format="png")
            done.append(f"{name}.png")
    return done


def _create_figure(columns: int) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.4 * columns, 3.6))
    return figure, figure.subplots(1, columns, squeeze=False)[0]


def _add_legend(ax: Any) -> None:
    """Add a legend below the axes, where it hides nothing; none where nothing is drawn, as of merges that were not asked for."""
    if ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2, frameon=False)


def _group_rows(rows: Sequence[Row], key: str) -> dict[str, list[Row]]:
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(row[key], []).append(row)
    return out


def _collect_values(rows: Sequence[Row], key: str) -> list[Any]:
    return [value for row in rows for value in row[key]]


def _draw_reliability(ranks: Sequence[Row], matches: Sequence[Row], merges: Sequence[Row]) -> Any:
    """Draw the share that was right against the probability that was told, over bins of equal mass; merges by where the maps come
    from."""
    by_origin = _group_rows(select_last_variant(merges), "origin")
    sets = [("merges", {n: ([r["probability"] for r in s], [r["near"] for r in s]) for n, s in by_origin.items()})]
    rows_with_probability = [m for m in matches if m["k"] == 0 and m["method"] in ("consistent", "mutual")]
    named = _group_rows([{**m, "title": f"{m['variant']} {m['method']}"} for m in rows_with_probability], "title")
    sets.append(("matches of rooms", {n: (_collect_values(s, "chance"), _collect_values(s, "good")) for n, s in named.items()}))
    sets = [(title, predictions) for title, predictions in sets if any(len(p) for p, _ in predictions.values())]
    if not sets:
        return None
    figure, axes = _create_figure(len(sets))
    for ax, (title, predictions) in zip(axes, sets, strict=True):
        ax.plot([0, 1], [0, 1], color="0.7", lw=1)
        for name, (p, y) in predictions.items():
            if len(p):
                c = measure_calibration(p, y)
                line = ax.plot(c.probability, c.right, "o-", ms=4, label=f"{name} ({len(p)}; ECE {c.error:.2f})")[0]
                if len(predictions) == 1:
                    for x, r, n in zip(c.probability, c.right, c.count, strict=True):
                        ax.annotate(
                            str(n), (x, r), fontsize=7, color=line.get_color(), xytext=(3, -9), textcoords="offset points"
                        )
        ax.set(title=title, xlabel="predicted probability", ylabel="share right", xlim=(0, 1), ylim=(0, 1.02))
        _add_legend(ax)
    return figure


def _draw_overlap(ranks: Sequence[Row], matches: Sequence[Row], merges: Sequence[Row]) -> Any:
    """Draw the recall of rooms and merges by the share of rooms in common."""
    bins = [name for _, name in OVERLAPS]
    if not any(r["overlap"] in bins for r in ranks):
        return None
    panels = [("recall@1 of rooms", "recall@1", {n: s for n, s in _group_rows(ranks, "variant").items() if s[0]["k"] == 0})]
    method_rows = [
        {**m, "title": f"{m['variant']}, {m['method']}"}
        for m in matches
        if m["k"] == 0 and m["method"] in ("growing", "consistent")
    ]
    panels.append(("F1 of matches", "F1", _group_rows(method_rows, "title")))
    if merges:
        panels.append(("pairs merged right", "merged", _group_rows(merges, "variant")))
    figure, axes = _create_figure(len(panels))
    for ax, (title, metric, rows_by_name) in zip(axes, panels, strict=True):
        for shift, (name, rows) in enumerate(rows_by_name.items()):
            values = [compute_value([r for r in rows if r["overlap"] == b], metric, ROUNDS) for b in bins]
            x = np.arange(len(bins)) + 0.05 * (shift - len(rows_by_name) / 2)
            mid = np.array([v.value for v in values])
            ends = np.array([[max(v.value - v.low, 0), max(v.high - v.value, 0)] for v in values]).T
            ax.errorbar(x, mid, yerr=np.nan_to_num(ends), fmt="o-", ms=4, lw=1, capsize=2, label=name)
        ax.set(title=title, xlabel="share of rooms in common", xticks=range(len(bins)), xticklabels=bins, ylim=(0, 1.02))
        _add_legend(ax)
    return figure


def _draw_precision_recall(ranks: Sequence[Row], matches: Sequence[Row], merges: Sequence[Row]) -> Any:
    """Draw precision against recall of matches, as the least probability that is taken falls; dots: methods that tell none."""
    if not matches:
        return None
    figure, (ax,) = _create_figure(1)
    for name, variant_rows in _group_rows(matches, "variant").items():
        if variant_rows[0]["k"]:
            continue
        color = None
        for method, method_rows in _group_rows(variant_rows, "method").items():
            units = sum(r["units"] for r in method_rows)
            p = np.concatenate([r["chance"] for r in method_rows])
            good = np.concatenate([r["good"] for r in method_rows]).astype(float)
            if not len(p) or not units:
                continue
            if method in ("consistent", "mutual"):
                order = np.argsort(-p, kind="stable")
                right = good[order].cumsum()
                share = sum(r["found"] for r in method_rows) / max(good.sum(), 1)  # pieces of a room found twice count once
                line = ax.plot(
                    right * share / units, right / np.arange(1, len(p) + 1), lw=1.2, color=color, label=f"{name}, {method}"
                )
                color = line[0].get_color()
            else:
                v = [compute_value(method_rows, m, 1).value for m in ("recall", "precision")]
                mark = {"full": "s", "assignment": "o", "growing": "^"}.get(method, "x")
                dot = ax.plot(*v, mark, ms=5, color=color, label=f"{name}, {method}")
                color = dot[0].get_color()
    ax.set(xlabel="recall of rooms in common", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02))
    _add_legend(ax)
    return figure


OF_MERGES = ("merging", "kinds", "decides", "sites", "independence", "reliability")  # tables that there are where maps are merged


@dataclass(frozen=True)
class Scores:
    """The result of an evaluation: rows of counts, a short report, and where everything lies."""

    matches: list[Row]
    ranks: list[Row]
    merges: list[Row]
    summary: str
    folder: Path


def evaluate(settings: Evaluation, log_line: LogFn = lambda text: None, command: str = "") -> Scores:
    """Make the pairs and the predictions that are missing, score them, and write tables and figures.

    Args:
        log_line: is told the progress.
        command: that led here, for the report.

    Raises:
        InputError: settings that nothing can be made of, or a folder that was made with others.
    """
    check(settings)
    settings = with_own_pairs(settings, log_line)
    folder = get_folder(settings)
    claim(folder, collect_prediction_settings(settings))
    pairs = list_pairs(folder / "pairs.json", settings, log_line)
    if not pairs:
        raise InputError(f"{settings.data.name}: no pair could be made; see the reasons above")
    files = predict_all(pairs, folder / "predictions", settings, log_line)
    matches, ranks, merges = score_all(pairs, files, settings)
    old = {r["pair"] for r in (*ranks, *merges) if r["code"] != compute_code_digest(*CODE)}
    if old:
        log_line(
            f"{len(old)} of {len(files)} pairs were predicted by another version of the code; remake=true predicts them again"
        )
    parts = tabulate_all(matches, ranks, merges, settings)
    figures = save_figures(ranks, matches, merges, folder)
    head = _describe_evaluation(ranks, merges, settings, command)
    images = "\n".join(f"![]({name})" for name in figures)
    _write(folder / "report.md", "\n\n".join([f"# {folder.name}", head, *(t.format_markdown() for t in parts), images]))
    _write(folder / "tables.tex", "\n\n".join(t.format_latex() for t in parts))
    write_csv(list(iter_long_rows(ranks, matches, merges, settings)), folder / "scores.csv")
    for name, rows in (("matches", matches), ("ranks", ranks), ("merges", merges)):
        write_csv(rows, folder / f"{name}.csv")
    summary = "\n\n".join([head, *(t.format_markdown() for t in tabulate_short(matches, ranks, merges, settings))])
    if settings.write or settings.headline:
        stamp = build_stamp(command or "python evaluate.py", CODE, [path.stem for path in files])
        if settings.write:
            write_section(Path(settings.write), settings.section, f"{stamp.write_comment()}\n\n{summary}")
        if settings.headline:
            write_headline(Path(settings.headline), compute_headline(ranks, settings), stamp)
    return Scores(matches, ranks, merges, summary, folder)


def compute_headline(ranks: list[Row], settings: Evaluation) -> dict[str, tuple[str, str]]:
    """Compute the README's figure: recall@1 of the trained embedder and of the baseline; none without both."""
    of = group_by_variant(ranks)
    trained = [name for name in of if name not in settings.descriptors and " k=" not in name]
    if settings.baseline not in of or not trained:
        return {}
    values = [compute_value(of[name], "recall@1", settings.rounds) for name in (trained[0], settings.baseline)]
    pairs = f"{values[0].pairs} {'real' if settings.data.real else 'held-out'} pairs"
    return {"ranking-real" if settings.data.real else "ranking": ("; ".join(map(format_value, values)), pairs)}


def _write(path: Path, text: str) -> None:
    with replace_on_success(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def claim(folder: Path, plain_settings: dict[str, Any]) -> None:
    """Take a folder for an evaluation: a new one, or one that was made with the same settings.

    Args:
        plain_settings: of `collect_prediction_settings`.

    Raises:
        InputError: it was made with others; the first key that differs is named.
    """
    path = folder / "evaluation.json"
    if path.exists():
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise InputError(f"{path}: damaged ({error}); take another folder with name=...") from error
        if mismatch := find_difference(before, plain_settings):
            raise InputError(
                f"{folder}: was made with other settings ({mismatch}); take another folder with name=..., or delete it"
            )
        return
    if folder.exists() and any(folder.iterdir()):
        raise InputError(f"{folder}: holds something else than an evaluation; take another folder with name=...")
    folder.mkdir(parents=True, exist_ok=True)
    _write(path, json.dumps(plain_settings, indent=1, sort_keys=True))


def list_pairs(listed: Path, settings: Evaluation, log_line: LogFn) -> list[Path]:
    """Return the pairs of `build_pairs`; once they are all made, a list of them is kept: reading all plans again takes its
    time."""
    if listed.exists():
        files = [Path(settings.cache) / name for name in json.loads(listed.read_text(encoding="utf-8"))]
        if all(file.exists() for file in files):
            return files
    files = build_pairs(settings, log_line)
    _write(listed, json.dumps([Path(os.path.relpath(f, settings.cache)).as_posix() for f in files], indent=0))
    return files


def with_own_pairs(settings: Evaluation, log_line: LogFn) -> Evaluation:
    """Name the set of a folder of one's own captures by a hash of all that it is made of; `path` becomes its manifest.

    Raises:
        InputError: whatever is wrong with the folder.
    """
    check_own_path(settings.data.name, settings.path)
    if not settings.path:
        return settings
    cache = Path(settings.cache)
    manifests = build_own_sets(settings.path, own_cache(cache), settings.jobs, log_line, settings.data.name).manifests
    part = {"validation": "val"}.get(settings.data.split, settings.data.split)
    if part not in manifests:
        raise InputError(f"data.split={settings.data.split}: {', '.join(manifests)} are possible of data=folder")
    return replace(settings, path=str(manifests[part]), data=replace(settings.data, name=manifests[part].stem))


def own_cache(cache: Path) -> Path:
    """Return the cache of one's own pairs, which is that of the training: the folder above one that is called `evaluation`."""
    return cache.parent if cache.name == "evaluation" else cache


def list_files(manifest: Path) -> list[Path]:
    """List the files of the pairs of a manifest."""
    rows = [json.loads(line) for line in manifest.read_text(encoding="utf-8").splitlines()]
    return [manifest.parent / "pairs" / row["file"] for row in rows]


def build_pairs(settings: Evaluation, log_line: LogFn) -> list[Path]:
    """Return files of the kept pairs, made where they are missing."""
    data = settings.data
    if settings.path:
        return list_files(Path(settings.path))[: settings.limit or None]
    if data.real:
        real_pairs = build_real_pairs(data.folder, Path(settings.cache), data.real, data.voxel_size, log_line)
        return real_pairs[: settings.limit or None]
    if not data.maps:
        raise InputError(f"{data.name}: its maps are not kept; set data.maps=true")
    pairs = min(settings.limit, data.pairs) if settings.limit else data.pairs
    name = f"{data.name}-first{pairs}" if pairs < data.pairs else data.name  # the manifest of all pairs stays as it is
    recipe = Recipe(**{f.name: getattr(replace(data, pairs=pairs, name=name), f.name) for f in fields(Recipe)})
    manifest = build(Build(recipe, settings.cache, settings.jobs), log_line).manifest
    return list_files(manifest)


def tabulate_all(matches: list[Row], ranks: list[Row], merges: list[Row], settings: Evaluation) -> list[Table]:
    """Return all tables."""
    tables = [tabulate_ranking(ranks, settings), tabulate_matching(matches, settings)] if ranks else []
    tables += [tabulate_groups(ranks, matches, key, settings) for key in BY if ranks]
    if merges:
        tables += [
            tabulate_merging(merges, "", settings),
            *(tabulate_merging(merges, key, settings) for key in BY),
            tabulate_descriptor_effect(merges),
        ]
        tables += (
            [tabulate_sites(select_last_variant(merges)), tabulate_independence(select_last_variant(merges), settings)]
            if settings.data.real
            else []
        )
    return [*tables, tabulate_reliability(matches, merges)]


def tabulate_short(matches: list[Row], ranks: list[Row], merges: list[Row], settings: Evaluation) -> list[Table]:
    """Return the tables that go into the documentation."""
    table_makers: dict[str, Callable[[], Table]] = {
        "ranking": lambda: tabulate_ranking(ranks, settings),
        "matching": lambda: tabulate_methods(matches, settings),
        "merging": lambda: tabulate_merging(merges, "area", settings),
        "kinds": lambda: tabulate_merging(merges, "modality", settings),
        "decides": lambda: tabulate_descriptor_effect(merges),
        "sites": lambda: tabulate_sites(select_last_variant(merges)),
        "independence": lambda: tabulate_independence(select_last_variant(merges), settings),
        "reliability": lambda: tabulate_reliability(select_last_variant(matches), select_last_variant(merges)),
        **{key: partial(tabulate_groups, ranks, matches, key, settings) for key in BY},
    }
    return [table_makers[name]() for name in settings.tables if (merges if name in OF_MERGES else ranks)]


def _describe_evaluation(ranks: list[Row], merges: list[Row], settings: Evaluation, command: str) -> str:
    rows = ranks or merges
    pairs, buildings = len({r["pair"] for r in rows}), len({r["building"] for r in rows})
    first = next(iter({r["variant"]: None for r in ranks}), "")
    queries = [sum(r[f"queries{g}"] for r in ranks if r["variant"] == first) for g in ("", "_twin")]
    by_chance = sum(r["chance"] for r in ranks if r["variant"] == first) / max(queries[0], 1)
    text = (
        f"{pairs} pairs of maps, {buildings} buildings"
        + (
            f", {queries[0]} rooms with a partner, {queries[1]} of them with a twin; by chance recall@1 is {by_chance:.2f}"
            if ranks
            else ""
        )
        + HOW_TO_READ
    )
    return "\n\n".join(([f"`{command}`"] if command else []) + [text])


HOW_TO_READ = (
    ". In brackets: 95 % intervals by bootstrap over physical buildings; with fewer than eight buildings their range, as 0.71, "
    "0.62–0.91 (4 buildings); for wrong merges the exact interval of the share of buildings with one. A match is right if both "
    "rooms are the same true room; recall counts the true rooms that both maps have. Twin: another, near-identical room in the "
    "other map."
)
