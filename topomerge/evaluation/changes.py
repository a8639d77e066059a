"""Evaluation of detected changes: sessions with known changes, sessions without any, and building models with planted deviations.

``python evaluate.py task=changes`` scans buildings of the test seeds twice (``data=dev``: of training seeds, by which thresholds
were chosen), extracts both maps, aligns them as `topomerge diff` does, and compares. A true change counts as found if a change of
its kind lies on it; of what one session could not see, neither finding nor missing counts. A model of the real set is scanned by
simulated sensors; some of its walls are shifted in the model by a known distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

import numpy as np
import shapely

from topomerge.changes.compare import Change, Changes, align_maps, compare_maps
from topomerge.changes.model import compare_with_model
from topomerge.code_digest import compute_code_digest
from topomerge.datasets.buildings.layouts import BUILDING_KINDS
from topomerge.datasets.real.ifc import find_ground, load_model_building
from topomerge.datasets.simulation.changed_sessions import ChangedPair, TrueChange, make_changed_pair
from topomerge.datasets.simulation.scanner import scan_building
from topomerge.evaluation.documents import write_table
from topomerge.evaluation.tasks import Row, TaskSettings, find_real_data, limit_cases, measure_missing
from topomerge.extraction.extract import extract
from topomerge.io.ifc import ModelElement, read_elements
from topomerge.io.points import read_chunks
from topomerge.statistics import format_interval
from topomerge.types import Array, LogFn, Placement, Sim3

MAKERS = ("topomerge.changes.compare", "topomerge.changes.model", "topomerge.extraction.extract",
          "topomerge.datasets.simulation.changed_sessions")  # fmt: skip
TEST_SEEDS, DEV_SEEDS = 905_300, 5_930  # first seeds
SENSORS = (("tls", "depth"), ("lidar", "tls"), ("depth", "lidar"))
SMALL = ("apartment", "house")
UNCHANGED = 3  # every third pair has no change, each kind of building and each pair of sensors as often
PLACED = 0.8  # m between a change and a true one that it is
TRUTH_KINDS = {"door cut": "door new"}
GROUPS = {
    "walls new": ("wall new",), "walls gone": ("wall gone",), "doors opened": ("door opened",), "doors shut": ("door shut",),
    "doors new or gone": ("door new", "door gone"), "doors bricked up": ("door bricked up",),
    "rooms split or joined": ("room split", "room joined"),
    "furniture new": ("furniture new",), "furniture gone": ("furniture gone",),
}  # fmt: skip
MODELS = {"dev": (), "": ("duplex", "Office_A_20110811")}
MODEL_SENSORS = ("tls", "lidar")
PLANTED, PLANTED_WALLS = (0.02, 0.05, 0.10), 8  # m; of each model, so many walls of each at most, and
PLANTED_SHARE = 0.4  # of those that the scan shows: what most walls share is how the scan lies, and no deviation
LONG_WALL = 1.5  # m: shorter walls are not shifted
MODEL_SPACING = 0.05  # m between points of a scan
RIGHT = 0.01  # m
ANCHOR = np.array([[5.0, 5.0, 0.0]])  # m, where poses are compared


@dataclass(frozen=True)
class Case:
    """Two sessions in a building, or a scan of a model."""

    kind: str
    seed: int
    sensors: tuple[str, ...]
    changed: bool = True

    @property
    def name(self) -> str:
        """Names the row."""
        return f"{self.kind}-{self.seed}-{'-'.join(self.sensors)}{'' if self.changed else '-same'}"


def draw_cases(development: bool) -> list[Case]:
    """Draw each kind of building by each pair of sensors."""
    first = DEV_SEEDS if development else TEST_SEEDS
    built = [(kind, sensors) for kind in BUILDING_KINDS for sensors in SENSORS]
    cases = [Case(kind, first + i, sensors, (i + i // len(SENSORS)) % UNCHANGED != 0) for i, (kind, sensors) in enumerate(built)]
    small = [case for case in cases if case.kind in SMALL]  # come first, so that a limit takes what is quickly measured
    models = MODELS["dev" if development else ""]
    scans = [Case(name, k, (sensor,)) for k, sensor in enumerate(MODEL_SENSORS) for name in models]
    return [*small, *scans, *(case for case in cases if case.kind not in SMALL)]


def list_inputs(settings: TaskSettings) -> list[str]:
    """Return names of the cases."""
    return [case.name for case in limit_cases(draw_cases(settings.data.set == "dev"), settings)]


def measure(settings: TaskSettings, log_line: LogFn) -> list[Row]:
    """Measure each case."""
    cases = limit_cases(draw_cases(settings.data.set == "dev"), settings)
    path = Path(settings.cache) / "evaluation" / "changes.jsonl"
    items = {case.name: (case,) for case in cases}
    return measure_missing(path, items, measure_case, log_line, settings, compute_code_digest(*MAKERS, __name__))


def measure_case(case: Case) -> Row:
    """Make a case and score what is found."""
    row: Row = {"building": case.kind, "place": f"{case.kind}-{case.seed}", "sensors": " → ".join(case.sensors)}
    return row | (score_model(case) if len(case.sensors) == 1 else score_pair(case))


def score_pair(case: Case) -> Row:
    """Score the changes between two sessions: found, false and missed of each of `GROUPS`."""
    first, second = case.sensors
    pair = make_changed_pair(case.kind, case.seed, (first, second), case.changed)
    maps = [extract(replace(cloud, labels=None, rooms=())) for cloud in pair.clouds]
    began = process_time()
    placement, _, _ = align_maps(maps[0], maps[1])
    aligned = process_time()
    row: Row = {"what": "changed" if case.changed else "same", "aligned": placement is not None}
    if placement is None:
        return row
    changes = compare_maps(maps[0], maps[1], placement)
    row |= {"align_s": aligned - began, "compare_s": process_time() - aligned, "m2": sum(changes.compared.values())}
    reported = list_reported(changes, pair)
    row["groups"] = {name: score_kinds(reported, pair.changes, kinds) for name, kinds in GROUPS.items()}
    elements = [c.element for c in changes.changes]
    row["alarms"] = {e: elements.count(e) for e in ("wall", "door", "room", "furniture")}
    return row


def list_reported(changes: Changes, pair: ChangedPair) -> list[tuple[str, Array]]:
    """List kind and place (2,) m, in the building's coordinates, of what is said to have changed; what moved is gone and new."""
    back = pair.frames[0].inverse()

    def place(change: Change, point: Array) -> Array:
        out: Array = back.apply(point[None])[0, :2]
        return out

    reported = []
    for change in changes.changes:
        moved = change.kind == "furniture moved"
        reported.append(("furniture new" if moved else change.kind, place(change, change.place)))
        if moved and change.from_place is not None:
            reported.append(("furniture gone", place(change, change.from_place)))
    return reported


