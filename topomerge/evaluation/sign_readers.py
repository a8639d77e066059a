"""How well a real reader reads door signs: ``python evaluate.py task=landmarks data=reader write=docs/results/landmarks.md``.

The likelihood of signs (`topomerge.landmarks.likelihood`) assumes how often readers err on a character, and the simulated readers
(`datasets.simulation.signs`) err so. Here the reader of ``topomerge[text]`` reads pictures of signs as a camera that moves would
take them: numbers as buildings bear them, letters of a known height, seen from the side, blurred, noisy, compressed.
"""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

from topomerge.datasets.buildings.procedural import make_building
from topomerge.datasets.drawings.sheet import load_font
from topomerge.datasets.plans.splits import get_seed_range
from topomerge.datasets.simulation.signs import draw_numbering, number_rooms
from topomerge.errors import InputError
from topomerge.evaluation.documents import write_table
from topomerge.evaluation.tasks import Row
from topomerge.io.pictures import explain_missing_reader, load_text_reader
from topomerge.landmarks.text import count_edits
from topomerge.statistics import compute_exact_interval
from topomerge.types import Array, fold_text

HEIGHTS = (6, 8, 10, 13, 18, 26, 40)  # px, of a capital letter
ANGLES = (0.0, 30.0, 55.0)  # degrees from the front
PICTURE = (640, 480)
LAYOUTS = ("office", "hotel", "hospital", "school")
HEADS = (
    "letters, px",
    "from the side",
    "signs",
    "not read",
    "read right",
    "95 %",
    "of those read: characters wrong",
    "which look alike",
    "too many or few",
)


def measure_reader(number: int) -> Row:
    """Draw one number of a building's door signs at each height and angle, and read it.

    Raises:
        InputError: the reader is not installed.
    """
    read = load_text_reader()
    if read is None:
        raise InputError(f"data=reader: no reader of texts: {explain_missing_reader()}")
    rng = np.random.default_rng([number, 52])
    building = make_building(LAYOUTS[number % len(LAYOUTS)], int(rng.integers(*get_seed_range("test"))), 1)
    text = str(rng.choice(sorted(set(number_rooms(building, draw_numbering(rng)).values()) - {"WC"})))
    scored = []
    for height in HEIGHTS:
        for angle in ANGLES:
            found = read(draw_sign(text, height, np.radians(angle), rng))
            folded = max((fold_text(one) for _, one, _ in found), key=len, default="")
            alike, unlike, gaps = count_edits(fold_text(text), folded)
            scored.append([height, angle, len(fold_text(text)), len(folded), alike, unlike, gaps])
    return {"text": text, "scored": scored}


def draw_sign(text: str, height: int, angle: float, rng: np.random.Generator) -> Array:
    """Return (480, 640, 3) uint8, a picture of a sign on a wall.

    Args:
        text: what the sign bears.
        height: px, of a capital letter in the picture.
        angle: radians by which the sign is turned away from the camera.
    """
    large = 4 * height  # drawn larger, then made smaller, as a lens does
    font = load_font(int(rng.integers(1000)), round(large / 0.72), text)
    left, top, right, bottom = font.getbbox(text)
    w, h = int(right - left + 2 * large), int(bottom - top + 2 * large)
    wall, plate = int(rng.integers(120, 240)), int(rng.integers(170, 256))
    ink = int(rng.integers(0, 90))
    if rng.random() < 0.3:  # white on dark
        plate, ink = int(rng.integers(20, 90)), int(rng.integers(190, 256))
    sign = Image.new("L", (w, h), plate)
    ImageDraw.Draw(sign).text((large - left, large - top), text, fill=ink, font=font)
    width, near = w * np.cos(angle), 1 + 0.15 * np.sin(angle)  # the nearer edge is higher
    sizes = max(round(width / 4), 2), max(round(h / 4), 2)
    sign = sign.resize(sizes, Image.Resampling.BOX)
    w, h = sizes
    corners = np.array([[0, 0], [w, h * (1 - 1 / near) / 2], [w, h * (1 + 1 / near) / 2], [0, h]])
    picture = Image.new("L", PICTURE, wall)
    shift = np.array([rng.uniform(10, max(PICTURE[0] - w - 10, 11)), rng.uniform(10, max(PICTURE[1] - h - 10, 11))])
    turned = sign.transform(
        PICTURE, Image.Transform.PERSPECTIVE, _find_homography(corners + shift, w, h), Image.Resampling.BICUBIC, fillcolor=wall
    )
    inside = Image.new("L", sign.size, 255).transform(
        PICTURE, Image.Transform.PERSPECTIVE, _find_homography(corners + shift, w, h)
    )
    picture.paste(turned, mask=inside)
    picture = picture.filter(ImageFilter.GaussianBlur(float(rng.uniform(0.3, 1.2))))  # px, of the lens and of the hand
    values = np.asarray(picture, float) + rng.normal(0.0, rng.uniform(2.0, 8.0), PICTURE[::-1])
    stream = BytesIO()
    Image.fromarray(np.clip(values, 0, 255).astype(np.uint8)).convert("RGB").save(
        stream, "JPEG", quality=int(rng.integers(60, 95))
    )
    return np.asarray(Image.open(stream))


def _find_homography(corners: Array, w: int, h: int) -> tuple[float, ...]:
    """Coefficients of Pillow's perspective: from places of the picture to those of the sign."""
    rows, values = [], []
    for (x, y), (u, v) in zip(corners, ((0, 0), (w, 0), (w, h), (0, h)), strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        values += [u, v]
    return tuple(np.linalg.solve(np.array(rows, float), np.array(values, float)).tolist())


def tabulate_readers(rows: Sequence[Row]) -> str:
    """Tabulate, by height and angle, how many signs are read, read right, and how the other ones are wrong."""
    scored = np.array([line for row in rows for line in row["scored"]], float)
    lines: list[list[object]] = []
    for height in HEIGHTS:
        for angle in ANGLES:
            mine = scored[(scored[:, 0] == height) & (scored[:, 1] == angle)]
            if not len(mine):
                continue
            told = mine[mine[:, 3] > 0]
            alike, unlike, gaps = told[:, 4:].sum(axis=0)
            right = int((told[:, 4:].sum(axis=1) == 0).sum())
            low, high = compute_exact_interval(right, len(mine))
            wrong = alike + unlike + gaps
            shares = [f"{100 * part / wrong:.0f} %" if wrong else "–" for part in (alike, gaps)]
            error = f"{wrong / told[:, 2].sum():.3f}" if len(told) else "–"
            lines.append(
                [height, f"{angle:.0f}°", len(mine), len(mine) - len(told), right, f"{low:.2f}–{high:.2f}", error, *shares]
            )
    return write_table(HEADS, lines)
