"""Read floor plans and robot grids; warn of what is doubtful in them."""

from __future__ import annotations

import math
import reprlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from scipy import ndimage

from topomerge.archive import refuse_pointer
from topomerge.errors import InputError
from topomerge.io.drawing import NAME_HEIGHT, TracedDrawing, build_name_landmarks, build_stairs_landmarks, is_plan, trace_drawing
from topomerge.io.drawn_page import find_page, is_photograph
from topomerge.io.drawn_storeys import DrawnStorey, find_storeys
from topomerge.io.floor_masks import check_outside_floor, is_inverted
from topomerge.io.grey_levels import GreyLevels, find_grey_levels, find_washed_walls, is_clear_cut, is_unknown_grey
from topomerge.io.piece import (
    BLOCK_POINTS,
    MOST_POINTS,
    PIXELS,
    Piece,
    ReadOptions,
    build_count_error,
    build_damage_error,
)
from topomerge.types import Array, Landmarks, join_landmarks

LEAST_DOORWAY, DOOR_STEP = 0.05, 0.06  # probability of a door; m between places of it, at most
CAMERA, EXPOSURE = 0x8769, 0x829A  # tags of EXIF: of how a picture was taken, and for how long
FEWEST_DOTS, MOST_DOTS = 99.0, 2400.0  # an inch, of a scan; 72 and 96 are those of screens
SLAB = 0.3  # m between the walls of a drawn storey and the next floor
INVERT = "; if it shows light lines on dark paper, invert its colours"
PHOTOGRAPH = "was read as a robot's grid, but looks like a photograph: no page of a plan is found in it; take it with its border"


