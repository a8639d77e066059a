"""Lengths and names that are written on a plan: areas and sides of rooms, dimensions in a row, names, "1:100"."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FOOT, INCH = 0.3048, 0.0254  # m
PLAUSIBLE_AREA, PLAUSIBLE_SIDE, PLAUSIBLE_DIMENSION = (0.8, 3000.0), (0.6, 100.0), (0.2, 200.0)  # m2, m, m
NUMBER = r"(\d{1,5}(?:[.,]\d{1,3})?)"
AREA = re.compile(
    NUMBER + r"\s*(m\s?[²2](?!\d)|m[?*°azlI](?!\w)|m\^2|qm|sqm|sq\.?\s*m\.?|kvm|㎡|sq\.?\s*ft\.?|ft²|sqft|sf\b|s\.f\.)",
    re.IGNORECASE,
)
SQUARE_LOST = re.compile(r"(\d{1,3}[.,:]\d{1,2})\s?m\.?")  # as "13.4 m²" is read where the raised number is small
SIDES = re.compile(r"(?<![\d.,-])" + NUMBER + r"\s*(mm|cm|m)?\s*(?:[x×X*]|by)\s*" + NUMBER + r"\s*(mm|cm|m)?(?![\d'\"′])")
SIDE_IN_FEET = (
    r"(\d{1,3})\s*(?:['’′]|ft\.?|feet)\s*-?\s*"
    r"(?:(\d{1,2})(?:\s?[½¼¾⅛⅜⅝⅞]|[ -]\d{1,2}/\d{1,2})?\s*(?:[\"”″]|''|in(?:ches|ch|\.)?(?![a-z]))?)?"
)
FEET = re.compile(SIDE_IN_FEET + r"\s*(?:[x×X*]|by)\s*" + SIDE_IN_FEET)
DIMENSION = re.compile(r"(\d{1,2}[.,]\d{1,3}|\d{2,5})\s*(mm|cm|m)?")
DIMENSION_IN_FEET = re.compile(SIDE_IN_FEET)
NUMBERED = re.compile(r"[A-Za-z]{0,3}[-. ]?\d{1,3}(?:[.\-]\d{1,4}){0,2}[a-z]?(?<=..)")
STATED_SCALE = re.compile(
    r"(?:(?<![\d:.,])1\s?:|\b(?:scale|maßstab|[ée]ch(?:elle)?|escala|scala)[.:]?\s*1\s?/)\s?([1-9]\d{1,3})(?![\d:.,])",
    re.IGNORECASE,
)
STATED_IN_FEET = re.compile(r"(?<![\d/])(\d{1,2})(?:/(\d{1,2}))?\s*(?:[\"”″]|'')\s*=\s*(\d{1,3})\s*['’′](?:\s?-?\s?0)?")
THOUSANDS = re.compile(r"\d{1,3},\d{3}")
WORD = re.compile(r"[^\W\d_]{2,}")
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
CENTIMETRES, MILLIMETRES = 60.0, 1000.0  # sides of rooms without a unit, from these on
MOST_DIMENSIONS = 1000  # texts that are looked at
IN_A_ROW = 0.4  # of the letters' height, how far dimensions of one row are off its line
FEWEST_LINKS, LINKS_AGREE, VARIED = 3, 0.03, 1.1  # of neighbours; of the logarithm; the longest for the shortest of them


@dataclass(frozen=True)
class PictureText:
    """A text on a picture: its middle (column, row) and its height, px, and how surely it was read."""

    text: str
    place: tuple[float, float]
    height: float
    confidence: float


def parse_lengths(text: str) -> tuple[float | None, tuple[float, float] | None]:
    """Parse an area, m2, and sides, m, that a text states: "13.4 m²", "4.2 x 5.8 m", "10'-1\\" x 11'-1\\"", "145 sq ft"."""
    sides = None
    if found := FEET.search(text):
        feet = [float(v or 0) for v in found.groups()]
        sides = feet[0] * FOOT + feet[1] * INCH, feet[2] * FOOT + feet[3] * INCH
    elif found := SIDES.search(text):
        values = [float(found[k].replace(",", ".")) for k in (1, 3)]
        usual = "mm" if min(values) >= MILLIMETRES else "cm" if min(values) > CENTIMETRES else "m"
        factor = UNITS[(found[4] or found[2] or usual).lower()]
        sides = values[0] * factor, values[1] * factor
    area = None
    if found := AREA.search(text):
        in_feet = "f" in found[2].lower()
        number = found[1].replace(",", "" if in_feet and THOUSANDS.fullmatch(found[1]) else ".")
        area = float(number) * (FOOT**2 if in_feet else 1.0)
    if area is not None and not PLAUSIBLE_AREA[0] <= area <= PLAUSIBLE_AREA[1]:
        area = None
    if sides is not None and not all(PLAUSIBLE_SIDE[0] <= side <= PLAUSIBLE_SIDE[1] for side in sides):
        sides = None
    return area, sides


