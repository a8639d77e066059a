"""Tables of the extraction's benchmark, as Markdown."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.extraction.classic import METHODS
from topomerge.io.atomic import replacing
from topomerge.statistics import interval_text

Row = dict[str, Any]
COLUMNS = {
    "iou": "IoU", "mcc": "MCC", "precision": "P", "recall": "R", "door_precision": "doors P", "door_recall": "doors R",
    "edge_precision": "edges P", "edge_recall": "edges R", "storeys": "storeys", "agreement": "agree", "seconds": "s",
}  # fmt: skip
FAILED = 0.5  # mean IoU
MARK = "extraction"
FIRST = ("thesis", "default")  # presets, in this order
PEER_COLUMNS = {
    "iou": "IoU", "mcc": "MCC", "precision": "P", "recall": "R", "survey_precision": "survey P", "survey_recall": "survey R",
}  # fmt: skip


def listing(rows: list[Row]) -> str:
    """A line a case."""
    lines = _head(["case", "preset", "rooms", *COLUMNS.values(), ""])
    for row in rows:
        counts = f"{row.get('found', 0)}/{row.get('rooms', '?')}"
        said = (row.get("missing") or row.get("error") or "")[:60]
        lines.append(_line([row["case"], row["preset"], counts, *(_cell(row.get(k)) for k in COLUMNS), said]))
    return "\n".join(lines)


def summary(rows: list[Row]) -> str:
    """A line a set and preset: means over its cases, with 95 % intervals over its buildings."""
    lines = _head(["set", "preset", "cases", *COLUMNS.values()])
    for name, preset in dict.fromkeys((r["set"], r["preset"]) for r in rows):
        these = [r for r in rows if (r["set"], r["preset"]) == (name, preset) and not r.get("missing")]
        lines.append(_line([name, preset, str(len(these)), *(_mean(these, k, k in ("iou", "mcc")) for k in COLUMNS)]))
    return "\n".join(lines)


def report(rows: list[Row], command: str) -> str:
    """The section for the results: the presets beside each other, by set and by kind of building, agreement, and failures."""
    rows = [r for r in rows if not r.get("missing")]
    if any(r["preset"] in METHODS for r in rows):
        return peers_report(rows, command)
    presets = [p for p in FIRST if any(r["preset"] == p for r in rows)]
    judged = [r for r in rows if "iou" in r]
    parts = [f"`{command}`", _about(judged), _beside(judged, presets, "set", "set")]
    simulated = [r for r in judged if r["set"].startswith("by ")]
    if simulated:
        parts += ["The same simulated buildings by kind:", _beside(simulated, presets, "kind", "building")]
    if any("agreement" in r for r in judged):
        parts += [AGREEMENT, _agreement(judged, presets)]
    parts += [_failures(judged), _storeys(judged)]
    return "\n\n".join(p for p in parts if p)


def peers_report(rows: list[Row], command: str) -> str:
    """The section of the classic methods: a line a set and method, the same maps for each."""
    judged = [r for r in rows if "iou" in r]
    methods = [m for m in ("default", *METHODS) if any(r["preset"] == m for r in judged)]
    lines = _head(["set", "maps", "method", *PEER_COLUMNS.values(), "s"])
    for group in dict.fromkeys(r["set"] for r in judged):
        for method in methods:
            these = [r for r in judged if (r["set"], r["preset"]) == (group, method)]
            first = [group, str(len(these))] if method == methods[0] else ["", ""]
            cells = [_mean(these, k, k in ("iou", "mcc")) for k in PEER_COLUMNS]
            lines.append(_line([*first, "ours" if method == "default" else method, *cells, _mean(these, "seconds", False)]))
    cases, places = len({r["case"] for r in judged}), len({r["place"] for r in judged})
    about = f"{cases} maps of {places} physical buildings. {BRACKETS}"
    return "\n\n".join([f"`{command}`", about, "\n".join(lines)])


BRACKETS = (
    "Means over the maps of a set; in brackets 95 % intervals over its physical buildings, the range of the buildings where "
    "they are fewer than eight."
)
AGREEMENT = (
    "Agreement of two maps of one place: mean and worst over the pairs of maps of the mean IoU of the rooms assigned to each "
    "other one to one, on the floor that both saw; of all: rooms that got no partner count 0. Two sessions have other sensors, "
    "other walks with 60 % of the rooms in common, and things moved between them; the others are compared with the map of the "
    "same scan at 4 cm spacing in cells of 10 cm."
)


def _about(rows: list[Row]) -> str:
    cases, places = len({r["case"] for r in rows}), len({r["place"] for r in rows})
    return (
        f"{cases} maps of {places} physical buildings. {BRACKETS} "
        "P and R: precision and recall (rooms at IoU 0.5, doors within 0.5 m, pairs of rooms that are joined). Storeys: share of "
        "the maps with as many as there are, each within 0.5 m. Seconds of work of one core."
    )


def _beside(rows: list[Row], presets: list[str], key: str, title: str) -> str:
    """A line a group: the presets beside each other."""
    shown = {k: v for k, v in COLUMNS.items() if k != "agreement"}
    wide = ("iou", "mcc", "seconds")
    head = [title, "maps"]
    for k, name in shown.items():
        head += [f"{name} {p}" for p in presets] if k in wide else [name]
    lines = _head(head)
    for group in dict.fromkeys(r[key] for r in rows):
        these = [r for r in rows if r[key] == group]
        cells = [group, str(len({r["case"] for r in these}))]
        for k in shown:
            for p in presets if k in wide else presets[-1:]:
                cells.append(_mean([r for r in these if r["preset"] == p], k, p == presets[-1] and k in ("iou", "mcc")))
        lines.append(_line(cells))
    return "\n".join(lines)


def _agreement(rows: list[Row], presets: list[str]) -> str:
    lines = _head(["set", "maps", *(f"{p}: mean | {p}: worst | {p}: of all" for p in presets)], 2 + 3 * len(presets))
    for group in dict.fromkeys(r["set"] for r in rows if "agreement" in r):
        these = [r for r in rows if r["set"] == group and "agreement" in r]
        cells = [group, str(len({r["case"] for r in these}))]
        for p in presets:
            values = [r["agreement"] for r in these if r["preset"] == p]
            mine = [r for r in these if r["preset"] == p]
            cells += [
                _mean(mine, "agreement", True),
                f"{min(values):.2f}" if values else "–",
                _mean(mine, "agreement_all", False),
            ]
        lines.append(_line(cells))
    return "\n".join(lines)


def _failures(rows: list[Row]) -> str:
    """Maps of the default preset with a mean IoU below `FAILED`, the worst first."""
    bad = sorted((r for r in rows if r["preset"] == "default" and r["iou"] < FAILED), key=lambda r: r["iou"])
    count = {p: sum(r["iou"] < FAILED for r in rows if r["preset"] == p) for p in FIRST}
    lines = [f"Mean IoU below {FAILED}: {count['default']} maps of the default preset, {count['thesis']} of the thesis'."]
    for row in bad:
        why = row["error"] or ", ".join(f"{name} {iou:.2f}" for name, iou in row.get("worst", {}).items())
        lines.append(f"- {row['case']}: {row['iou']:.2f} ({row.get('found', 0)} rooms found of {row.get('rooms', '?')}; {why})")
    return "\n".join([lines[0], "", *lines[1:]]).strip()


def _storeys(rows: list[Row]) -> str:
    wrong = [r for r in rows if r["preset"] == "default" and not r["storeys"] and not r["error"]]
    if not wrong:
        return ""
    storey_counts = [f"{r['case']} ({r['levels_found']} instead of {r['levels']})" for r in wrong]
    return "Storeys wrong: " + "; ".join(storey_counts) + "."


def write(path: Path, rows: list[Row], command: str, mark: str = MARK) -> None:
    """Replace what stands between the two marks of a file by the report."""
    replace_section(path, report(rows, command), mark)


def replace_section(path: Path, section: str, mark: str) -> None:
    """Replace what stands between the two marks of a file, or add marks and section at its end."""
    begin, end = f"<!-- {mark}:begin -->", f"<!-- {mark}:end -->"
    text = path.read_text(encoding="utf-8") if path.exists() else "# Results\n"
    if begin not in text or end not in text:
        text = f"{text.rstrip()}\n\n## {mark.capitalize()}\n\n{begin}\n{end}\n"
    before, rest = text.split(begin, 1)
    after = rest.split(end, 1)[1]
    with replacing(path) as beside:
        beside.write_text(f"{before}{begin}\n{section}\n{end}{after}", encoding="utf-8")


def _head(names: list[str], count: int | None = None) -> list[str]:
    return [_line(names), "|" + "---|" * (count or len(names))]


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _cell(value: Any) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.2f}"


def _mean(rows: list[Row], key: str, interval: bool) -> str:
    values = np.array([r.get(key, np.nan) for r in rows], float)
    text = interval_text(values, np.array([r["place"] for r in rows]))
    return text if interval else re.split(r"[, ]", text)[0]