LARGEST_YAML = 1 << 20  # bytes
IMAGES = (".pgm", ".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
# What those are by their content (PPM holds PGM): other plugins of Pillow start programs, as that of PostScript does.
IMAGE_FORMATS = ("PPM", "PNG", "JPEG", "BMP", "TIFF")
MODES = ("trinary", "scale", "raw")
JPEG_MAGIC = b"\xff\xd8\xff"
MOST_PAGES = 100  # of a TIFF that are counted
NOISE_SHARE = 0.05  # of the floor: less in a picture without loss are edges that somebody smoothed, and stay
NOISE_SHARE = 0.01  # of the floor: more noise around the grey of unknown is told


@dataclass(frozen=True)
class Plan:
    """The content of a map_server file; the defaults are its own."""

    image: Path
    resolution: float  # m per pixel
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x, y (m) and yaw (rad) of the lower left corner
    negate: bool = False
    occupied: float = 0.65
    free: float = 0.196
    mode: str = "trinary"
    warnings: tuple[str, ...] = ()


def read(path: Path, options: ReadOptions) -> Iterator[Piece]:
    """Read floor points, then walls layer by layer, in metres."""
    names: Landmarks | None = None
    if (pages := count_pages(path)) > 1:
        warning = f"{path.name}: has {pages} pages, and the first was read; save the others as files of their own"
        yield Piece(np.empty((0, 3)), warnings=(warning,), done=0.0)
    is_yaml = path.suffix.lower() in (".yaml", ".yml")
    picture = read_picture(path) if options.drawing and not is_yaml else None
    page = None if picture is None else find_page(picture)
    if is_yaml:
        plan = read_yaml(path)
        if options.resolution is not None:
            raise InputError(f"{path}: states its own resolution of {plan.resolution:g} m; leave --resolution out")
        occupied, free, warnings = read_pixels(path, plan)
    elif page is not None and (not page.doubtful or is_plan(page)):
        traced = trace_drawing(path, page, options.resolution, paper=read_paper(path), text=options.text)
        yield from build_drawn_pieces(path, traced, options, options.page)
        return
    elif options.resolution is None:
        companion = next((b for b in (path.with_suffix(".yaml"), path.with_suffix(".yml")) if b.is_file()), None)
        hint = f", or read {companion.name} instead" if companion else INVERT if page is not None else ""
        raise InputError(f"{path}: an image does not say how large a pixel is; give --resolution in metres a pixel{hint}")
    else:
        plan = Plan(path, options.resolution)
        occupied, free, warnings = read_pixels(path, plan)
        if picture is not None and is_photograph(picture):
            warnings = (*warnings, f"{path.name}: {PHOTOGRAPH}")
    if options.page is not None:
        raise InputError(f"{path}: is no page with drawn plans; leave --page out")
    yield Piece(np.empty((0, 3)), warnings=(*plan.warnings, *warnings), landmarks=names, done=0.1)
    # The grid is metric already; only a --scale is left to undo in the lengths that are given in metres.
    yield from extrude(path, occupied, free, plan, options)


def build_drawn_pieces(
    path: Path,
    traced: TracedDrawing,
    options: ReadOptions,
    number: int | None = None,
    *,
    corner: tuple[float, float] = (0.0, 0.0),
    unit: float = 1.0,
    untitled: bool = True,
) -> Iterator[Piece]:
    """Yield the floor and the walls of each storey of a drawing, the names of its rooms and its stairs.

    Args:
        number: of the only plan that is read, from 1; None: all.
        corner: x and y of the drawing's lower left corner, m.
        unit: m of the units that are handed over.
        untitled: plans without titles are storeys, too.

    Raises:
        InputError: there is no plan of this number.
    """
    storeys, warnings = find_storeys(path, traced, number, untitled)
    height = (options.extrude + SLAB) / options.factor
    parts, grids, doors = [], [], []
    for level, storey in enumerate(storeys):
        x, y = ((a + b) / unit for a, b in zip(corner, storey.corner, strict=True))
        plan = Plan(path, traced.resolution / unit, (x, y, 0.0))
        at = (x, y), NAME_HEIGHT / options.factor + level * height, path.name
        parts.append(build_name_landmarks(traced.texts, storey.free, plan.resolution, *at))
        parts.append(build_stairs_landmarks(storey.stairs, plan.resolution, *at))
        grids.append(plan)
        doors.append(list_drawn_doors(storey, plan, level * height, options.factor))
    about = Piece(np.empty((0, 3)), warnings=(*traced.warnings, *warnings), done=0.1)
    drawn = np.concatenate(doors)
    yield replace(about, landmarks=join_landmarks(parts), drawn_doors=drawn if len(drawn) else None)
    closed = options if len(storeys) == 1 else replace(options, ceiling=True)  # else the next floor is the ceiling
    for level, (storey, plan) in enumerate(zip(storeys, grids, strict=True)):
        for piece in extrude(path, storey.occupied, storey.free, plan, closed):
            raised = piece.points + [0.0, 0.0, level * height] if level else piece.points
            yield replace(piece, points=raised, done=0.1 + 0.9 * (level + piece.done) / len(storeys))


def list_drawn_doors(storey: DrawnStorey, plan: Plan, floor: float, factor: float) -> Array:
    """List (k, 4) places that may show a door, so close that none of a plan's columns is left out, and how probably they do.

    Args:
        floor: height of the floor; factor: m of the plan's unit.
    """
    count = int(np.ceil(plan.resolution / (DOOR_STEP / factor)))  # places along a pixel
    rows, columns = np.nonzero(storey.doorway >= LEAST_DOORWAY)
    i, j = (np.indices((count, count)).reshape(2, -1, 1) + 0.5) / count
    x = plan.origin[0] + (columns + j) * plan.resolution
    y = plan.origin[1] + (len(storey.doorway) - rows - i) * plan.resolution
    return np.stack(np.broadcast_arrays(x, y, floor, storey.doorway[rows, columns]), axis=-1).reshape(-1, 4)


def count_pages(path: Path) -> int:
    """Count the pages of a TIFF, without smaller copies of a page; 1 for any other file."""
    if path.suffix.lower() not in (".tif", ".tiff"):
        return 1
    from PIL import Image, TiffTags

    reduced = next(number for number, tag in TiffTags.TAGS_V2.items() if tag.name == "NewSubfileType")
    pages = 0
    try:
        with Image.open(path, formats=("TIFF",)) as opened:
            for number in range(min(getattr(opened, "n_frames", 1), MOST_PAGES)):
                opened.seek(number)
                pages += not int(getattr(opened, "tag_v2", {}).get(reduced, 0)) & 1
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError):
        return 1  # `read_image` tells what is wrong
    return max(pages, 1)


def read_picture(path: Path) -> Array:
    """Read (h, w, 3) uint8 colours of an image; what is transparent is white.

    Raises:
        InputError: as `read_image`.
    """
    from PIL import Image, ImageOps

    bright, clear = read_image(path)
    with Image.open(path, formats=IMAGE_FORMATS) as opened:
        image = ImageOps.exif_transpose(opened)  # cameras store how they were held
        if image.mode.startswith(("I", "F")):
            grey = np.round(np.nan_to_num(bright.clip(0, 1)) * 255).astype(np.uint8)
            return np.repeat(grey[..., None], 3, axis=2)
        out = np.array(image.convert("RGB"))
    out[clear] = 255
    return out