def score_kinds(reported: Sequence[tuple[str, Array]], true: Sequence[TrueChange], kinds: Sequence[str]) -> list[int]:
    """Count [right, told, found, true] of some kinds: of what is told, right or on something unseen; of what was seen, found."""
    own = [at for kind, at in reported if kind in kinds]
    real = [t for t in true if TRUTH_KINDS.get(t.kind, t.kind) in kinds]
    apart = np.array([[shapely.distance(t.outline, shapely.Point(at)) for t in real] for at in own]).reshape(len(own), len(real))
    right, unjudged, taken = 0, 0, set()
    for k in np.argsort(apart.min(axis=1, initial=np.inf), kind="stable").tolist():
        near = [j for j in np.argsort(apart[k]).tolist() if apart[k, j] <= PLACED]
        free = [j for j in near if j not in taken]
        if free:
            taken.add(free[0])
            right, unjudged = right + real[free[0]].seen, unjudged + (not real[free[0]].seen)
        elif near:
            unjudged += 1  # the same thing once more
    seen = [j for j, t in enumerate(real) if t.seen]
    return [right, len(own) - unjudged, len(taken & set(seen)), len(seen)]


def score_model(case: Case) -> Row:
    """Scan a model and shift some of its walls; how far off each is said to be."""
    path = find_real_data() / "ifc_buildings" / f"{case.kind}.ifc"
    rng = np.random.default_rng([53, case.seed])
    building = load_model_building(path)
    storey = int(np.bincount([r.storey for r in building.rooms]).argmax())
    visited = [i for i, r in enumerate(building.rooms) if r.storey == storey and r.kind != "lift"]
    cloud = scan_building(building, case.sensors[0], visited, rng, MODEL_SPACING)
    scan, model = extract(replace(cloud, labels=None, rooms=())), extract(read_chunks(str(path)), name=path.name)
    placement, reason, _ = align_maps(model, scan, same="building")
    truth = Sim3(0.0, (0.0, 0.0, find_ground(path, building)))
    off = np.inf if placement is None else float(np.linalg.norm(placement.pose.apply(ANCHOR) - truth.apply(ANCHOR)))
    row: Row = {"what": "model", "aligned": placement is not None, "off": round(off, 3) if np.isfinite(off) else None}
    if placement is None:  # the deviations are measured all the same
        placement, row["reason"] = Placement(truth), reason
    elements = read_elements(path)
    asked = {r.element.guid: r for r in compare_with_model(elements, model, scan, placement).elements}
    walls = [k for k, e in enumerate(elements) if e.kind == "wall" and np.ptp(e.vertices[:, :2], axis=0).max() > LONG_WALL]
    shown = [k for k in walls if asked[elements[k].guid].state in ("seen", "elsewhere")]
    most = min(PLANTED_WALLS * len(PLANTED), max(round(PLANTED_SHARE * len(shown)), 1))
    drawn = rng.permutation(shown)[:most].tolist()
    planted = {k: (PLANTED[n % len(PLANTED)] * float(rng.choice([-1, 1]))) for n, k in enumerate(drawn)}
    moved = [shift_element(e, asked[e.guid].normal * planted[k]) if k in planted else e for k, e in enumerate(elements)]
    began = process_time()
    rows = {r.element.guid: r for r in compare_with_model(moved, model, scan, placement).elements}
    planted_rows = [(by, rows[elements[k].guid]) for k, by in planted.items()]
    found = [(by, -r.shift, r.state) for by, r in planted_rows]  # it is the model's wall that is shifted: the scan's is behind it
    others = [rows[elements[k].guid].state for k in shown if k not in planted]
    row |= {"compare_s": process_time() - began, "found": found, "others": others}
    return row | {"states": [r.state for r in asked.values()], "sigma": float(np.nanmedian([r.sigma for r in rows.values()]))}


