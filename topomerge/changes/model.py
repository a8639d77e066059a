"""A building model against a scan: which of its elements were seen, seen elsewhere and by how much, or are not there.

Each wall, column and slab is laid into the scan as planes. What the scan shows near a plane is counted by its distance along the
normal, both faces of a wall together: the shift at which most of the element is found is where it stands. A point counts for the
face that looks to the open ground before it: of a wall seen from one side, its other face explains nothing. A turn and a shift
that all elements share are taken out first: that is how the scan lies on the model, and no deviation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.special import ndtr

from topomerge.changes.compare import Change, Changes, compare_maps
from topomerge.changes.doors import SAME_DOOR, DoorReader, read_state
from topomerge.changes.layers import PlacedMap, StoreyLayers, build_storey_layers
from topomerge.io.ifc import ModelElement
from topomerge.types import EDGE_DTYPE, Array, TopometricMap

FARTHEST_SHIFT, SHIFT_BIN = 0.3, 0.01  # m
FACE_BIN = 0.12  # m, of the cells of a face
FLAT, SAME_NORMAL = 0.2, 0.97  # |z| of the normal of an upright face; cosine
SUPPORT_REACH = 0.025  # m about a shift, within which the scan supports it
STAYS = 0.6  # share by which a shift must be better supported than none: one face of a wall may lie where the other one was
EXPLAINED, BESIDE = 0.03, 0.1  # m off a face and beside its nearest sample: such points of the scan are of that face
NEIGHBOURS = 6  # samples that are asked
LEAST_SEEN, LEAST_CELLS = 0.2, 12  # share of the cells of an element, and how many
GONE = 0.5  # share of an element's ground that was seen empty
TOLERANCE = 0.01  # m: less is how things are built
LEAST_SIGMA = 0.004  # m
OPEN_STEPS, OPEN_APART = np.arange(0.05, 0.51, 0.05), 0.025  # m before a point, where open ground is looked for; how much nearer
GAP = 5  # pixels: narrower gaps, as between the faces of a wall, are no open ground
FLOOR_REACH = 0.3  # m about the floor of a storey: what lies there looks upwards, all other level faces down
DEVIATING = 0.2  # odds that an element stands elsewhere, before anything was measured
MIXED = 1.0  # cells of the scan, by which the mean of a cell at the edge of a face is off
DOOR_SIGMA, DOOR_REACH, DOOR_ACROSS = 0.1, 1.2, 0.35  # m: of the middle of a door; along and across its wall, where it may be
STATES = ("seen", "elsewhere", "missing", "unseen")
IGNORED = ("wall gone", "door gone", "furniture gone", "door opened", "door shut", "door bricked up", "door new")


@dataclass(frozen=True, eq=False)
class ElementRow:
    """An element of a model, and where the scan shows it.

    Args:
        element: of the model.
        state: "seen", "elsewhere", "missing" (its place is empty) or "unseen".
        shift: m along `normal`, by which it stands elsewhere; nan where it was not seen.
        sigma: m, standard deviation of the shift.
        normal: (3,) unit, of its faces, in the model's frame.
        share: of its faces, that the scan shows at that shift.
        probability: of the state.
    """

    element: ModelElement
    state: str
    shift: float
    sigma: float
    normal: Array
    share: float
    probability: float

    def serialise(self) -> dict[str, Any]:
        """Return the row as plain values; lengths in cm."""
        known = np.isfinite(self.shift)
        return {
            "guid": self.element.guid,
            "kind": self.element.kind,
            "name": self.element.name,
            "state": self.state,
            "shift_cm": round(100 * self.shift, 2) if known else None,
            "sigma_cm": round(100 * self.sigma, 2) if known else None,
            "normal": np.round(self.normal, 4).tolist(),
            "share": round(self.share, 3),
            "probability": round(self.probability, 4),
        }


def compare_with_model(
    elements: Sequence[ModelElement],
    model: TopometricMap,
    scan: TopometricMap,
    placement: PlacedMap,
    least: float = 0.5,
) -> Changes:
    """Compare a scan with a building model: its elements one by one, and what stands there that is not modelled.

    Args:
        elements: of the model (`io.ifc.read_elements`).
        model, scan: maps of both.
        placement: takes the scan into the model's frame.
        least: as of `compare_maps`.

    Raises:
        InputError: as `compare_maps`.
    """
    found = compare_maps(model, scan, placement, least)
    layers, reader = build_storey_layers(model, scan, placement), DoorReader(model, scan, placement)
    points = _OwnedPoints(elements, reader.points[1])
    measured = [k for k, e in enumerate(elements) if e.kind in ("wall", "column", "slab")]
    faces = {k: _measure_planes(elements[k], points.select(k), layers, scan.grid.edge) for k in measured}
    correct = estimate_common_shift([shift for shifts in faces.values() for shift in shifts])
    doors = _ModelDoors([e for e in elements if e.kind == "door"], layers, reader)
    rows = [
        doors.judge(e) if e.kind == "door" else _judge_element(e, faces[k], layers, correct)
        for k, e in enumerate(elements)
        if e.kind != "other"
    ]
    deviating = [_build_change(row, layers) for row in rows if row.state in ("elsewhere", "missing") and row.probability >= least]
    unmodelled = [c for c in found.changes if c.kind not in IGNORED]
    return replace(found, changes=(*deviating, *unmodelled), elements=tuple(rows))


class _OwnedPoints:
    """Points of a scan, and on whose faces they lie: what shows another element is no trace of this one.

    Args:
        elements: of the model.
        points: (n, 3) m, in the model's frame.
    """

    def __init__(self, elements: Sequence[ModelElement], points: Array) -> None:
        low, high = points.min(axis=0) - FARTHEST_SHIFT, points.max(axis=0) + FARTHEST_SHIFT
        samples, normals, owners = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0, np.int64)]
        for k, element in enumerate(elements):
            corners = element.vertices[element.faces]
            corners = corners[((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low)).all(axis=1)]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            area = np.linalg.norm(normal, axis=1) / 2
            count = _count_samples(area)
            samples.append(_sample_triangles(corners, area))
            normals.append(np.repeat(normal / np.maximum(2 * area[:, None], 1e-12), count, axis=0))
            owners.append(np.full(int(count.sum()), k))
        self.points, at = points, np.concatenate(samples)
        far, near = cKDTree(at).query(points, NEIGHBOURS, distance_upper_bound=BESIDE) if len(at) else (np.inf, 0)
        found = np.isfinite(np.broadcast_to(far, (len(points), NEIGHBOURS)))
        near = np.where(found, np.broadcast_to(near, found.shape), 0)
        off = np.abs(((points[:, None] - at[near]) * np.concatenate(normals)[near]).sum(axis=2)) if len(at) else far
        self.owner = np.where(found & (off <= EXPLAINED), np.concatenate(owners)[near], -1) if len(at) else near - 1

    def select(self, element: int) -> Array:
        """Select the points (n, 3) that are of an element, or of none."""
        others = (self.owner >= 0) & (self.owner != element)
        out: Array = self.points[(self.owner == element).any(axis=1) | ~others.any(axis=1)]
        return out


@dataclass(frozen=True, eq=False)
class PlaneShift:
    """The shift of an element along one normal.

    Args:
        normal: (3,) unit.
        centre: (3,) m.
        shift, spread: m, and the standard deviation of what it was measured by; nan where nothing was seen.
        share, cells: of its faces that were found there, and of how many cells.
        area: m2 of the faces.
        mixed: m, by which the cells of the scan at its edges may be off: much of what is seen of a narrow face.
    """

    normal: Array
    centre: Array
    shift: float
    spread: float
    share: float
    cells: int
    area: float
    mixed: float = 0.0


def _measure_planes(element: ModelElement, points: Array, layers: Sequence[StoreyLayers], edge: float) -> list[PlaneShift]:
    """Return the shift of an element along the normals of its larger faces: one of a wall or a slab, two of a column."""
    corners = element.vertices[element.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1) / 2
    normals = normals / np.maximum(2 * area[:, None], 1e-12)
    low, high = corners.min(axis=(0, 1)) - FARTHEST_SHIFT, corners.max(axis=(0, 1)) + FARTHEST_SHIFT
    near = points[((points >= low) & (points <= high)).all(axis=1)]
    level = np.abs(normals[:, 2]) > 1 - FLAT if element.kind == "slab" else np.abs(normals[:, 2]) < FLAT
    left, out = level & (area > 1e-6), []
    for _ in range(2 if element.kind == "column" else 1):
        if not left.any():
            break
        # The direction of most area: each triangle votes for its own.
        alike = np.abs(normals[left] @ normals[left].T) > SAME_NORMAL
        best = normals[left][int((alike * area[left]).sum(axis=1).argmax())]
        normal = best * (1 if best[np.abs(best).argmax()] > 0 else -1)
        own = left & (np.abs(normals @ normal) > SAME_NORMAL)
        plane = _measure_shift(corners[own], normals[own] @ normal, area[own], normal, near, _list_faced(near, normal, layers))
        width = float(np.ptp(corners[own].reshape(-1, 3) @ _build_frame(normal)[:2].T, axis=0).min())
        out.append(replace(plane, mixed=MIXED * edge * min(2 * edge / max(width, edge), 1.0) ** 2))
        left = left & ~own
    return out


def _build_frame(normal: Array) -> Array:
    """Return (3, 3) rows: two axes in a plane, and its normal."""
    axis = np.array([0.0, 0.0, 1.0]) if abs(normal[2]) < 0.5 else np.array([1.0, 0.0, 0.0])
    first = np.cross(axis, normal) / np.linalg.norm(np.cross(axis, normal))
    return np.stack([first, np.cross(normal, first), normal])


def _list_faced(points: Array, normal: Array, layers: Sequence[StoreyLayers]) -> tuple[Array, Array]:
    """Return which points (n, 3) may be of a face that looks against a normal, and of one that looks along it: two (n,) bool."""
    floors = np.array([storey.floor for storey in layers])
    if abs(normal[2]) > 0.5:
        upwards = (np.abs(points[:, 2:] - floors) < FLOOR_REACH).any(axis=1)
        return (~upwards, upwards) if normal[2] > 0 else (upwards, ~upwards)
    far = np.full((2, len(points)), np.inf)
    of = np.searchsorted(floors - FLOOR_REACH, points[:, 2], side="right") - 1
    for k, storey in enumerate(layers):
        ground = storey.new.free | (storey.new.standing & ~storey.new.wall)  # before furniture a wall is looked at, too
        ground = ndimage.binary_opening(ground, np.ones((GAP, GAP), bool))
        rows = np.flatnonzero(of == k)
        for which, sign in enumerate((-1.0, 1.0)):
            at = points[rows, None, :2] + sign * OPEN_STEPS[:, None] * normal[:2]
            open_ground = storey.sample(ground, at.reshape(-1, 2)).reshape(-1, len(OPEN_STEPS)).astype(bool)
            far[which, rows] = np.where(open_ground.any(axis=1), OPEN_STEPS[open_ground.argmax(axis=1)], np.inf)
    return ~(far[0] > far[1] + OPEN_APART), ~(far[1] > far[0] + OPEN_APART)


def _measure_shift(
    corners: Array, sides: Array, area: Array, normal: Array, points: Array, faced: tuple[Array, Array]
) -> PlaneShift:
    """Return the shift along a normal at which most cells of faces (t, 3, 3) are found; `sides` says which way each face looks,
    and `faced` which points are of faces that look either way."""
    frame = _build_frame(normal)
    samples = _sample_triangles(corners, area) @ frame.T
    owner = np.repeat(np.sign(sides), _count_samples(area))
    local = points @ frame.T
    centre = corners.reshape(-1, 3).mean(axis=0)
    cell = _number_cells(samples[:, :2], samples[:, :2])
    at = _number_cells(local[:, :2], samples[:, :2])
    bins = round(2 * FARTHEST_SHIFT / SHIFT_BIN) + 1
    support, offsets, total = np.zeros(bins), [], 0
    for side in (-1.0, 1.0):
        rows = owner == side
        if not rows.any():
            continue
        keys, inverse = np.unique(cell[rows], return_inverse=True)
        depth = np.bincount(inverse, samples[rows, 2]) / np.bincount(inverse)
        total += len(keys)
        place = np.searchsorted(keys, at).clip(0, len(keys) - 1)
        hit = (keys[place] == at) & faced[int(side > 0)]
        off = local[hit, 2] - depth[place[hit]]
        inside = np.abs(off) <= FARTHEST_SHIFT
        offsets.append((off[inside], place[hit][inside] + 10**7 * int(side > 0)))
        shown = np.zeros((len(keys), bins), bool)
        shown[place[hit][inside], np.round((off[inside] + FARTHEST_SHIFT) / SHIFT_BIN).astype(int)] = True
        support += _spread(shown).sum(axis=0)
    if not total or support.max() == 0:
        return PlaneShift(normal, centre, np.nan, np.nan, 0.0, total, float(area.sum()))
    none = support[bins // 2 - 2 : bins // 2 + 3].max()
    best = int(support.argmax())
    if support[best] < (1 + STAYS) * none:
        best = bins // 2 - 2 + int(support[bins // 2 - 2 : bins // 2 + 3].argmax())
    about = best * SHIFT_BIN - FARTHEST_SHIFT
    off, of = (np.concatenate(c) for c in zip(*offsets, strict=True))
    for _ in range(3):
        near = np.abs(off - about) <= 1.5 * SUPPORT_REACH
        if not near.any():
            break
        about = float(np.median(off[near]))
    spread = 1.4826 * float(np.median(np.abs(off[near] - about))) if near.any() else np.nan
    cells = len(np.unique(of[near]))
    return PlaneShift(normal, centre, about, spread, cells / total, total, float(area.sum()))


def _spread(shown: Array) -> Array:
    """Return (n, bins) bool: is anything within `SUPPORT_REACH` of a bin?"""
    out = shown.copy()
    for step in range(1, round(SUPPORT_REACH / SHIFT_BIN) + 1):
        out[:, step:] |= shown[:, :-step]
        out[:, :-step] |= shown[:, step:]
    return out


def _count_samples(area: Array) -> Array:
    return np.maximum(np.ceil(area / (FACE_BIN / 2) ** 2), 1).astype(int).clip(max=4000)


def _sample_triangles(corners: Array, area: Array) -> Array:
    """Return (n, 3) m: points spread evenly over triangles, the same ones each time (R2 sequence, Roberts 2018)."""
    count = _count_samples(area)
    of = np.repeat(np.arange(len(area)), count)
    k = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    u, v = (0.5 + k * 0.7548776662466927) % 1, (0.5 + k * 0.5698402909980532) % 1
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    a, b, c = corners[of, 0], corners[of, 1], corners[of, 2]
    out: Array = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return out


def _number_cells(places: Array, of: Array) -> Array:
    """Return (n,) int64 number of the cell of a face that each place (n, 2) lies in."""
    low = of.min(axis=0) if len(of) else np.zeros(2)
    cells = np.floor((places - low) / FACE_BIN).astype(np.int64)
    out: Array = cells[:, 0] * 10**6 + cells[:, 1]
    return out


Correction = Mapping[str, Any]


def estimate_common_shift(shifts: Sequence[PlaneShift]) -> Correction:
    """Estimate the turn and the shift that most elements share, and how much they scatter about it.

    Returns:
        ``move`` (4,): x, y, z in m and turn in rad about ``middle`` (3,); ``scatter``: m, of horizontal and upright normals.
    """
    used = [s for s in shifts if np.isfinite(s.shift) and s.share >= LEAST_SEEN and s.cells >= LEAST_CELLS]
    if len(used) < 3:
        return {"move": np.zeros(4), "middle": np.zeros(3), "scatter": LEAST_SIGMA}
    normals, centres = np.array([s.normal for s in used]), np.array([s.centre for s in used])
    middle, off = centres.mean(axis=0), np.array([s.shift for s in used])
    arm = centres - middle
    rows = np.column_stack([normals, normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1]])
    weight = np.array([min(s.area, 10.0) * s.share for s in used])
    loss, move = weight.copy(), np.zeros(4)
    for _ in range(20):
        scaled = rows * loss[:, None]
        move = np.linalg.solve(scaled.T @ rows + 1e-6 * np.eye(4), scaled.T @ off)
        loss = weight / (1 + ((off - rows @ move) / 0.01) ** 2)
    scatter = max(1.4826 * float(np.median(np.abs(off - rows @ move))), LEAST_SIGMA)
    return {"move": move, "middle": middle, "scatter": scatter}


def _correct_shift(plane: PlaneShift, correct: Correction) -> float:
    arm = plane.centre - correct["middle"]
    row = np.append(plane.normal, plane.normal[1] * arm[0] - plane.normal[0] * arm[1])
    return plane.shift - float(row @ correct["move"])


def _decide_elsewhere(shift: float, sigma: float) -> tuple[str, float]:
    """Return whether it is seen or elsewhere, and how probable that is: few elements stand elsewhere, so that a shift has to be
    clear."""
    beyond = float(ndtr((abs(shift) - TOLERANCE) / sigma))
    elsewhere = beyond * DEVIATING / (beyond * DEVIATING + 1 - beyond)
    return ("elsewhere", elsewhere) if elsewhere > 0.5 else ("seen", 1 - elsewhere)


def _judge_element(
    element: ModelElement, planes: Sequence[PlaneShift], layers: Sequence[StoreyLayers], correct: Correction
) -> ElementRow:
    """Judge by the scan whether a wall, a column or a slab is where the model has it."""
    seen = [p for p in planes if np.isfinite(p.shift) and p.share >= LEAST_SEEN and p.cells >= LEAST_CELLS]
    normal = planes[0].normal if planes else np.array([1.0, 0.0, 0.0])
    if seen:
        shifts = [_correct_shift(p, correct) for p in seen]
        k = int(np.abs(shifts).argmax())
        error = seen[k].spread / np.sqrt(max(seen[k].share * seen[k].cells / 10, 1.0))
        sigma = float(np.linalg.norm([correct["scatter"], error, seen[k].mixed]))
        state, probability = _decide_elsewhere(shifts[k], sigma)
        return ElementRow(element, state, shifts[k], sigma, seen[k].normal, seen[k].share, probability)
    share = max((p.share for p in planes), default=0.0)
    empty = _measure_empty_share(element, layers) if element.kind != "slab" else 0.0
    if empty > GONE:
        return ElementRow(element, "missing", np.nan, np.nan, normal, share, empty * (1 - share))
    return ElementRow(element, "unseen", np.nan, np.nan, normal, share, 1 - empty)


def _outline_element(element: ModelElement) -> shapely.Geometry:
    return shapely.MultiPoint(element.vertices[:, :2]).minimum_rotated_rectangle


def _measure_empty_share(element: ModelElement, layers: Sequence[StoreyLayers]) -> float:
    """Measure the share of an element's ground that the scan saw empty, and nothing beside it."""
    best = 0.0
    low, high = element.vertices[:, 2].min(), element.vertices[:, 2].max()
    for storey in layers:
        if not low < storey.floor + 1.0 < high:
            continue
        x0, y0, x1, y1 = _outline_element(element).bounds
        grid = np.stack(np.meshgrid(np.arange(x0, x1 + 0.05, 0.05), np.arange(y0, y1 + 0.05, 0.05)), axis=-1).reshape(-1, 2)
        inside = grid[shapely.contains_xy(_outline_element(element).buffer(0.03), *grid.T)]
        empty = storey.new.free & (storey.new.to_standing > storey.slack)
        best = max(best, float(storey.sample(empty, inside).mean()) if len(inside) else 0.0)
    return best


