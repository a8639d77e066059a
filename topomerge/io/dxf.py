"""DXF plans: lines of walls, doors and windows by the names of their layers and blocks, read by ezdxf.

Two lines of a wall become a wall with what is between them, a door a gap in it, a window a piece of it. `dxf_plan.py` fills the
floor. Coordinates, nested blocks and time are bounded: the library reads in a process of its own.
Source: Autodesk, DXF reference ($INSUNITS, group codes of INSERT).
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.drawing import ParsedDrawing, TracedDrawing
from topomerge.io.dxf_plan import MARGIN, Line, Swing, build_plan_masks
from topomerge.io.frame import UNITS
from topomerge.io.grid import build_drawn_pieces
from topomerge.io.piece import Piece, ReadOptions, read_in_subprocess
from topomerge.io.written_lengths import PictureText
from topomerge.types import Array

LARGEST_FILE = 1 << 28  # bytes
SECONDS, MEMORY = 300, 6 << 30  # of the processor, and bytes: a plan of 100,000 lines takes 30 s and 1 GB
MOST_ENTITIES, MOST_LEVELS = 1_000_000, 32  # of all blocks where they are inserted; of blocks in blocks
BEYOND = 1e12  # units of a coordinate: no drawing of a building
SMOOTH = 0.002  # of the size of a curve: how far its pieces may be from it
PIXEL = 0.03  # m
LINE_HEIGHT = 1.6  # of the height of the letters of a text of several lines
MOST_PIXELS = 25_000_000  # of coarser ones, if need be
FAR = 250.0  # m from the middle of all lines: what lies farther off is no part of the building
KINDS_OF_LINES = ("LINE", "LWPOLYLINE", "POLYLINE", "ARC", "CIRCLE", "ELLIPSE", "SPLINE", "SOLID", "TRACE", "HATCH")
FILLED = ("SOLID", "TRACE", "HATCH")
UNITS_OF_DXF = {1: "in", 2: "ft", 4: "mm", 5: "cm", 6: "m", 21: "ft"}
USUAL_SWING, USUAL_EXTENT = 0.85, 20.0  # m, of a door and of a building, by which a unit is guessed

# Parts of names of layers and blocks, without accents; "^" begins and "$" ends a word of letters.
WORDS = {
    "other": "furn dim$ ^dims ^dimen bemass vermass ^cota ^quote ^cote mass$ text anno beschrift schrift ^txt note patt schraff "
    "hatch tratteg sanit plumb ^elec ^elek light hvac defpoints ^grid axis achse ^axe ^axes frame rahmen title border "
    "vport viewport mobel moebel mobili meuble mueble arredo inred moblering stair trepp escal scala ^trap ceil roof "
    "dach ^site land tree baum ^car$ kitch kuche kueche ^equip applian symbol north nord$ sofa chair stuhl ^table tisch "
    "^bed$ ^bett ^wc$ toilet sink ^area$ ^rooms$ raumnummer stempel ^flor ^floor ^boden ^tile",
    "window": "window ^win$ ^wind$ fenst fenet ventan finest fonster vindu vindue ikkun glaz okno ^raam janela",
    "door": "door ^tur$ ^turen$ tuer innentur haustur aussentur ^porte$ ^portes$ puerta ^porta$ ^dorr dorr$ ^dor$ ^dore deur "
    "^ovi$ drzwi",
    "wall": "wall wand ^waende wande$ mauer ^mur$ ^murs$ ^mure ^muro ^muri ^mury cloison paret pared tabiqu vaeg vagg vegg seina "
    "sein$ sciana stena ^zid ^muur ^col$ ^cols column ^stutz ^stuetz pilar pilast shear core$",
}


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read the floor and the walls of the plan in the model space."""
    if find_spec("ezdxf") is None:
        raise ImportError("no ezdxf", name="ezdxf")
    if path.stat().st_size > LARGEST_FILE:
        raise InputError(
            f"{path}: has more than {LARGEST_FILE >> 20} MB, too many for a plan; export the layers of walls and doors"
        )
    yield from read_in_subprocess("dxf", "a DXF drawing", path, options, SECONDS, MEMORY)