def shift_element(element: ModelElement, by: Array) -> ModelElement:
    """Return an element at another place."""
    return replace(element, vertices=element.vertices + by)


def tabulate(rows: Sequence[Row], settings: TaskSettings) -> dict[str, str]:
    """Tabulate precision and recall of each group, false alarms where nothing changed, and the deviations of models."""
    return {
        "changes": _tabulate_groups([r for r in rows if r["what"] == "changed"]),
        "changes-same": _tabulate_same([r for r in rows if r["what"] == "same"]),
        "changes-models": _tabulate_models([r for r in rows if r["what"] == "model"]),
    }


def _tabulate_groups(rows: Sequence[Row]) -> str:
    used = [r for r in rows if r["aligned"]]
    lines = []
    for name in GROUPS:
        counts = np.array([r["groups"][name] for r in used]).reshape(-1, 4)
        right, reported, found, true = counts.sum(axis=0).tolist()
        lines.append([name, true, write_ratio(counts[:, 0], counts[:, 1], used), f"{right} of {reported}",
                      write_ratio(counts[:, 2], counts[:, 3], used), f"{found} of {true}"])  # fmt: skip
    head = f"{len(rows)} pairs of sessions with changes, {len(used)} of them aligned. 95 % intervals over buildings."
    return f"{head}\n\n{write_table(('what', 'true', 'precision', '', 'recall', ''), lines)}"


def _tabulate_same(rows: Sequence[Row]) -> str:
    used = [r for r in rows if r["aligned"]]
    lines = []
    for sensors in (*dict.fromkeys(r["sensors"] for r in used), "all") if used else ():
        some = [r for r in used if sensors in (r["sensors"], "all")]
        counts = {e: np.array([r["alarms"][e] for r in some]) for e in ("wall", "door", "room", "furniture")}
        total = np.sum(list(counts.values()), axis=0)
        cells = [f"{c.mean():.2f}" for c in counts.values()]
        lines.append([sensors, len(some), *cells, format_interval(total, np.array([r["place"] for r in some]))])
    head = f"{len(rows)} pairs of sessions between which nothing changed, one storey each, {len(used)} of them aligned."
    columns = ("sensors", "storeys", "walls", "doors", "rooms", "furniture", "all, a storey")
    return f"{head}\n\n{write_table(columns, lines)}"


def _tabulate_models(rows: Sequence[Row]) -> str:
    lines = []
    for row in rows:
        cells = ["yes" if row["aligned"] else "no: given"]
        for by in PLANTED:
            own = [(p, s, state) for p, s, state in row["found"] if abs(abs(p) - by) < 1e-6]
            hits = [abs(s - p) for p, s, state in own if state == "elsewhere" and abs(s - p) <= RIGHT]
            cells.append(f"{len(hits)} of {len(own)}")
        error = [abs(s - p) for p, s, state in row["found"] if state in ("seen", "elsewhere")]
        false = sum(state == "elsewhere" for state in row["others"])
        cells += [f"{100 * float(np.median(error)):.1f}" if error else "–", f"{false} of {len(row['others'])}"]
        states = [f"{row['states'].count(s)} {s}" for s in dict.fromkeys(row["states"])]
        lines.append([row["building"], row["sensors"], *cells, ", ".join(states)])
    columns = (
        "model",
        "sensor",
        "aligned",
        *(f"{100 * by:.0f} cm found" for by in PLANTED),
        "median error cm",
        "false",
        "elements",
    )
    return write_table(columns, lines) if lines else "No models."


def write_ratio(part: Array, whole: Array, rows: Sequence[Row]) -> str:
    """Write a ratio of sums over rows with its interval over buildings (`statistics.format_interval`)."""
    values = [np.repeat([1.0, 0.0], [int(p), int(w - p)]) for p, w in zip(part, whole, strict=True)]
    places = np.repeat([r["place"] for r in rows], [len(v) for v in values])
    return format_interval(np.concatenate(values), places) if values else "–"