def read_paper(path: Path) -> float | None:
    """Read how long a pixel is on paper, m; None: a picture does not say so, or only what programs and cameras write for any."""
    from PIL import Image

    with Image.open(path, formats=IMAGE_FORMATS) as opened:
        if opened.getexif().get_ifd(CAMERA).get(EXPOSURE):
            return None
        try:
            across, along = (float(v) for v in opened.info.get("dpi", (0.0, 0.0)))
        except (TypeError, ValueError, ZeroDivisionError):
            return None
    if not (FEWEST_DOTS <= across <= MOST_DOTS and abs(across - along) <= 0.01 * across):
        return None
    return 0.0254 / across


def read_yaml(path: Path) -> Plan:
    """Read a map_server file.

    Raises:
        InputError: it is not one, a value can't be used, or its image is missing.
    """
    import yaml

    if path.stat().st_size > LARGEST_YAML:
        raise InputError(f"{path}: is too large for a map_server file; give the yaml that names the image")
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, yaml.reader.ReaderError) as error:
        raise InputError(f"{path}: is no text; give the yaml that names the image") from error
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise build_damage_error(path, "a map_server file", getattr(error, "problem", None) or error) from error
    if not isinstance(values, dict) or "image" not in values or "resolution" not in values:
        raise InputError(f"{path}: is not a map_server file (no image and resolution); give the yaml that names the image")
    if not isinstance(values["image"], str) or not isinstance(values.get("mode", ""), str):
        shown = f"{_shorten_value(values['image'])}, {_shorten_value(values.get('mode'))}"
        raise InputError(f"{path}: image and mode are names, not {shown}; mend it")
    image, notes = _find_image(path, values["image"].strip())
    resolution = _read_number(path, values, "resolution", None)
    origin = values.get("origin", [0.0, 0.0, 0.0])
    if not isinstance(origin, list) or len(origin) < 2:
        raise InputError(f"{path}: origin is {_shorten_value(origin)}; it is a list of x, y and yaw")
    x, y = (_read_number(path, {"origin": v}, "origin", None) for v in origin[:2])
    yaw = 0.0
    if len(origin) > 2 and _is_nan(origin[2]):  # map_saver writes that for a quaternion of zeros
        notes = (
            *notes,
            f"{path.name}: the yaw of its origin is {_shorten_value(origin[2])} and was read as 0; write 0 in its place",
        )
    elif len(origin) > 2:
        yaw = _read_number(path, {"origin": origin[2]}, "origin", None)
    mode = values.get("mode", "trinary").lower()
    negate = values.get("negate", 0)
    if mode not in MODES or negate not in (0, 1) or not resolution > 0:
        wrong = f"mode {_shorten_value(mode)}, negate {_shorten_value(negate)} or resolution {resolution:g}"
        raise InputError(f"{path}: {wrong} can't be used; mode is one of {', '.join(MODES)}, negate 0 or 1, resolution above 0")
    thresholds = (_read_number(path, values, *known) for known in (("occupied_thresh", 0.65), ("free_thresh", 0.196)))
    occupied, free = (min(max(value, -1.0), 2.0) for value in thresholds)  # beyond 0 to 1 all are alike
    return Plan(image, resolution, (x, y, yaw), bool(negate), occupied, free, mode, notes)


def _is_nan(value: object) -> bool:
    """Return whether it is the number that is none, as YAML or as C++ writes it (-nan)."""
    try:
        return isinstance(value, str | float) and math.isnan(float(value))
    except ValueError:
        return False


def _read_number(path: Path, values: dict[str, Any], key: str, default: float | None) -> float:
    try:
        value = float(values.get(key, math.nan if default is None else default))
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: {key} is {_shorten_value(values.get(key))} instead of a number; mend it")
    return value


def _shorten_value(value: object) -> str:
    """Shorten a value of a file to fit into a message: aliases can make a list of a few bytes endless."""
    short = reprlib.Repr()
    short.maxlevel = short.maxlist = short.maxdict = 2
    return short.repr(value)[:60]


def _find_image(path: Path, name: str) -> tuple[Path, tuple[str, ...]]:
    """Return the image a map_server file names: as written, else of that name beside the file, else of its stem or the yaml's."""
    base = PureWindowsPath(name).name if "\\" in name else PurePosixPath(name).name
    exact = path.parent / name
    companion = path.parent / base
    others = [path.parent / (stem + s) for stem in (Path(base).stem, path.stem) for s in IMAGES]
    for candidate in (exact, companion, *others):
        if base and candidate.is_file():
            if candidate == exact:
                return candidate, ()
            return candidate, (f"{path.name} names the image {name}; {candidate.name} beside it was read",)
    raise InputError(f"{path}: its image {name[:200]} does not exist; put it beside the yaml")


