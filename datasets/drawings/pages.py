"""Pages as scanners and cameras see them, and those that a network learns from."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO

import numpy as np
from PIL import Image, ImageFilter
from scipy import ndimage
from topomerge.datasets.drawings.hands import draw_plan
from topomerge.datasets.drawings.shapes import DrawingShapes, mirror_shapes
from topomerge.datasets.drawings.sheet import Drawing, choose_hand

from topomerge.io.drawing import COARSEST, FINEST
from topomerge.networks.drawing import PAGE
from topomerge.types import Array

SEEN_SCALES = 1 / COARSEST, 1 / FINEST  # px/m at which a page whose scale is known is looked at
UNKNOWN_SCALES = 25.0, 45.0  # px/m: of pages whose scale is not known
MOST_SHRUNK = 2.0  # times as fine as they are looked at are pages that are made smaller first
AT_FINEST, AT_OTHERS = 0.5, 0.4  # of the pages that are learned from; the rest are of unknown scale


def spoil_page(drawing: Drawing, rng: np.random.Generator) -> Drawing:
    """Return the page as a scanner or camera saw it: turned, warped, in perspective, shaded, blurred, noisy, compressed."""
    picture, classes, rooms = Image.fromarray(drawing.picture), Image.fromarray(drawing.classes), drawing.rooms
    label = Image.fromarray((rooms + 1).astype(np.int32), "I")
    h, w = classes.size[1], classes.size[0]
    paper = tuple(int(v) for v in np.median(drawing.picture[::7, ::7].reshape(-1, 3), axis=0))
    if rng.random() < 0.3:  # a table under the page
        paper = tuple(int(v) for v in rng.integers(0, 220, 3))
    if rng.random() < 0.35:
        matrix = _sample_camera(h, w, rng)
        picture = picture.transform((w, h), Image.Transform.PERSPECTIVE, matrix, Image.Resampling.BILINEAR, fillcolor=paper)
        classes = classes.transform((w, h), Image.Transform.PERSPECTIVE, matrix, Image.Resampling.NEAREST, fillcolor=PAGE)
        label = label.transform((w, h), Image.Transform.PERSPECTIVE, matrix, Image.Resampling.NEAREST, fillcolor=0)
    pixels, truth, numbers = np.asarray(picture, np.float32), np.asarray(classes), np.asarray(label).astype(np.int16) - 1
    if rng.random() < 0.25:  # a shaky hand, or paper that is not flat
        pixels, truth, numbers = _warp(pixels, truth, numbers, rng)
    turn = int(rng.integers(4))
    pixels, truth, numbers = (np.rot90(a, turn) for a in (pixels, truth, numbers))
    return Drawing(spoil_light(pixels, rng), np.ascontiguousarray(truth), np.ascontiguousarray(numbers), (), drawing.scale)


def _sample_camera(h: int, w: int, rng: np.random.Generator) -> Sequence[float]:
    """Sample the coefficients of Pillow's perspective: corners moved a little, and turned."""
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], float)
    angle = rng.normal(0, 0.06)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = (corners - [w / 2, h / 2]) @ turn.T * rng.uniform(0.9, 1.1) + [w / 2, h / 2]
    if rng.random() < 0.4:
        moved += rng.normal(0, 0.04, (4, 2)) * [w, h]
    rows = []
    for (x, y), (u, v) in zip(corners, moved, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    return [float(v) for v in np.linalg.lstsq(np.array(rows), moved.ravel(), rcond=None)[0]]


def _warp(pixels: Array, truth: Array, numbers: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    coarse = max(int(rng.integers(6, 40)), 4)
    by = [
        ndimage.zoom(
            rng.normal(0, rng.uniform(0.5, 2.0), (coarse, coarse)), (truth.shape[0] / coarse, truth.shape[1] / coarse), order=1
        )
        for _ in range(2)
    ]
    h, w = truth.shape
    at = np.indices(truth.shape) + np.stack([b[:h, :w] for b in by])
    i, j = (np.clip(np.rint(a), 0, n - 1).astype(int) for a, n in zip(at, truth.shape, strict=True))
    return pixels[i, j], truth[i, j], numbers[i, j]


def spoil_light(pixels: Array, rng: np.random.Generator) -> Array:
    """Return (h, w, 3) uint8 pixels after light, lens, sensor and compression."""
    h, w = pixels.shape[:2]
    out: Array = np.array(pixels, np.float32)
    if rng.random() < 0.3:
        out = out.mean(axis=2, keepdims=True).repeat(3, axis=2)
    if rng.random() < 0.25:  # shade and folds
        field = ndimage.zoom(rng.uniform(0.55, 1.0, (4, 4)), (h / 4 + 0.01, w / 4 + 0.01), order=1)[:h, :w]
        out *= field[:, :, None]
        if rng.random() < 0.4:
            out[:, int(rng.integers(w))] *= rng.uniform(0.6, 1.2)
    if rng.random() < 0.3:
        out = (out - 128) * rng.uniform(0.45, 1.0) + 128 + rng.uniform(-30, 30)
    if rng.random() < 0.06:  # a blueprint
        out = 255 - out
        if rng.random() < 0.6:
            out = 0.75 * out + 0.25 * rng.uniform(0, 255, 3)
    image = Image.fromarray(out.clip(0, 255).astype(np.uint8))
    if rng.random() < 0.4:
        image = image.filter(ImageFilter.GaussianBlur(float(rng.uniform(0.3, 1.6))))
    if rng.random() < 0.3:  # saved smaller and enlarged
        share = rng.uniform(0.4, 0.9)
        image = image.resize((int(w * share), int(h * share)), Image.Resampling.BILINEAR).resize(
            (w, h), Image.Resampling.BILINEAR
        )
    if rng.random() < 0.4:
        stream = BytesIO()
        image.save(stream, "JPEG", quality=int(rng.integers(15, 90)))
        image = Image.open(stream).convert("RGB")
    out = np.asarray(image, np.float32)
    if rng.random() < 0.3:
        out = out + rng.normal(0, rng.uniform(2, 14), out.shape)
    return out.clip(0, 255).astype(np.uint8)


def sample_drawing(shapes: Sequence[DrawingShapes], rng: np.random.Generator, side: int = 256, corrupted: bool = True) -> Drawing:
    """Draw a window of one of the plans in a hand at random, as large as the network of drawings sees pages."""
    one = shapes[int(rng.integers(len(shapes)))]
    one = mirror_shapes(one) if rng.random() < 0.5 else one
    scale = _sample_scale(rng)
    window = side / scale
    corner = _sample_centre(one, rng, window) - window / 2
    fine = round(side * float(np.exp(rng.uniform(0, np.log(MOST_SHRUNK)))))
    drawing = draw_plan(one, choose_hand(rng), rng, (fine, fine), fine / window, corner)
    return shrink_drawing(spoil_page(drawing, rng) if corrupted else drawing, side)


def _sample_centre(shapes: DrawingShapes, rng: np.random.Generator, window: float) -> Array:
    """Return (2,) m: anywhere in the plan, its middle, or about an opening."""
    points = np.concatenate([r.polygon for r in shapes.rooms])
    low, high = points.min(axis=0), points.max(axis=0)
    kind = rng.random()
    if kind < 0.4 and shapes.openings:
        opening = shapes.openings[int(rng.integers(len(shapes.openings)))]
        return np.asarray(opening.line.mean(axis=0) + rng.normal(0, window / 6, 2))
    return np.asarray(rng.uniform(low - 1.0, high + 1.0) if kind < 0.8 else (low + high) / 2)


def _sample_scale(rng: np.random.Generator) -> float:
    """Sample the px/m at which a page is looked at."""
    kind = rng.random()
    if kind < AT_FINEST:
        return SEEN_SCALES[1]
    low, high = SEEN_SCALES if kind < AT_FINEST + AT_OTHERS else UNKNOWN_SCALES
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def shrink_drawing(drawing: Drawing, side: int) -> Drawing:
    """Return a square drawing of so many pixels a side, the picture as `io.drawing.resize_picture` makes it."""
    old = len(drawing.picture)
    if old == side:
        return drawing
    picture = np.asarray(Image.fromarray(drawing.picture).resize((side, side), Image.Resampling.BOX))
    at = ((np.arange(side) + 0.5) * old / side).astype(int)
    classes, rooms = drawing.classes[at][:, at], drawing.rooms[at][:, at]
    return Drawing(picture, classes, rooms, drawing.texts, drawing.scale * side / old)
