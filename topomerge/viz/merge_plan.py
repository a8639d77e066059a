"""Plans of two maps in one frame: one over the other, and both turned alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from topomerge.types import Array, Deformation, Sim3, TopometricMap
from topomerge.viz.bend_plan import CUT_HEIGHT, PieceShifts, arrow_factor, arrows, bend_controls, bend_words, bent_path
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


def blend_view(
    a: TopometricMap, b: TopometricMap, drawn: tuple[Drawn, Drawn], pose: Sim3, bends: Mapping[int, Deformation] | None = None
) -> Markup:
    """Both plans in the frame of a, with a slider that shows the one, the other or both; where one is bent, with arrows and a
    slider from rigid to bent.

    Args:
        drawn: of `laid_alike`.
        pose: T_ab.
        bends: 0 or 1 -> how a or b is bent.
    """
    (sheet_a, plans_a), (sheet_b, plans_b) = drawn
    bent = {n: bend for n, bend in (bends or {}).items() if len(bend)}
    sides = [_Side("a", a, sheet_a, plans_a, Sim3(), bent.get(0)), _Side("b", b, sheet_b, plans_b, pose, bent.get(1))]
    paper = _around(sheet_a, sheet_b, pose)
    factor = arrow_factor([PieceShifts.of(side.bend) for side in sides], paper)
    figures, names = [], []
    for k, storeys in enumerate(levels(a, b, pose)):
        layers = [_layer(side, s, paper, factor) for side, s in zip(sides, storeys, strict=True) if s is not None]
        parts = [f"storey {s} of {name}" for name, s in zip("ab", storeys, strict=True) if s is not None]
        names.append(" on ".join(reversed(parts)).capitalize())
        picture = drawing(a, replace(paper, key=f"ab{k}-"), 0, layers)
        figures.append(element("figure", element("figcaption", element("b", names[-1])), picture, data_storey=k))
    choices = [element("button", name, type="button", data_storey=k) for k, name in enumerate(names) if len(names) > 1]
    slider = element("input", type="range", min="0", max="1", step="0.01", value="0.5", data_blend=True, aria_label="From a to b")
    bar = element("div", _source("a", a), slider, _source("b", b), class_="blend")
    groups = [bar, *([bend_controls()] if bent else []), *([element("div", *choices, class_="choices")] if choices else [])]
    controls = element("div", *groups, element("div", *zoom_buttons(), class_="zoom"), class_="controls")
    hint = element("p", "Walls of one map on walls of the other support the merge.", class_="told", aria_live="polite")
    words = [element("p", bend_words(len(bent), factor), class_="note")] if bent else []
    return element("div", controls, element("div", *figures, class_="sheet", tabindex=0), hint, *words, class_="plan-view")


@dataclass(frozen=True, eq=False)
class _Side:
    """One of the two maps: how the page calls it, its paper and plans, where it lies and how it is bent."""

    name: str
    map: TopometricMap
    sheet: Sheet
    plans: list[StoreyPlan]
    pose: Sim3
    bend: Deformation | None


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
    to = paper.cm(pose.apply(np.column_stack([sheet.metres(corners), np.zeros(3)]))).astype(float)
    return np.column_stack([(to[1] - to[0]) / AFFINE_REACH, (to[2] - to[0]) / AFFINE_REACH, to[0]])


def _around(a: Sheet, b: Sheet, pose: Sim3) -> Sheet:
    """A paper in a's frame, turned as a's, that holds what both show."""
    ends = []
    for sheet, move in ((a, Sim3()), (b, pose)):
        width, height = sheet.size
        corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], float)
        ends.append(a.cm(move.apply(np.column_stack([sheet.metres(corners), np.zeros(4)]))))
    corners_of_both = np.concatenate(ends)
    low, high = corners_of_both.min(axis=0), corners_of_both.max(axis=0)
    x, y = low.tolist()
    wide, tall = (high - low).tolist()
    return replace(a, key="ab", corner=a.corner + np.array([x, -y]) / 100, size=(wide, tall))


def _layer(side: _Side, storey: int, paper: Sheet, factor: int) -> Markup:
    plan, sheet = side.plans[storey], side.sheet
    ground = [_outline(d, side, storey, "ground") for d in room_outlines(plan, sheet).values()]
    signs = [] if side.bend is None else [arrows(side.name, PieceShifts.of(side.bend), storey, sheet, factor)]
    matrix = "matrix(" + " ".join(f"{v:.6g}" for v in onto(sheet, paper, side.pose).T.ravel()) + ")"
    walls = _outline(wall_outline(plan, sheet), side, storey)
    return element("g", *ground, walls, *signs, class_=f"of-{side.name}", transform=matrix)


def _outline(d: str, side: _Side, storey: int, name: str | None = None) -> Markup:
    """An outline; of a bent map as it is bent, with the rigid one for the slider."""
    if side.bend is None:
        return element("path", class_=name, d=d, fill_rule="evenodd")
    floor = float(side.map.storeys["floor"][storey]) if len(side.map.storeys) else 0.0
    rigid, bent = bent_path(d, side.sheet, side.bend, floor + CUT_HEIGHT)
    return element("path", class_=name, d=bent, data_rigid=rigid, fill_rule="evenodd")


def _source(name: str, map: TopometricMap) -> Markup:
    sign = element("i", class_=f"sign-{name}")
    return element("span", sign, name, class_="legend", title=map.source or None)
