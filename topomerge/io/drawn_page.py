"""The page of a drawing in a picture: cut out of the table or screen that it lies on, straightened, evenly lit, with dark lines
on light paper (beyond the thesis: docs/adr/0041)."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from scipy import ndimage

from topomerge.types import Array

LEAST_PIXELS = 100  # of a side of a page
BRIGHT, BRIGHT_SHARE = 0.6, 0.8  # of the brightness, and of the pixels along the border of a page
GREY_OF_UNKNOWN, GREY_WIDTH, GREY_SHARE = 205, 6, 0.03  # levels of 255: a robot's grid has so much of it
LEAST_LIGHTER = 0.005  # of the pixels of a grid are floor; where none is lighter, the grey is that of paper
UNKNOWN_BORDER = 0.1  # of the pixels along the border of a grid, at least, are unknown
COLOURLESS = 8  # levels of 255 between red, green and blue
COLOURED = 256  # in place of a level: none
FEW_LEVELS, NEARLY_ALL = 3, 0.995  # a robot's grid has so many greys for so many of its pixels

CLEAN_SHARE = 0.3  # of the pixels of a picture that a program drew are of one level

SMALL_SIDE = 400  # px of the longer side at which a page is looked for
LEAST_PAGE, PAGE_FIT = 0.15, 0.93  # of the picture; of quadrilateral and found page, what both hold of what either does
MARGIN, MARGIN_INK = (0.012, 0.03), 0.08  # of a page, where it is empty along its edge, and how much of that may be ink
MARGIN_WINDOW = 15  # px of its side, in which most is paper
EDGE_REACH = 0.05, 0.015  # of the longer side, within which the edge of a page is looked for again
MOST_CORNERS = 12  # of the outline of a page, of which four are chosen
PAPER_SHAPES, PAPER_NEAR = (2**0.5, 11 / 8.5), 0.045  # A4 and its like, letter; as a logarithm

DARK, LEAST_DARK = 0.5, 0.6  # brightness of a blueprint's paper, at most; of the pixels are such
THIN, DEEP = 0.02, 0.15  # of the longer side, half of a line's width; of what is light may lie deeper
FEWEST_LIGHT = 0.004  # of the pixels
LIGHT_SIDE, EVEN, LEAST_LIGHT = 100, 0.85, 60.0  # px of a field of light; less even is mended; level of paper in the shade

LINE_SIDE = 1000  # px of the longer side at which lines are looked for
STRONG = 5.0  # levels of 255 a pixel, of an edge
LEAST_LINE, LINE_WIDTH, FEWEST_LINES = 0.035, 0.8, 6  # of the longer side; px, spread across a line; of each direction
MOST_TURN, MOST_TILT = np.radians(20.0), 0.5  # of lines; of the perspective in half diagonals
STRAIGHT, GAIN = np.radians(0.6), 0.2  # off the axes; so much more of the length of lines is straight afterwards
FOCAL, FOCALS = 1.3, (0.8, 4.0)  # half diagonals: of telephones, and of what is believed
MOST_GROWTH = 1.6  # of a side of a picture that is straightened


@dataclass(frozen=True, eq=False)
class DrawnPage:
    """The page of a drawing, as if it were scanned.

    Args:
        picture: (h, w, 3) uint8, dark lines on light paper.
        matrix: (3, 3), takes its pixels (column, row, 1) to those of the picture that it was found in.
        mended: what was done to it, in words.
        doubtful: it was turned although it has few levels, as a robot's grid (`drawing.is_plan`).
    """

    picture: Array
    matrix: Array = field(default_factory=lambda: np.eye(3))
    mended: tuple[str, ...] = ()
    doubtful: bool = False


def find_page(picture: Array) -> DrawnPage | None:
    """Find the page of a drawing in a picture (h, w, 3) uint8.

    Returns:
        None where it shows none, but a robot's grid or anything else.
    """
    if min(picture.shape[:2]) < LEAST_PIXELS or is_robot_grid(picture):
        return None
    matrix, mended, photograph = np.eye(3), [], is_photograph(picture)
    drawn_to_the_edge = has_bright_border(picture) and not photograph
    few = has_few_levels(picture)  # as in a grid, perhaps an inverted one
    if not (drawn_to_the_edge or few) and (corners := find_sheet(picture)) is not None:
        picture, matrix = cut_sheet(picture, corners)
        mended.append("cut out of what is around its page")
        photograph = is_photograph(picture)
    turned = is_blueprint(picture) and not (few and is_robot_grid(255 - picture))
    if turned:
        picture = invert_picture(picture)
        mended.append("turned into dark lines on light paper")
    if photograph and (lit := equalise_light(picture)) is not None:
        picture = lit
        mended.append("lit evenly")
    if not has_bright_border(picture):
        return None
    if photograph and (step := find_straight_view(picture)) is not None:
        picture, step = warp_picture(picture, step)
        matrix = matrix @ step
        mended.append("straightened by its lines")
    return DrawnPage(picture, matrix, tuple(mended), few and turned)


def is_robot_grid(picture: Array) -> bool:
    """Return whether a picture (h, w, 3) holds the grey of unknown of a robot's grid: along its border, or few others."""
    levels, (red, green, blue) = compute_levels(picture), np.moveaxis(picture, 2, 0)
    spread = np.maximum(np.maximum(red, green), blue) - np.minimum(np.minimum(red, green), blue)
    levels[spread > COLOURLESS] = COLOURED
    histogram = np.bincount(levels.ravel(), minlength=257)[:256] / levels.size
    window = slice(GREY_OF_UNKNOWN - GREY_WIDTH, GREY_OF_UNKNOWN + GREY_WIDTH + 1)
    unknown = histogram[window]
    if unknown.sum() <= GREY_SHARE or unknown.max() <= 0.6 * unknown.sum() or histogram[window.stop :].sum() < LEAST_LIGHTER:
        return False
    border = np.concatenate([levels[0], levels[-1], levels[:, 0], levels[:, -1]])
    around = ((border >= window.start) & (border < window.stop)).mean()
    return bool(around > UNKNOWN_BORDER or has_few_levels(picture))