def read_in_process(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Yield the same in this process, within no limits of time and memory.

    Raises:
        InputError: it shows no room, or is a bomb.
    """
    content = collect_content(path)
    if not content.lines:
        raise InputError(f"{path}: its model space holds no lines that could be walls; export the plan itself, not its sheet")
    unit, notes = choose_unit(content, options)
    factor = UNITS[unit] * options.scale  # m
    content, far = content.scale_to(factor)
    pixel, coarse = choose_pixel(path, content)
    masks = build_plan_masks(content.lines, content.swings, pixel)
    if not masks.free.any():
        names = ", ".join(sorted(content.layers)[:8])
        raise InputError(f"{path}: no walls around a room were found in it (layers {names}); check --unit and the layers")
    texts = tuple(place_text(text, masks.corner, pixel, masks.free.shape[0]) for text in content.texts)
    nothing = np.zeros(masks.free.shape, bool)
    drawing = ParsedDrawing(masks.occupied, masks.free, masks.door, nothing, nothing.astype(np.float32), 1.0)
    warnings = tuple(f"{path.name}: {text}" for text in (*notes, *far, *coarse, *masks.warnings))
    traced = TracedDrawing(drawing, pixel, texts, warnings)
    where = masks.corner
    yield from build_drawn_pieces(path, traced, options, options.page, corner=where, unit=options.factor, untitled=False)


def place_text(text: PictureText, corner: tuple[float, float], pixel: float, rows: int) -> PictureText:
    """Return a text whose place is in pixels (column, row) of a raster instead of metres."""
    x, y = text.place
    place = (x - corner[0]) / pixel, rows - (y - corner[1]) / pixel
    return PictureText(text.text, place, text.height / pixel, text.confidence)


@dataclass
class Content:
    """The content of a drawing, in its units: lines, swings of doors, texts at their middle, layers, and the unit it states."""

    lines: list[Line] = field(default_factory=list)
    swings: list[Swing] = field(default_factory=list)
    texts: list[PictureText] = field(default_factory=list)
    layers: set[str] = field(default_factory=set)
    unit: str | None = None

    def measure_box(self) -> Array:
        """Return (2, 2) lowest and highest x and y of all lines."""
        points = np.concatenate([line.points for line in self.lines])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def scale_to(self, factor: float) -> tuple[Content, list[str]]:
        """Return all in metres without what lies far off, and what to say about that."""
        lines = [Line(line.points * factor, line.kind, line.width * factor, line.filled, line.block) for line in self.lines]
        centres = np.array([line.points.mean(axis=0) for line in lines])
        middle = np.median(centres, axis=0)
        near = [bool((np.abs(line.points - middle) <= FAR).all()) for line in lines]
        warnings = [f"{near.count(False)} lines farther than {FAR:g} m from the middle are left out"] if not all(near) else []
        texts = [PictureText(t.text, (t.place[0] * factor, t.place[1] * factor), t.height * factor, 1.0) for t in self.texts]
        swings = [Swing(s.hinge * factor, s.ends * factor, s.named) for s in self.swings]
        return Content([line for line, keep in zip(lines, near, strict=True) if keep], swings, texts, self.layers), warnings


def choose_unit(content: Content, options: ReadOptions) -> tuple[str, list[str]]:
    """Choose the unit of a drawing: what the user says, else what the file says, else by the size of its doors or its extent."""
    if options.unit is not None:
        return options.unit, []
    if content.unit is not None:
        return content.unit, []
    swings = [float(np.linalg.norm(s.ends[0] - s.hinge)) for s in content.swings if s.named]
    if swings:
        length, usual, reason = float(np.median(swings)), USUAL_SWING, "the size of its doors"
    else:
        length, usual, reason = float(np.ptp(content.measure_box(), axis=0).max()), USUAL_EXTENT, "its extent"
    unit = min(UNITS, key=lambda name: abs(math.log(max(length * UNITS[name], 1e-300) / usual)))
    return unit, [f"does not state its unit; {unit} was taken by {reason}, --unit sets it"]


def choose_pixel(path: Path, content: Content) -> tuple[float, list[str]]:
    """Choose the size of a pixel, m: coarser than usual where the plan is large."""
    if not content.lines:
        raise InputError(f"{path}: its lines are scattered over more than {2 * FAR:g} m; check --unit, or delete what is far off")
    width, height = np.ptp(content.measure_box(), axis=0) + 2 * MARGIN
    pixel = max(PIXEL, math.sqrt(float(width * height) / MOST_PIXELS))
    if pixel <= PIXEL:
        return PIXEL, []
    return pixel, [f"{width:.0f} x {height:.0f} m are read in pixels of {pixel:.2f} m"]


@cache
def classify_name(name: str) -> str:
    """Return what the name of a layer or a block says: "other" (furniture, text ...), "window", "door", "wall" or ""."""
    plain = unicodedata.normalize("NFKD", name.casefold().replace("ß", "ss").replace("ø", "o").replace("æ", "ae"))
    tokens = re.findall(r"[a-z]+", "".join(c for c in plain if not unicodedata.combining(c)))
    for kind, parts in WORDS.items():
        for part in parts.split():
            begins, ends, core = part.startswith("^"), part.endswith("$"), part.strip("^$")
            for word in tokens:
                if core in word and (not begins or word.startswith(core)) and (not ends or word.endswith(core)):
                    return kind
    return ""


def collect_content(path: Path) -> Content:
    """Collect lines and texts of the model space, with what is in its blocks, where they are inserted.

    Raises:
        InputError: too many entities, or blocks nested too deeply.
    """
    import ezdxf

    document = ezdxf.readfile(path)
    collector = _Collector(path, document)
    for entity in document.modelspace():
        collector.add(entity, None, "", "", 0)
    content = collector.content
    if any(line.kind == "wall" for line in content.lines):
        content.lines = [line for line in content.lines if line.kind]
    else:
        content.lines = [line for line in content.lines if not (line.filled and line.kind == "")]
        content.lines = drop_frames(content.lines)
        content.lines = [Line(line.points, line.kind or "wall", line.width, line.filled, line.block) for line in content.lines]
    content.unit = UNITS_OF_DXF.get(int(document.header.get("$INSUNITS", 0)))
    return content


def drop_frames(lines: list[Line]) -> list[Line]:
    """Drop rectangles that hold all the rest without touching it: the frame of a sheet."""
    while len(lines) > 1:
        boxes = np.array([[*line.points.min(axis=0), *line.points.max(axis=0)] for line in lines])
        largest = int(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1).argmax())
        rest = np.delete(boxes, largest, axis=0)
        margin = 0.005 * (boxes[largest, 2:] - boxes[largest, :2])
        holds = (rest[:, :2] > boxes[largest, :2] + margin).all() and (rest[:, 2:] < boxes[largest, 2:] - margin).all()
        if not (holds and len(np.unique(lines[largest].points, axis=0)) == 4):
            break
        lines = lines[:largest] + lines[largest + 1 :]
    return lines


class _Collector:
    """Walks through the entities of a drawing, block in block."""

    def __init__(self, path: Path, document: Any) -> None:
        self.path, self.document, self.content = path, document, Content()
        self.count = self.inserted = self.depth = 0
        self.hidden: dict[str, bool] = {}

    def add(self, entity: Any, matrix: Any, kind: str, layer: str, block: int) -> None:
        """Add what an entity draws.

        Args:
            entity: of the model space or of a block.
            matrix: from its frame to the model's; None: it is the model's.
            kind: what the block that it is part of is; "": that is not known.
            layer: of that block, which what lies on layer 0 takes.
            block: its number among those inserted; 0: none.
        """
        self.count += 1
        if self.count > MOST_ENTITIES:
            raise InputError(f"{self.path}: has more than {MOST_ENTITIES:,} entities with those of its blocks; purge it")
        own = entity.dxf.get("layer", "0")
        own = layer if own == "0" and layer else own
        if entity.dxf.get("invisible", 0) or self._is_hidden(own):
            return
        type = entity.dxftype()
        if type in ("TEXT", "MTEXT", "ATTRIB"):
            self._add_text(entity, matrix)
        elif type == "INSERT":
            self._add_block(entity, matrix, kind, own)
        elif type == "MLINE" or (type in ("LWPOLYLINE", "POLYLINE") and (kind or classify_name(own)) == "door"):
            for part in entity.virtual_entities():
                self._add_line(part, matrix, kind or classify_name(own), own, block)
        elif type in KINDS_OF_LINES:
            self._add_line(entity, matrix, kind or classify_name(own), own, block)

    def _is_hidden(self, layer: str) -> bool:
        if layer not in self.hidden:
            known = self.document.layers.get(layer) if layer in self.document.layers else None
            self.hidden[layer] = known is not None and (known.is_off() or known.is_frozen())
        return self.hidden[layer]

    def _add_block(self, insert: Any, matrix: Any, kind: str, layer: str) -> None:
        for attribute in insert.attribs:
            self.add(attribute, matrix, kind, layer, 0)
        block = self.document.blocks.get(insert.dxf.get("name", ""))
        if block is None:
            return
        self.inserted += 1
        number, named = self.inserted, classify_name(insert.dxf.name)
        kind = kind or (named if named in ("door", "window", "other") else "") or _keep_opening(classify_name(layer))
        self.depth += 1
        if self.depth > MOST_LEVELS:
            raise InputError(f"{self.path}: blocks lie more than {MOST_LEVELS} deep in blocks, or in themselves; purge it")
        for one in insert.multi_insert() if insert.mcount > 1 else (insert,):
            self.count += 1
            own = one.matrix44()
            for entity in block:
                self.add(entity, own if matrix is None else own * matrix, kind, layer, number)
        self.depth -= 1

    def _add_line(self, entity: Any, matrix: Any, kind: str, layer: str, block: int) -> None:
        if kind == "other":
            return
        self.content.layers.add(layer)
        type = entity.dxftype()
        width = float(entity.dxf.get("const_width", 0.0)) if type == "LWPOLYLINE" else 0.0
        filled = type in FILLED and not (type == "HATCH" and not entity.dxf.get("solid_fill", 0) and kind != "wall")
        if type == "HATCH" and not filled:
            return
        points = [p for p in _flatten(entity, matrix) if len(p) >= 2]
        if type == "ARC" and points and is_swing(points[0]):
            self.content.swings.append(Swing.find(points[0], kind == "door"))
            if kind in ("door", ""):
                return
        size = abs(matrix.determinant()) ** (1 / 3) if matrix is not None else 1.0
        width = width * size if math.isfinite(width * size) else 0.0
        self.content.lines += [Line(p, kind, width, self.count if filled else 0, block) for p in points]

    def _add_text(self, entity: Any, matrix: Any) -> None:
        from ezdxf.math import Vec3

        if len(self.content.texts) >= MOST_ENTITIES // 10:
            return
        is_block = entity.dxftype() == "MTEXT"
        text = entity.plain_text() if is_block else entity.dxf.get("text", "")
        height = float(entity.dxf.get("char_height" if is_block else "height", 1.0))
        place = Vec3(entity.dxf.get("insert", (0, 0, 0)))
        lines = text.split("\n")
        half = 0.35 * height * max(map(len, lines))
        if is_block:  # its place is one of nine of its box
            row, column = divmod(int(entity.dxf.get("attachment_point", 1)) - 1, 3)
            along, shift = (
                math.radians(entity.get_rotation()),
                ((1 - column) * half, (row - 1) * LINE_HEIGHT / 2 * height * len(lines)),
            )
        else:
            aligned = entity.dxf.get("halign", 0) or entity.dxf.get("valign", 0)
            place = Vec3(entity.dxf.get("align_point", place)) if aligned else place
            along, shift = math.radians(entity.dxf.get("rotation", 0.0)), (0.0 if aligned else half, 0.0)
        place += Vec3(*shift).rotate(along)
        place = place if matrix is None else matrix.transform(place)
        if text.strip() and all(abs(v) < BEYOND for v in (place.x, place.y, height)):
            self.content.texts.append(PictureText(" ".join(text.split()), (place.x, place.y), height, 1.0))


def _keep_opening(kind: str) -> str:
    return kind if kind in ("door", "window") else ""


def is_swing(arc: Array) -> bool:
    """Return whether an arc (n, 2) is about a quarter of a circle, as that of a door."""
    chord = float(np.linalg.norm(arc[-1] - arc[0]))
    length = float(np.linalg.norm(np.diff(arc, axis=0), axis=1).sum())
    return chord > 0 and 1.03 <= length / chord <= 1.25  # 50 to 120 degrees


def _flatten(entity: Any, matrix: Any) -> Iterator[Array]:
    """Yield the (n, 2) points of each line of an entity, in the model's frame; none of those that are not finite."""
    from ezdxf.path import from_hatch, make_path

    try:
        paths = list(from_hatch(entity)) if entity.dxftype() == "HATCH" else [make_path(entity)]
    except (TypeError, ValueError, ArithmeticError, AttributeError, LookupError):  # a polyface, an arc of no size ...
        return
    for one in paths:
        moved = one if matrix is None else one.transform(matrix)
        corners = np.array([(v.x, v.y, v.z) for v in moved.control_vertices()])
        if len(corners) < 2 or not (np.abs(corners) < BEYOND).all():  # so of nan, too
            continue
        step = SMOOTH * float(np.ptp(corners, axis=0).max())
        if step > 0:
            yield np.array([(v.x, v.y) for v in moved.flattening(step)]) if moved.has_curves else corners[:, :2]