class _ModelDoors:
    """The doors of a model, and those of the scan, each of which is one of them at most.

    Args:
        elements: the doors.
        layers, reader: of the model's map and the scan's.
    """

    def __init__(self, elements: Sequence[ModelElement], layers: Sequence[StoreyLayers], reader: DoorReader) -> None:
        self.layers, self.reader = layers, reader
        self.doors = {e.guid: _build_door(e) for e in elements}
        found = [k for storey in layers for k in reader.select(1, storey).tolist()]
        self.found = reader.edges[1][sorted(set(found))]
        self.partner = self._pair()

    def _pair(self) -> dict[str, tuple[int, float]]:
        """Return the row in `found`, and shift along the wall, of the door of the scan that each is, the nearest first."""
        options = []
        for guid, door in self.doors.items():
            apart = self.found["centre"] - door["centre"]
            across = np.array([np.cos(door["direction"]), np.sin(door["direction"])])
            along, off = apart[:, :2] @ [-across[1], across[0]], np.abs(apart[:, :2] @ across)
            near = (np.abs(along) < DOOR_REACH) & (off < DOOR_ACROSS) & (np.abs(apart[:, 2]) < FLOOR_REACH * 2)
            options += [(abs(float(along[k])), guid, k, float(along[k])) for k in np.flatnonzero(near).tolist()]
        partner: dict[str, tuple[int, float]] = {}
        taken: set[int] = set()
        for _, guid, k, along in sorted(options):
            if guid not in partner and k not in taken:
                partner[guid] = k, along
                taken.add(k)
        return partner

    def judge(self, element: ModelElement) -> ElementRow:
        """Judge by the scan whether a door (a way through, or a leaf) is in place, farther along its wall, or missing."""
        door = self.doors[element.guid]
        normal = np.array([np.cos(door["direction"]), np.sin(door["direction"]), 0.0])
        k, shift = self.partner.get(element.guid, (-1, np.nan))
        near = [s for s in self.layers if abs(s.floor - float(door["centre"][2])) <= 2 * FLOOR_REACH]
        own = self.found[k] if k >= 0 and abs(shift) < SAME_DOOR else None
        states = [read_state(storey, storey.new, door, own, self.reader.points[1]) for storey in near]
        observed = next((state for state in states if state["seen"] >= 0.5), None)
        if k >= 0 and (observed is not None or abs(shift) > SAME_DOOR):
            state, probability = _decide_elsewhere(shift, DOOR_SIGMA)
            if state == "elsewhere" or observed is None:
                along = np.array([-normal[1], normal[0], 0.0])
                return ElementRow(element, state, shift, DOOR_SIGMA, along, 1.0, probability * float(self.found["confidence"][k]))
        if observed is None:
            return ElementRow(element, "unseen", np.nan, np.nan, normal, 0.0, 1.0)
        evidence = observed["open"] + observed["leaf"]
        state = "seen" if evidence >= 0.5 else "missing"
        return ElementRow(
            element, state, np.nan, np.nan, normal, observed["seen"], observed["seen"] * max(evidence, 1 - evidence)
        )