def compute_levels(picture: Array) -> Array:
    """Compute the levels (h, w) uint16, the mean of red, green and blue of a picture (h, w, 3) uint8, rounded: thirds are never
    halves."""
    total = picture[..., 0].astype(np.uint16)
    total += picture[..., 1]
    total += picture[..., 2]
    total += 1
    total //= 3
    return total


def has_few_levels(picture: Array) -> bool:
    """Return whether a few colours are nearly all of a picture, as in a robot's grid."""
    counts = np.sort(np.bincount(compute_levels(picture).ravel(), minlength=256))[::-1]
    return bool(counts[:FEW_LEVELS].sum() >= NEARLY_ALL * counts.sum())


def is_photograph(picture: Array) -> bool:
    """Return whether no level is that of the whole paper of a picture (h, w, 3), as it is where a program drew it."""
    counts = np.bincount(picture[..., 1].ravel(), minlength=256)
    return bool(np.convolve(counts, np.ones(3), "same").max() < CLEAN_SHARE * picture[..., 1].size)


def has_bright_border(picture: Array) -> bool:
    """Return whether the border of a picture (h, w, 3) is that of a page."""
    lines = [picture[at].mean(axis=1) for at in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1])]
    return bool((np.concatenate(lines) > BRIGHT * 255).mean() >= BRIGHT_SHARE)


def reduce_picture(picture: Array, side: int) -> tuple[Array, float]:
    """Reduce a picture (h, w, 3) to this longer side: float32, and its pixels for each of the picture."""
    from PIL import Image

    zoom = min(1.0, side / max(picture.shape[:2]))
    size = max(round(picture.shape[1] * zoom), 1), max(round(picture.shape[0] * zoom), 1)
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX), np.float32), zoom


def find_sheet(picture: Array) -> Array | None:
    """Find the corners (4, 2) of a page on a table or screen, column and row: upper left, right, lower right, left.

    A page is a quadrilateral that differs from what is along the border of the picture, and is empty along its edge. None: none.
    """
    small, zoom = reduce_picture(picture, SMALL_SIDE)
    smooth = ndimage.gaussian_filter(small, (1.0, 1.0, 0))
    border = np.concatenate([smooth[0], smooth[-1], smooth[:, 0], smooth[:, -1]])
    table = np.median(border, axis=0)
    far = np.abs(smooth - table).max(axis=2)
    noise = float(np.median(np.abs(border - table).max(axis=1)))
    bright = smooth.mean(axis=2)
    split = compute_threshold(bright)
    tint = smooth / np.maximum(smooth.sum(axis=2, keepdims=True), 1.0)  # the same in light and shade
    tinted = np.abs(tint - table / max(float(table.sum()), 1.0)).max(axis=2) * 255
    masks = bright > split, far > 3 * noise + 12, bright < split, tinted > compute_threshold(tinted)
    found = [corners for mask in masks if (corners := _find_quadrilateral(mask, bright)) is not None]
    if not found:
        return None
    corners = max(found, key=_measure_polygon)  # else a shadow across the page is its edge
    for reach in EDGE_REACH:
        corners = refine_corners(smooth, corners, reach * max(bright.shape))
    return (corners + 0.5) / zoom - 0.5