def read_image(path: Path) -> tuple[Array, Array]:
    """Read brightness (h, w) in 0..1 and whether each pixel is transparent.

    Raises:
        InputError: not an image, or a huge one.
    """
    from PIL import Image, ImageOps, UnidentifiedImageError

    refuse_pointer(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # our own limit is stricter than the library's warning
            with Image.open(path, formats=IMAGE_FORMATS) as opened:
                width, height = opened.size
                if width * height > PIXELS:
                    limit = f"the limit is {PIXELS // 10**6} megapixels"
                    raise InputError(f"{path}: has {width} x {height} pixels and {limit}; crop it or make it smaller")
                image = ImageOps.exif_transpose(opened)
                if image.mode.startswith(("I", "F")):
                    values = np.array(image, np.float32)
                    values[~np.isfinite(values)] = np.nan
                    values /= 65535.0 if image.mode.startswith("I") else np.fmax.reduce(values, axis=None, initial=1.0)
                    return values, np.zeros(values.shape, bool)
                kind = "RGBA" if image.has_transparency_data else "L" if image.mode in ("1", "L") else "RGB"
                rgba = np.asarray(image if image.mode == kind else image.convert(kind))
    except Image.DecompressionBombError as error:
        raise InputError(f"{path}: has far too many pixels; crop it or make it smaller") from error
    except UnidentifiedImageError as error:
        raise InputError(f"{path}: is not an image of {', '.join(IMAGE_FORMATS)}; save it as PNG") from error
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        raise build_damage_error(path, "an image", error if str(error) else "cut short") from error
    clear = rgba[..., 3] == 0 if kind == "RGBA" else np.zeros(rgba.shape[:2], bool)
    bright = rgba.astype(np.float32) if kind == "L" else _sum_colours(rgba) / np.float32(3)
    bright /= 255.0
    return bright, clear


def _sum_colours(rgba: Array) -> Array:
    """Sum red, green and blue of (h, w, 3 or more) uint8 as float32: plane by plane, as sums along so short an axis are slow."""
    total = rgba[..., 0].astype(np.float32)
    total += rgba[..., 1]
    total += rgba[..., 2]
    return total


def read_pixels(path: Path, plan: Plan) -> tuple[Array, Array, tuple[str, ...]]:
    """Read (h, w) bool occupied and free pixels of the image of a plan, and what is doubtful about them.

    Args:
        path: what the user named: the yaml, or the image itself.
        plan: what it says.

    Raises:
        InputError: as `read_image`; or no pixel is occupied or free.
    """
    image = read_image(plan.image)
    occupied, free = classify(image, plan)
    if not occupied.any() and not free.any():
        wrong = f"shows neither floor nor walls (free_thresh {plan.free:g}, occupied_thresh {plan.occupied:g})"
        raise InputError(f"{path}: {wrong}; is free space white and are walls black? mend thresholds, negate or mode")
    warnings: list[str] = []
    if plan.mode == "trinary":
        occupied, free, notes = _read_greys(path, image, plan, occupied, free)
        warnings += [notes] if notes else []
    if is_inverted(occupied, free, plan.resolution):
        advice = (
            f"set negate: {1 - plan.negate}" if path != plan.image else "invert it, or give a yaml of map_server with negate: 1"
        )
        wall = f"{occupied.mean():.0%} of the picture counts as wall"
        warnings.append(f"{plan.image.name}: {wall}; are its colours inverted? {advice}")
    for doubt in check_outside_floor(occupied, free, plan.resolution):
        advice = "if nobody saw it, lower free_thresh below its grey, or paint it in the grey of unknown (205)"
        warnings.append(f"{plan.image.name}: {doubt}; {advice}")
    return occupied, free, tuple(warnings)


def _read_greys(path: Path, image: tuple[Array, Array], plan: Plan, occupied: Array, free: Array) -> tuple[Array, Array, str]:
    """Return the occupied pixels with walls that are grey lines, the free ones without those that are unknown by their grey, and
    the warning about them, "" for none."""
    bright, clear = image
    counted = ~(occupied | clear | np.isnan(bright))
    levels = np.round(np.nan_to_num(bright.clip(0.0, 1.0)) * 255.0).astype(np.uint8)
    levels = 255 - levels if plan.negate else levels
    with plan.image.open("rb") as stream:
        lossy = stream.read(len(JPEG_MAGIC)) == JPEG_MAGIC
    if not lossy:
        occupied = occupied | find_washed_walls(levels, counted, occupied)
        free = free & ~occupied
    grey = find_grey_levels(levels[counted], lossy)
    if grey is None:
        return occupied, free, ""
    known, text = _remove_unknown(path, plan, grey, levels, free, counted, lossy)
    return occupied, known, text


def _remove_unknown(
    path: Path, plan: Plan, grey: GreyLevels, levels: Array, free: Array, counted: Array, lossy: bool
) -> tuple[Array, str]:
    """Return the free pixels without those that are unknown by their grey, and the warning about them, "" for none."""
    if grey.threshold >= plan.free:
        return free, ""
    is_floor = bool((free & (levels == grey.unknown)).any())
    if is_floor and not is_unknown_grey(grey, levels, counted):
        return free, ""
    known = free & (levels > grey.middle)
    noise = 1.0 - known.sum() / max(int(free.sum()), 1)
    if not (is_floor or lossy or (noise >= NOISE_SHARE and is_clear_cut(grey, levels[free]))):
        return free, ""
    if not is_floor and noise < NOISE_SHARE:
        return known, ""
    what = "its grey of unknown" if is_floor else f"noise of {noise:.0%} of the floor around its grey of unknown"
    where = path.name if path != plan.image else "a map_server yaml"
    text = f"{plan.image.name}: {what} ({grey.unknown}) counts as floor by free_thresh {plan.free:g} and was read as unknown"
    return known, f"{text}; write free_thresh: {grey.threshold:.2g} into {where}"


def classify(image: tuple[Array, Array], plan: Plan) -> tuple[Array, Array]:
    """Return (h, w) bool occupied and free pixels of an image by the thresholds alone, as map_server has them."""
    bright, clear = image
    if plan.mode == "raw":
        share = bright * 255.0 / 100.0  # the value itself is the probability in percent; above 100 is unknown
        decided = share <= 1.0
        return decided & (share >= plan.occupied), decided & (share <= plan.free)
    share = bright if plan.negate else 1.0 - bright
    # In mode "scale" the values between the thresholds are kept by map_server; here they stay unknown in every mode.
    return (share > plan.occupied) & ~clear, (share < plan.free) & ~clear


def extrude(path: Path, occupied: Array, free: Array, plan: Plan, options: ReadOptions) -> Iterator[Piece]:
    """Yield floor, walls and, if asked for, ceiling."""
    spacing = (options.spacing or plan.resolution * options.factor) / options.factor
    height = options.extrude / options.factor
    parts = max(1, math.ceil(plan.resolution / spacing - 1e-6))  # points a pixel along each axis
    levels = np.linspace(0.0, height, max(2, math.ceil(height / spacing - 1e-6) + 1))
    occupied = occupied & ndimage.binary_dilation(~occupied, np.ones((3, 3)))
    walls, floor = int(occupied.sum()), int(free.sum())
    total = parts**2 * (walls * float(len(levels)) + floor * (1 + options.ceiling))
    if total > MOST_POINTS:
        raise build_count_error(path, total, spacing * options.factor)
    ground, high = _flatten_mask(free), _flatten_mask(occupied)
    layers = [(ground, 0.0)] + [(high, z) for z in levels] + ([(ground, height)] if options.ceiling else [])
    for number, (pixels, z) in enumerate(layers):
        for points in _iter_point_blocks(pixels, free.shape, plan, parts):
            flat = np.column_stack([points, np.full(len(points), z)])
            yield Piece(flat, done=0.1 + 0.9 * (number + 1) / len(layers))


def _flatten_mask(mask: Array) -> Array:
    """Return (n,) int32 numbers of the masked pixels, row after row."""
    step = max(1, BLOCK_POINTS // mask.shape[1])  # rows at a time: NumPy's numbers take 8 bytes each
    starts = range(0, len(mask), step)
    return np.concatenate([(np.flatnonzero(mask[i : i + step]) + i * mask.shape[1]).astype(np.int32) for i in starts])


def _iter_point_blocks(pixels: Array, shape: tuple[int, ...], plan: Plan, parts: int) -> Iterator[Array]:
    """Yield blocks (n, 2) of metric points of pixels, parts² a pixel, at the centres of its parts."""
    inner = (np.arange(parts) + 0.5) / parts
    dx, dy = (d.ravel() for d in np.meshgrid(inner, inner))
    x0, y0, yaw = plan.origin
    cos, sin = math.cos(yaw), math.sin(yaw)
    step = max(1, BLOCK_POINTS // parts**2)
    for start in range(0, len(pixels), step):
        rows, columns = np.divmod(pixels[start : start + step], shape[1])
        x = (columns[:, None] + dx).ravel() * plan.resolution
        y = (shape[0] - 1 - rows[:, None] + dy).ravel() * plan.resolution
        yield np.column_stack([x0 + cos * x - sin * y, y0 + sin * x + cos * y])