def _build_door(element: ModelElement) -> Array:
    """Return a door of a model as a row of EDGE_DTYPE."""
    corners = np.asarray(_outline_element(element).exterior.coords)[:4] if element.faces.size else np.zeros((4, 2))
    sides = np.diff(corners[:3], axis=0)
    lengths = np.linalg.norm(sides, axis=1)
    along = sides[lengths.argmax()] / max(float(lengths.max()), 1e-9)
    door: Array = np.zeros(1, EDGE_DTYPE)[0]
    door["centre"], door["width"] = (*corners.mean(axis=0), float(element.vertices[:, 2].min())), lengths.max()
    door["direction"], door["kind"] = np.arctan2(-along[0], along[1]) % np.pi, "door"
    return door


def _build_change(row: ElementRow, layers: Sequence[StoreyLayers]) -> Change:
    """Return the row of an element that is elsewhere or missing as a change."""
    outline = _outline_element(row.element)
    ring = outline.exterior.coords if outline.geom_type == "Polygon" else outline.buffer(0.02).exterior.coords
    shape = np.asarray(ring)[:-1]
    low = float(row.element.vertices[:, 2].min())
    storey = min(layers, key=lambda s: abs(s.floor - low))
    place = np.append(shape.mean(axis=0), low)
    evidence = {"share": row.share}
    if np.isfinite(row.shift):
        evidence |= {"shift": row.shift, "sigma": row.sigma, "normal_x": row.normal[0], "normal_y": row.normal[1]}
        evidence |= {"normal_z": row.normal[2]}
    rounded = {name: round(float(value), 4) for name, value in evidence.items()}
    extent = float(np.linalg.norm(np.diff(shape, axis=0), axis=1).max())
    kind = f"element {row.state}"
    name = f"{row.element.kind} {row.element.name}".strip()
    change = Change(kind, storey.storeys[0], place, shape, round(extent, 3), round(row.probability, 4), rounded)
    return replace(change, guid=row.element.guid, name=name)