def refine_corners(picture: Array, corners: Array, reach: float) -> Array:
    """Refine corners (4, 2) of a page: lines through the outermost sharp edge within so many pixels of each of its sides."""
    lines = []
    share = np.linspace(0.06, 0.94, 45)[:, None]
    steps = np.arange(-reach, reach + 0.5, 0.5)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = (end - start) / max(float(np.hypot(*(end - start))), 1e-9)
        outward = np.array([along[1], -along[0]])  # corners go around clockwise, rows down
        at = (start + share * (end - start))[:, None] + steps[None, :, None] * outward
        values = np.stack(
            [
                ndimage.map_coordinates(c, at[..., ::-1].transpose(2, 0, 1), order=1, mode="nearest")
                for c in picture.T.swapaxes(1, 2)
            ]
        )
        sharp = np.abs(values[:, :, 4:] - values[:, :, :-4]).max(axis=0)
        strong = sharp >= 0.6 * sharp.max(axis=1, keepdims=True)
        offset = steps[2:-2][strong.shape[1] - 1 - strong[:, ::-1].argmax(axis=1)] - 0.8  # half of where it is sharp
        place = share[:, 0] - 0.5
        fit, weight = np.array([0.0, 0.0]), np.ones(len(place))
        design = np.column_stack([np.ones(len(place)), place])
        for width in (4.0, 2.0, 1.0, 1.0):
            fit = np.linalg.lstsq(design * weight[:, None], offset * weight, rcond=None)[0]
            weight = 1 / (1 + ((offset - design @ fit) / width) ** 2)
        ends = [start + outward * (fit[0] - fit[1] / 2), end + outward * (fit[0] + fit[1] / 2)]
        lines.append(np.cross(np.append(ends[0], 1.0), np.append(ends[1], 1.0)))
    met = np.array([np.cross(lines[k - 1], lines[k]) for k in range(4)])
    with np.errstate(divide="ignore", invalid="ignore"):
        met = met[:, :2] / met[:, 2:]
    return met if np.isfinite(met).all() and np.abs(met - corners).max() <= 3 * reach else corners


def compute_threshold(values: Array) -> float:
    """Compute the level that parts values of 0..255 into two classes best (Otsu 1979)."""
    counts = np.bincount(values.ravel().clip(0, 255).astype(np.int64), minlength=256).astype(np.float64)
    below = np.cumsum(counts)
    weight = np.cumsum(counts * np.arange(256))
    apart = (weight[-1] * below / below[-1] - weight) ** 2 / np.maximum(below * (below[-1] - below), 1.0)
    return float(apart.argmax()) + 0.5


def _find_quadrilateral(mask: Array, bright: Array) -> Array | None:
    """Return the corners of the largest part of a mask (h, w), where that is the page of a drawing."""
    import shapely

    label, count = ndimage.label(ndimage.binary_opening(mask, iterations=2))
    if not count:
        return None
    part = ndimage.binary_fill_holes(label == np.bincount(label.ravel())[1:].argmax() + 1)
    frame = np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]])
    if part.mean() < LEAST_PAGE or part.mean() > 0.97 or frame.mean() > 0.5:
        return None
    edge = np.argwhere(part & ~ndimage.binary_erosion(part, border_value=0))[:, ::-1]
    hull = shapely.convex_hull(shapely.MultiPoint(edge))
    tolerance = 1.0
    while len(ring := np.asarray(hull.simplify(tolerance).exterior.coords)[:-1]) > MOST_CORNERS:
        tolerance *= 1.5
    if len(ring) < 4:
        return None
    best = max((ring[list(four)] for four in combinations(range(len(ring)), 4)), key=_measure_polygon)
    rows, columns = np.indices(part.shape)
    inside = shapely.contains_xy(shapely.Polygon(best), columns, rows)
    if (inside & part).sum() < PAGE_FIT * (inside | part).sum():
        return None
    depth = ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1] / max(part.shape)
    ring = (depth > MARGIN[0]) & (depth < MARGIN[1])
    within = bright[depth >= MARGIN[1]]
    ink = np.abs(bright - ndimage.median_filter(bright, MARGIN_WINDOW))[ring] > 45  # than the paper around it, in light or shade
    if ink.mean() > MARGIN_INK or (np.abs(within - np.median(bright[ring])) > 45).mean() < FEWEST_LIGHT:
        return None
    clockwise = best if _measure_signed(best) > 0 else best[::-1]
    return np.roll(clockwise, -int((clockwise.sum(axis=1)).argmin()), axis=0)


