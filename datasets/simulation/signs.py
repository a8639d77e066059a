"""Signs of a building, and what a reader makes of them: numbers beside doors, exit signs, names of rooms, tags.

Numbers follow schemes that people use: the storey, then a running number along the corridor, odd ones on one side and even ones
on the other, a letter for the wing. Readers miss signs, take one character for another, cut strings off and put signs in wrong
places. Their confusions (`TAKEN_FOR`) are those of printed characters in general and not the classes that
`topomerge.landmarks.text` knows of: half of what they confuse is not among these.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from topomerge.datasets.core.building import Building

from topomerge.types import Array, Landmarks, Sim3, build_landmarks, join_landmarks

STYLES = (
    "{storey}.{number:03d}",
    "{storey}{number:02d}",
    "{wing}-{storey}{number:02d}",
    "{wing} {storey}.{number:02d}",
    "{number}",
)
STYLE_SHARES = (0.3, 0.35, 0.15, 0.15, 0.05)
UNNUMBERED = ("corridor", "hall", "stairs", "stairwell", "lift", "void", "toilet", "bath", "wc")
TOILETS = ("toilet", "bath", "wc")
BESIDE_DOOR, SIGN_HEIGHT, EXIT_HEIGHT, TAG_HEIGHT = 0.25, 1.5, 2.2, 1.4  # m
EXITS = ("EXIT", "Notausgang", "Sortie", "Salida")
EXIT_SHARE = 0.15  # of the doors of corridors that bear an exit sign
TAG_SHARE = 0.3  # of the rooms with a tag
FROM_SHEET = 0.3  # of the buildings: their tags are the first ones of the sheet that everybody prints
TAKEN_FOR = {
    "0": "O68D", "1": "Il7", "2": "Z7", "3": "85", "4": "A9", "5": "S63", "6": "b58", "7": "1T", "8": "B36", "9": "g4",
    "A": "4R", "B": "8R", "C": "GO", "D": "0O", "E": "FB", "I": "1l", "O": "0Q", "S": "5", "T": "7I", "X": "K",
    ".": ",-", "-": ".",
}  # fmt: skip
DROPPED, CUT = 0.15, 0.1  # of the wrong characters: left out; and of the signs that a bad reader gives: an end cut off
SIGN_DTYPE = np.dtype(
    [
        ("kind", "U8"),  # text | tag | name
        ("text", "U32"),
        ("at", "f8", 3),  # m, in the building's coordinates
        ("heading", "f8"),  # rad, the way it faces; nan: none
        ("room", "i4"),  # that it is in
        ("of", "i4"),  # that it is of
    ]
)


@dataclass(frozen=True)
class Numbering:
    """How the rooms of a storey are numbered.

    Args:
        style: one of `STYLES`.
        storey: number of the lowest storey.
        wing: a letter.
        first: number of the first room.
        sides: odd numbers on one side of the building, even ones on the other?
        tag: of the first tag.
    """

    style: str
    storey: int = 1
    wing: str = "A"
    first: int = 1
    sides: bool = False
    tag: int = 0


def draw_numbering(rng: np.random.Generator) -> Numbering:
    """Draw how a building is numbered."""
    style = str(rng.choice(STYLES, p=STYLE_SHARES))
    tag = 0 if rng.random() < FROM_SHEET else int(rng.integers(20, 500))
    first = int(rng.choice([1, 1, 10, 20, 50, 101]))
    return Numbering(style, int(rng.integers(0, 5)), str(rng.choice(list("ABCDEFH"))), first, bool(rng.random() < 0.5), tag)


def draw_other_numbering(numbering: Numbering, relation: str, rng: np.random.Generator) -> Numbering:
    """Draw the numbering of another place of the same building, or of another building.

    Args:
        relation: "storey", "wing" (another letter, or the numbers go on), "row" (the numbers go on) or "building".
    """
    if relation == "building":
        return draw_numbering(rng)
    if relation == "storey" and "storey" in numbering.style:
        return replace(numbering, storey=numbering.storey + int(rng.integers(1, 4)), tag=numbering.tag + 40)
    if relation == "wing" and "wing" in numbering.style and rng.random() < 0.7:
        return replace(numbering, wing=chr(ord(numbering.wing) + 1), tag=numbering.tag + 40)
    return replace(numbering, first=numbering.first + int(rng.integers(2, 40)), tag=numbering.tag + 40)


def place_signs(building: Building, numbering: Numbering, rng: np.random.Generator) -> Array:
    """Place signs in a building: (n,) SIGN_DTYPE. The same building, numbering and generator give the same signs."""
    numbers = number_rooms(building, numbering)
    rows: list[tuple[object, ...]] = []
    for door in building.doors:
        sides = [int(r) for r in door["rooms"]]
        for own, other in (sides, sides[::-1]):
            if own in numbers and other >= 0 and (other not in numbers or other < own):
                rows.append(_place_beside_door(building, door, own, other, numbers[own], SIGN_HEIGHT))
        corridor = next((r for r in sides if r >= 0 and building.rooms[r].kind == "corridor"), None)
        if corridor is not None and rng.random() < EXIT_SHARE:
            other = sides[0] if sides[1] == corridor else sides[1]
            text = EXITS[building.seed % len(EXITS)]
            rows.append(_place_beside_door(building, door, other, corridor, text, EXIT_HEIGHT))
    tag = numbering.tag
    for k, room in enumerate(building.rooms):
        middle = np.array([*room.polygon.mean(axis=0), room.floor])
        if room.kind:
            rows.append(("name", room.kind, tuple(middle), np.nan, k, k))
        if rng.random() < TAG_SHARE and room.kind not in ("lift", "void"):
            p, q = room.polygon[0], room.polygon[1]
            share = float(rng.uniform(0.2, 0.8))
            x, y = (p + share * (q - p)).tolist()
            facing = float(np.arctan2(*(q - p)[::-1]) + np.pi / 2)  # outlines run with the room to their left
            rows.append(("tag", f"tag36h11:{tag}", (x, y, room.floor + TAG_HEIGHT), facing, k, k))
            tag += 1
    return np.array(rows, SIGN_DTYPE)


def number_rooms(building: Building, numbering: Numbering) -> dict[int, str]:
    """Return number the rooms of a building: along its longer side, storey by storey; toilets bear no number."""
    middles = np.array([room.polygon.mean(axis=0) for room in building.rooms]).reshape(-1, 2)
    axis = int(np.argmax(np.ptp(middles, axis=0))) if len(middles) else 0
    texts: dict[int, str] = {}
    for storey in sorted({room.storey for room in building.rooms}):
        here = [k for k, room in enumerate(building.rooms) if room.storey == storey]
        across = float(np.median(middles[here, 1 - axis]))
        number = {False: numbering.first, True: numbering.first + 1}
        for k in sorted(here, key=lambda k: (round(float(middles[k, axis]), 1), float(middles[k, 1 - axis]))):
            kind = building.rooms[k].kind
            if kind in TOILETS:
                texts[k] = "WC"
            if kind in UNNUMBERED:
                continue
            side = bool(middles[k, 1 - axis] > across) if numbering.sides else False
            values = {"storey": numbering.storey + storey, "wing": numbering.wing, "number": number[side]}
            texts[k] = numbering.style.format(**values)
            number[side] += 2 if numbering.sides else 1
    return texts


def _place_beside_door(building: Building, door: Array, own: int, other: int, text: str, height: float) -> tuple[object, ...]:
    """Place a sign of a room beside its door, on the wall of the room that one comes from."""
    normal = np.array([np.cos(door["direction"]), np.sin(door["direction"])])
    to_other = building.rooms[other].polygon.mean(axis=0) - door["centre"][:2]
    normal = normal if normal @ to_other >= 0 else -normal
    along = np.array([-normal[1], normal[0]])
    aside = (door["width"] / 2 + BESIDE_DOOR) * (height < EXIT_HEIGHT)
    x, y = (door["centre"][:2] + normal * (door["thickness"] / 2 + 0.01) + along * aside).tolist()
    return "text", text, (x, y, float(door["centre"][2]) + height), float(np.arctan2(*normal[::-1])), other, own


def change_signs(signs: Array, rng: np.random.Generator, share: float = 0.02) -> Array:
    """Return the signs of a later day, on which a share of the texts is others."""
    out = signs.copy()
    for k in np.flatnonzero((signs["kind"] == "text") & (rng.random(len(signs)) < share)):
        out["text"][k] = f"{int(rng.integers(1, 9))}{int(rng.integers(100, 999))}"
    return out


@dataclass(frozen=True)
class Reader:
    """How signs are read.

    Args:
        kinds: of signs.
        reads: probability that a sign that could be seen is read.
        wrong: probability that a character is wrong.
        sigma: m, of the place in the plane.
        misplaced: share of the signs that are put metres away.
    """

    kinds: tuple[str, ...] = ("text",)
    reads: float = 0.5
    wrong: float = 0.2
    sigma: float = 0.2
    misplaced: float = 0.02


READERS = {"good": Reader(reads=0.9, wrong=0.02), "poor": Reader(reads=0.5, wrong=0.2)}  # of door signs


def read_signs(
    signs: Array, visited: Iterable[int], frame: Sim3, reader: Reader, rng: np.random.Generator, source: str = "simulated"
) -> Landmarks:
    """Read the signs that a visitor of some rooms sees.

    Args:
        signs: (n,) SIGN_DTYPE.
        visited: rooms.
        frame: building -> map.
    """
    seen = signs[np.isin(signs["room"], list(visited)) & np.isin(signs["kind"], reader.kinds)]
    seen = seen[rng.random(len(seen)) < reader.reads]
    parts = []
    for kind in reader.kinds:
        rows = seen[seen["kind"] == kind]
        if not len(rows):
            continue
        texts = [misread(t, reader.wrong, rng) if kind == "text" else t for t in rows["text"].tolist()]
        off = rng.normal(0.0, reader.sigma, (len(rows), 2))
        off[rng.random(len(rows)) < reader.misplaced] *= 20
        at = frame.apply(rows["at"] + np.column_stack([off, np.zeros(len(rows))]))
        sure = np.clip(1 - reader.wrong * rng.uniform(0.5, 2.0, len(rows)), 0.3, 1.0)
        heading = (rows["heading"] + frame.yaw + rng.normal(0.0, 0.1, len(rows)) + np.pi) % (2 * np.pi) - np.pi
        columns = {"sigma": reader.sigma * 1.5 * frame.scale, "confidence": sure, "number": heading}
        parts.append(build_landmarks(kind, texts, source, at, **columns))
    return join_landmarks(parts)


def misread(text: str, wrong: float, rng: np.random.Generator) -> str:
    """Return what a reader makes of a string that takes a share of the characters for others."""
    out = []
    for c in text:
        if rng.random() >= wrong:
            out.append(c)
        elif rng.random() >= DROPPED:
            out.append(str(rng.choice(list(TAKEN_FOR.get(c.upper(), "0123456789")))))
    if len(out) > 3 and rng.random() < CUT * min(5 * wrong, 1.0):
        out = out[1:] if rng.random() < 0.5 else out[:-1]
    return "".join(out) or text