def parse_dimension(text: str, whole: float) -> float | None:
    """Parse the only length, m, that a text is: "4.20", "4,2 m", "13'-6\\""; whole numbers count in units of `whole`, m."""
    plain = text.strip()
    value = None
    if found := DIMENSION_IN_FEET.fullmatch(plain):
        value = float(found[1]) * FOOT + float(found[2] or 0) * INCH
    elif found := DIMENSION.fullmatch(plain):
        usual = whole if found[1].isdigit() else 1.0
        value = float(found[1].replace(",", ".")) * (UNITS[found[2]] if found[2] else usual)
    return value if value is not None and PLAUSIBLE_DIMENSION[0] <= value <= PLAUSIBLE_DIMENSION[1] else None


def parse_lost_area(text: str) -> float | None:
    """Parse the only number, m2, of a text that may be an area without its square: "13.4 m"."""
    found = SQUARE_LOST.fullmatch(text.strip())
    value = float(found[1].replace(",", ".").replace(":", ".")) if found else 0.0
    return value if PLAUSIBLE_AREA[0] <= value <= PLAUSIBLE_AREA[1] else None


def find_name(text: str) -> str:
    """Find the name or number of a room in a text: what is left without areas and sides; "" where that is no name."""
    left = FEET.sub(" ", SIDES.sub(" ", AREA.sub(" ", text)))
    left = " ".join(left.split()).strip(" -:;,/|()")
    return left if WORD.search(left) or NUMBERED.fullmatch(left) else ""


def find_stated_scale(texts: Sequence[PictureText]) -> float | None:
    """Find the one scale of a page that its texts state: 100 of "1:100", 96 of "1/8\" = 1'-0\""; None: none, or several."""
    found = {float(match) for text in texts for match in STATED_SCALE.findall(text.text)}
    for text in texts:
        found |= {
            12 * float(f) * float(d or 1) / float(n)
            for n, d, f in STATED_IN_FEET.findall(text.text)
            if min(map(int, (n, d or "1", f)))
        }
    return found.pop() if len(found) == 1 else None


@dataclass(frozen=True)
class Chains:
    """Dimensions that stand in rows and agree on how long a pixel is.

    Args:
        resolutions: m a pixel, of each two neighbours.
        texts: the dimensions.
        varied: the longest for the shortest of them.
    """

    resolutions: tuple[float, ...] = ()
    texts: tuple[PictureText, ...] = ()
    varied: float = 1.0


def find_chains(texts: Sequence[PictureText]) -> list[Chains]:
    """Find dimensions in a row: the middles of neighbours are half of the one and half of the other apart.

    What stands in a row by chance agrees on no scale. Numbers of rooms do, but are all alike as lengths.

    Returns:
        The largest group that agrees, with whole numbers as centimetres, and as millimetres; none for what agrees on nothing.
    """
    found = []
    for whole in (UNITS["cm"], UNITS["mm"]):
        lengths = [(t, v) for t in texts if (v := parse_dimension(t.text, whole)) is not None][:MOST_DIMENSIONS]
        links = np.array(_link_neighbours([t for t, _ in lengths])).reshape(-1, 2)
        if len(links) < FEWEST_LINKS:
            continue
        places, values = np.array([t.place for t, _ in lengths]), np.array([v for _, v in lengths])
        resolution = values[links].mean(axis=1) / np.hypot(*(places[links[:, 1]] - places[links[:, 0]]).T)
        agree = np.abs(np.log(resolution)[:, None] - np.log(resolution)) <= LINKS_AGREE
        kept = agree[int(agree.sum(axis=1).argmax())]
        members = np.unique(links[kept])
        varied = float(values[members].max() / values[members].min())
        if kept.sum() >= FEWEST_LINKS and varied >= VARIED:
            found.append(Chains(tuple(resolution[kept].tolist()), tuple(lengths[k][0] for k in members), varied))
    return found


def _link_neighbours(texts: Sequence[PictureText]) -> list[tuple[int, int]]:
    """Link each text with the next one to its right in its row, and with the next one below in its column."""
    if len(texts) < 2:
        return []
    places, height = np.array([t.place for t in texts]), np.array([t.height for t in texts])
    links = []
    for along in (0, 1):
        ahead = places[None, :, along] - places[:, None, along]
        aside = np.abs(places[None, :, 1 - along] - places[:, None, 1 - along])
        row = (aside <= IN_A_ROW * np.minimum(height[:, None], height)) & (ahead > 0)
        nearest = np.where(row, ahead, np.inf).argmin(axis=1).tolist()
        links += [(i, j) for i, j in enumerate(nearest) if row[i, j]]
    return links