def _measure_signed(ring: Array) -> float:
    x, y = ring.T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def _measure_polygon(ring: Array) -> float:
    return abs(_measure_signed(ring))


def cut_sheet(picture: Array, corners: Array) -> tuple[Array, Array]:
    """Cut a page out: its picture, and the (3, 3) matrix from its pixels to those of the picture.

    Its shape is that of paper, where it is nearly such a shape as a camera sees it; else the mean of its sides.
    """
    sides = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    w, h = (sides[0] + sides[2]) / 2, (sides[1] + sides[3]) / 2
    shape = w / h * _estimate_foreshortening(corners, picture.shape[:2])
    for paper in PAPER_SHAPES:
        if abs(abs(np.log(shape)) - np.log(paper)) <= PAPER_NEAR:
            shape = paper if shape > 1 else 1 / paper
            break
    area = _measure_polygon(corners)
    w, h = np.sqrt(area * shape), np.sqrt(area / shape)
    inset = 0.008 * max(w, h)  # the edge of the page and its shadow
    step = find_homography(np.array([[0, 0], [w, 0], [w, h], [0, h]]), corners)
    step = step @ np.array([[1, 0, inset], [0, 1, inset], [0, 0, 1.0]])
    return transform_picture(picture, step, (round(w - 2 * inset), round(h - 2 * inset))), step


def _estimate_foreshortening(corners: Array, shape: tuple[int, ...]) -> float:
    """Estimate by how much wider a page is than its sides are long on the picture, for their height (a camera of usual lens)."""
    half = float(np.hypot(shape[0], shape[1])) / 2
    points = np.column_stack([(corners - np.array(shape[::-1]) / 2) / half, np.ones(4)])
    sides = [np.cross(points[k], points[(k + 1) % 4]) for k in range(4)]
    across, along = np.cross(sides[0], sides[2]), np.cross(sides[1], sides[3])
    focal = FOCAL
    with np.errstate(divide="ignore", invalid="ignore"):
        square = -(across[:2] @ along[:2]) / (across[2] * along[2])
    if FOCALS[0] ** 2 <= square <= FOCALS[1] ** 2:
        focal = float(np.sqrt(square))
    matrix = find_homography(np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), points[:, :2])
    widths = [float(np.linalg.norm(matrix[:, k] / [1, 1, 1 / focal])) for k in (0, 1)]
    sides_seen = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    seen = (sides_seen[0] + sides_seen[2]) / (sides_seen[1] + sides_seen[3])
    ratio = widths[0] / widths[1] / seen
    return float(np.clip(ratio, 0.5, 2.0)) if np.isfinite(ratio) else 1.0


