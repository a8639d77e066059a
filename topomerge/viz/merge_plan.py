"""Plans of two maps in one frame: one over the other, and both turned alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from topomerge.types import Array, Sim3, TopometricMap
from topomerge.viz.markup import Markup, element
from topomerge.viz.outline import room_outlines, wall_outline
from topomerge.viz.plan import StoreyPlan
from topomerge.viz.report import zoom_buttons
from topomerge.viz.sheet import Sheet, lay_out
from topomerge.viz.svg import drawing

Drawn = tuple[Sheet, list[StoreyPlan]]
LEVEL_TOLERANCE = 0.7  # m by which floors of one storey may differ
AFFINE_REACH = 10_000  # cm: places on the paper are rounded, so an affine map is measured over a long way


def laid_alike(a: TopometricMap, b: TopometricMap, pose: Sim3 | None) -> tuple[Drawn, Drawn]:
    """Paper and plans of both maps; b's is turned as a's where it is known how b lies in a."""
    first = lay_out(a, "a")
    return first, lay_out(b, "b", None if pose is None else first[0].turn + pose.yaw)


def blend_view(a: TopometricMap, b: TopometricMap, drawn: tuple[Drawn, Drawn], pose: Sim3) -> Markup:
    """Both plans in the frame of a, with a slider that shows the one, the other or both.

    Args:
        drawn: of `laid_alike`.
        pose: T_ab.
    """
    (sheet_a, plans_a), (sheet_b, plans_b) = drawn
    paper = _around(sheet_a, sheet_b, pose)
    figures, names = [], []
    for k, (i, j) in enumerate(levels(a, b, pose)):
        layers = []
        for name, sheet, plans, storey, move in (
            ("a", sheet_a, plans_a, i, Sim3()),
            ("b", sheet_b, plans_b, j, pose),
        ):
            if storey is not None:
                layers.append(_layer(name, plans[storey], sheet, onto(sheet, paper, move)))
        parts = [f"storey {s} of {name}" for name, s in (("a", i), ("b", j)) if s is not None]
        names.append(" on ".join(reversed(parts)).capitalize())
        picture = drawing(a, replace(paper, key=f"ab{k}-"), 0, layers)
        figures.append(element("figure", element("figcaption", element("b", names[-1])), picture, data_storey=k))
    choices = [element("button", name, type="button", data_storey=k) for k, name in enumerate(names) if len(names) > 1]
    slider = element("input", type="range", min="0", max="1", step="0.01", value="0.5", data_blend=True, aria_label="From a to b")
    bar = element("div", _source("a", a), slider, _source("b", b), class_="blend")
    groups = [bar, *([element("div", *choices, class_="choices")] if choices else [])]
    controls = element("div", *groups, element("div", *zoom_buttons(), class_="zoom"), class_="controls")
    hint = element("p", "Walls of one map that lie on walls of the other speak for the merge.", class_="told", aria_live="polite")
    return element("div", controls, element("div", *figures, class_="sheet", tabindex=0), hint, class_="plan-view")


def levels(a: TopometricMap, b: TopometricMap, pose: Sim3) -> list[tuple[int | None, int | None]]:
    """(storey of a, storey of b) that lie at one height, and those that lie at no other's; lowest first of a, then of b."""
    floors_a = a.storeys["floor"] if len(a.storeys) else np.zeros(1)
    floors_b = pose.scale * b.storeys["floor"] + pose.translation[2] if len(b.storeys) else floors_a[:1]
    pairs: list[tuple[int | None, int | None]] = []
    taken: set[int] = set()
    for i, floor in enumerate(floors_a):
        near = [
            j
            for j in np.argsort(np.abs(floors_b - floor)).tolist()
            if abs(floors_b[j] - floor) <= LEVEL_TOLERANCE and j not in taken
        ]
        taken.update(near[:1])
        pairs.append((i, near[0] if near else None))
    pairs += [(None, j) for j in range(len(floors_b)) if j not in taken]
    return sorted(pairs, key=lambda p: p[0] is None or p[1] is None)


def onto(sheet: Sheet, paper: Sheet, pose: Sim3) -> Array:
    """(2, 3) affine map of places on one paper onto another, cm.

    Args:
        pose: of the first paper's map in the frame of the other's.
    """
    corners = np.array([[0, 0], [AFFINE_REACH, 0], [0, AFFINE_REACH]], float)
    to = paper.cm(pose.apply(np.column_stack([metres(sheet, corners), np.zeros(3)]))).astype(float)
    return np.column_stack([(to[1] - to[0]) / AFFINE_REACH, (to[2] - to[0]) / AFFINE_REACH, to[0]])


def metres(sheet: Sheet, places: Array) -> Array:
    """(n, 2) m in the map's frame, of places (n, 2) on its paper, cm."""
    back = np.array(sheet.back).reshape(2, 3)
    out: Array = places @ back[:, :2].T + back[:, 2]
    return out


def _around(a: Sheet, b: Sheet, pose: Sim3) -> Sheet:
    """A paper in a's frame, turned as a's, that holds what both show."""
    ends = []
    for sheet, move in ((a, Sim3()), (b, pose)):
        width, height = sheet.size
        corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], float)
        ends.append(a.cm(move.apply(np.column_stack([metres(sheet, corners), np.zeros(4)]))))
    corners_of_both = np.concatenate(ends)
    low, high = corners_of_both.min(axis=0), corners_of_both.max(axis=0)
    x, y = low.tolist()
    wide, tall = (high - low).tolist()
    return replace(a, key="ab", corner=a.corner + np.array([x, -y]) / 100, size=(wide, tall))


def _layer(name: str, plan: StoreyPlan, sheet: Sheet, move: Array) -> Markup:
    ground = [element("path", class_="ground", d=d, fill_rule="evenodd") for d in room_outlines(plan, sheet).values()]
    walls = element("path", d=wall_outline(plan, sheet), fill_rule="evenodd")
    matrix = "matrix(" + " ".join(f"{v:.6g}" for v in move.T.ravel()) + ")"
    return element("g", *ground, walls, class_=f"of-{name}", transform=matrix)


def _source(name: str, map: TopometricMap) -> Markup:
    sign = element("i", class_=f"sign-{name}")
    return element("span", sign, name, class_="legend", title=map.source or None)