def find_homography(points: Array, images: Array) -> Array:
    """Find the (3, 3) matrix that takes four points (4, 2) to their images."""
    rows = []
    for (x, y), (u, v) in zip(points, images, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
    return np.append(np.linalg.solve(np.array(rows, float), np.asarray(images, float).ravel()), 1.0).reshape(3, 3)


def transform_picture(picture: Array, step: Array, size: tuple[int, int]) -> Array:
    """Transform a picture to this size (w, h); `step` takes new pixels to its own. What lies outside of it is paper."""
    from PIL import Image

    paper = tuple(
        int(v) for v in np.median(np.concatenate([picture[2, :], picture[-3, :], picture[:, 2], picture[:, -3]]), axis=0)
    )
    how = Image.Transform.PERSPECTIVE, (step / step[2, 2]).ravel()[:8], Image.Resampling.BICUBIC
    return np.asarray(Image.fromarray(picture).transform(size, *how, fillcolor=paper))


def is_blueprint(picture: Array) -> bool:
    """Return whether a picture is dark paper with thin light lines, and not a light floor among dark walls."""
    small, _ = reduce_picture(picture, LINE_SIDE)
    bright = small.mean(axis=2) / 255
    border = np.concatenate([bright[0], bright[-1], bright[:, 0], bright[:, -1]])
    paper = float(np.median(bright))
    if paper > DARK or (border < paper + 0.12).mean() < BRIGHT_SHARE or (bright < paper + 0.12).mean() < LEAST_DARK:
        return False
    light = bright > paper + 0.25
    if light.mean() < FEWEST_LIGHT:
        return False
    depth = ndimage.distance_transform_edt(np.pad(light, 1))[1:-1, 1:-1][light]
    return bool((depth > THIN * max(bright.shape)).mean() <= DEEP)


def invert_picture(picture: Array) -> Array:
    """Return a blueprint as dark lines on white paper, (h, w, 3) uint8."""
    bright = picture.mean(axis=2, dtype=np.float32)
    paper, ink = np.median(bright), max(float(np.percentile(bright, 99.5)), float(np.median(bright)) + 30)
    grey = (255 * (1 - (bright - paper) / (ink - paper))).clip(0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def equalise_light(picture: Array) -> Array | None:
    """Return a picture (h, w, 3) without shades and tints of the light; None where it is lit evenly."""
    small, _ = reduce_picture(picture, 4 * LIGHT_SIDE)
    paper = ndimage.percentile_filter(small[::4, ::4], 85, (11, 11, 1))
    paper = ndimage.gaussian_filter(paper, (4, 4, 0))
    level = paper.mean(axis=2)
    if level.min() > EVEN * level.max() and level.max() > EVEN * 255:
        return None
    if np.percentile(level, 5) < LEAST_LIGHT:
        return None
    field_of = ndimage.zoom(paper, (picture.shape[0] / paper.shape[0], picture.shape[1] / paper.shape[1], 1), order=1)
    field_of = field_of[: picture.shape[0], : picture.shape[1]]
    out = picture[: field_of.shape[0], : field_of.shape[1]] / np.maximum(field_of, 1.0) * 250.0
    return np.pad(out, [(0, n - m) for n, m in zip(picture.shape, out.shape, strict=True)], "edge").clip(0, 255).astype(np.uint8)


def find_straight_view(picture: Array) -> Array | None:
    """Find the (3, 3) matrix from a straightened picture's pixels to those of a picture, by its lines; None: it is straight.

    Lines near the axes of a picture meet in two points, which become those of the axes (Liebowitz and Zisserman 1998).
    """
    small, zoom = reduce_picture(picture, LINE_SIDE)
    middle, half = (np.array(small.shape[1::-1]) - 1) / 2, float(np.hypot(*small.shape[:2])) / 2
    fits, before, after = [], 0.0, 0.0
    for flip in (False, True):
        x, y, slope, length = find_lines(small.mean(axis=2), flip, LEAST_LINE * max(small.shape))
        if len(x) < FEWEST_LINES:
            return None
        x, y = (x - middle[int(flip)]) / half, (y - middle[1 - int(flip)]) / half
        fit = _fit_pencil(x, y, slope, length)
        before += float(length[np.abs(slope) <= STRAIGHT].sum() / length.sum()) / 2
        after += float(length[np.abs(slope - fit[0] - fit[1] * (slope * x - y)) <= STRAIGHT].sum() / length.sum()) / 2
        fits.append(fit)
    (turn, tilt), (lean, pitch) = fits
    if after < before + GAIN or max(abs(turn), abs(lean)) > np.tan(MOST_TURN) or max(abs(tilt), abs(pitch)) > MOST_TILT:
        return None
    across, along = np.array([1.0, turn, tilt]), np.array([lean, 1.0, pitch])
    line = np.cross(across, along)
    flat = np.array([[1, 0, 0], [0, 1, 0], [*line[:2] / line[2], 1]])
    seen = np.column_stack([across[:2] / np.hypot(*across[:2]), along[:2] / np.hypot(*along[:2])])
    axes = np.eye(3)
    axes[:2, :2] = np.diag([1 / np.cos(np.arctan(p * FOCAL)) for p in (tilt, pitch)]) @ np.linalg.inv(seen)
    axes[:2, :2] /= np.sqrt(abs(np.linalg.det(axes[:2, :2])))
    to_unit = np.array([[zoom / half, 0, -middle[0] / half], [0, zoom / half, -middle[1] / half], [0, 0, 1]])
    return np.asarray(np.linalg.inv(axes @ flat @ to_unit))


def find_lines(bright: Array, flip: bool, least: float, strong: float = STRONG) -> tuple[Array, Array, Array, Array]:
    """Find edges within 20 degrees of the horizontal, or of the vertical: their middles along and across, slopes, lengths, px.

    Args:
        bright: (h, w) of 0..255.
        flip: the vertical ones.
        least: px of their length; strong: levels a pixel.
    """
    image = bright.T if flip else bright
    smooth = ndimage.gaussian_filter(image, 0.8)
    across, along = ndimage.sobel(smooth, axis=0) / 8, ndimage.sobel(smooth, axis=1) / 8
    found = [np.zeros((0, 4))]
    for sign in (1, -1):
        ridge = sign * across >= ndimage.maximum_filter1d(sign * across, 3, axis=0)
        edge = ridge & (sign * across > strong) & (np.abs(along) <= np.tan(MOST_TURN) * np.abs(across))
        label, count = ndimage.label(edge, np.ones((3, 3)))
        if not count:
            continue
        at = np.flatnonzero(label)
        number, row, column = label.ravel()[at], *np.divmod(at, image.shape[1])
        size = np.maximum(np.bincount(number, minlength=count + 1), 1)
        x, y = (np.bincount(number, v, count + 1) / size for v in (column, row))
        dx, dy = column - x[number], row - y[number]
        xx, yy, xy = (np.bincount(number, v, count + 1) / size for v in (dx * dx, dy * dy, dx * dy))
        slope = xy / np.maximum(xx, 1e-9)
        thick, length = np.sqrt(np.maximum(yy - slope * xy, 0)), np.sqrt(12 * xx)
        kept = (length >= least) & (thick <= LINE_WIDTH)
        found.append(np.column_stack([x, y, slope, length])[kept])
    x, y, slope, length = np.concatenate(found).T
    return x, y, slope, length


def _fit_pencil(x: Array, y: Array, slope: Array, length: Array) -> tuple[float, float]:
    """Fit the slope in the middle, and how fast it changes, of lines that meet in a point: slope = a + b (slope x - y)."""
    order = np.argsort(slope)
    share = np.cumsum(length[order])
    fit = np.array([slope[order][np.searchsorted(share, share[-1] / 2)], 0.0])
    design = np.column_stack([np.ones(len(x)), slope * x - y])
    for width in (0.08, 0.05, 0.03, 0.02, 0.01, 0.01, 0.006, 0.006):
        weight = length / (1 + ((slope - design @ fit) / width) ** 2) ** 2
        normal = design.T @ (design * weight[:, None]) + np.diag([0, 1e-3 * weight.sum()])
        fit = np.linalg.solve(normal, design.T @ (weight * slope))
    return float(fit[0]), float(fit[1])


def warp_picture(picture: Array, step: Array) -> tuple[Array, Array]:
    """Warp a whole picture by the matrix from new pixels to its own; the matrix from the pixels of what is returned."""
    h, w = picture.shape[:2]
    corners = np.array([[0, 0, 1], [w - 1, 0, 1], [w - 1, h - 1, 1], [0, h - 1, 1]], float) @ np.linalg.inv(step).T
    corners = corners[:, :2] / corners[:, 2:]
    centre = move_places(np.linalg.inv(step), np.array([[(w - 1) / 2, (h - 1) / 2]]))[0]
    grow = np.sqrt(measure_growth(step, centre))  # so much finer, and a pixel stays as large as it was
    low, size = corners.min(axis=0), np.ptp(corners, axis=0) * grow
    size = np.minimum(np.ceil(size) + 1, MOST_GROWTH * np.array([w, h]))
    step = step @ np.array([[1 / grow, 0, low[0]], [0, 1 / grow, low[1]], [0, 0, 1]])
    return transform_picture(picture, step, (int(size[0]), int(size[1]))), step / step[2, 2]


def measure_growth(step: Array, place: Array) -> float:
    """Measure how much larger in area a pixel at a place becomes by a matrix."""
    return abs(float(np.linalg.det(step)) / float(step[2] @ np.append(place, 1.0)) ** 3)


def move_places(matrix: Array, places: Array) -> Array:
    """Move places (n, 2) by a (3, 3) matrix."""
    moved = np.column_stack([places, np.ones(len(places))]) @ matrix.T
    return np.asarray(moved[:, :2] / moved[:, 2:])
