"""Options that several commands share: options and the types of their values."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from topomerge.cli.console import Argument, build_option
from topomerge.errors import InputError


def _parse_number(text: str, allowed: Callable[[float], bool], range_text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not allowed(value):
        raise argparse.ArgumentTypeError(f"must be a number {range_text}, not {text!r}")
    return value


def parse_positive(text: str) -> float:
    """Parse a finite number above 0, as the `type` of an argument."""
    return _parse_number(text, lambda value: 0 < value < float("inf"), "above 0")


def parse_share(text: str) -> float:
    """Return a number from 0 to 1, as the `type` of an argument."""
    return _parse_number(text, lambda value: 0 <= value <= 1, "from 0 to 1")


def parse_whole_number(text: str) -> int:
    """Parse a whole number from 0 on, as the `type` of an argument."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number, not {text!r}")
    return int(text)


def parse_count(text: str) -> int:
    """Parse a whole number from 1 on, as the `type` of an argument."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 on, not {text!r}")
    return int(text)


def collect_given(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Collect the options that were given; for the others, the called function has its defaults."""
    return {name: getattr(args, name) for name in names if hasattr(args, name)}


@contextmanager
def name_option_in_errors(name: str) -> Iterator[None]:
    """Begin the line of an error of the input within with this option, whose fault it is."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def check_descriptor(args: argparse.Namespace) -> None:
    """Find out before the work starts whether the descriptor can be had with the steps of context.

    Raises:
        InputError: no.
    """
    if args.descriptor == DEFAULT_DESCRIPTOR and not getattr(args, "k", 0):
        return
    from topomerge.embedding.learned import build_embedder

    with name_option_in_errors("--descriptor"):
        if args.descriptor != DEFAULT_DESCRIPTOR:  # which ships, and of two maps is asked for only where walls are not believed
            build_embedder(args.descriptor)
    with name_option_in_errors("--k"):
        steps = getattr(args, "k", 0)
        if steps and args.descriptor == "learned":
            raise InputError("steps of context are for descriptors of single rooms; learned sees what is around: leave it out")
        if steps:
            build_embedder(args.descriptor, steps)


def check_cloud_options(
    paths: Sequence[str], args: argparse.Namespace, names: Sequence[str] = ("voxel_size", "up", "unit", "sensor")
) -> None:
    """Refuse `CLOUD_OPTIONS` where no input is a cloud, and those for folders, pictures or bags where none is one.

    Raises:
        InputError: names the first of them.
    """
    useless = collect_given(args, *names)
    if useless and all(is_map(path) for path in paths):
        name = next(iter(useless)).replace("_", "-")
        raise InputError(f"--{name}: is for clouds, of no use to a .tmap; give the scan that it was made of, or leave it out")
    for name, (able, input_kind, _) in SELECTIVE.items():
        if hasattr(args, name) and not any(is_taker(path, name) for path in paths):
            raise InputError(f"--{name.replace('_', '-')}: is for {able}; give such a {input_kind}, or leave it out")


def collect_reading_options(path: str, args: argparse.Namespace) -> dict[str, Any]:
    """Collect the `CLOUD_OPTIONS` of reading one input, of which some are for folders, pictures or bags only."""
    return collect_given(args, "up", "unit", "text", "tag_size", *(name for name in SELECTIVE if is_taker(path, name)))


def is_taker(path: str, name: str) -> bool:
    """Return whether an input takes an option of `SELECTIVE`."""
    place, suffixes = Path(path), SELECTIVE[name][2]
    if not place.is_dir():
        return place.suffix.lower() in suffixes
    return not suffixes or (name == "topic" and any(file.suffix.lower() in suffixes for file in place.iterdir()))


def is_map(path: str) -> bool:
    """Return whether an input is a .tmap."""
    return Path(path).suffix.lower() == ".tmap"


def collect_belief_options(args: argparse.Namespace) -> dict[str, Any]:
    """Collect `BELIEF_OPTIONS` as keywords of `merge` and `atlas`.

    Raises:
        InputError: a threshold and a risk, or a risk that no threshold can promise.
    """
    choices = collect_given(args, "threshold", "same")
    if hasattr(args, "risk"):
        from topomerge.fusion.inputs import find_risk_threshold

        if "threshold" in choices:
            raise InputError("--threshold and --risk both say when to believe a merge; give one of them")
        try:
            choices["threshold"] = find_risk_threshold(args.risk)
        except InputError as error:
            raise InputError(f"--{error}") from error
    return choices


def collect_atlas_options(args: argparse.Namespace) -> dict[str, Any]:
    """Collect `ATLAS_OPTIONS` as settings of an atlas.

    Raises:
        InputError: as `collect_belief_options`.
    """
    return {**collect_given(args, "scale", "embedder"), **collect_belief_options(args)}


def build_output_option(metavar: str, help: str) -> Argument:
    """Build the option of the output path."""
    return build_option("-o", "--output", required=True, metavar=metavar, default=None, help=help)


def build_quiet_option(help: str = "print nothing") -> Argument:
    """Build the option that prints nothing."""
    return build_option("-q", "--quiet", action="store_true", default=False, help=help)


def build_json_option(help: str = "print JSON instead of tables") -> Argument:
    """Build the option that prints JSON."""
    return build_option("--json", action="store_true", default=False, help=help)


UP = build_option(
    "--up",
    choices=("z", "y", "x", "-z", "-y", "-x"),
    help="axis of the input that points up (default z, for glTF y); with a minus sign: down",
)
UNIT = build_option("--unit", choices=("m", "cm", "mm", "ft", "in"), help="unit of the input (default m)")
ONE_FRAME = build_option(
    "--one-frame",
    action="store_true",
    help="read all files of a folder as one cloud: tiles, or registered stations, of one frame",
)
DEFAULT_DESCRIPTOR = "learned"  # `topomerge.embedding.learned.DEFAULT`, which is not imported for the help
DESCRIPTOR = build_option(
    "--descriptor",
    default=DEFAULT_DESCRIPTOR,
    metavar="NAME",
    help="learned (default; the embedder that ships), engineered, shapedna, feather, or the folder of a trained embedder",
)
BELIEF_OPTIONS = (
    build_option(
        "--known",
        dest="same",
        choices=("nothing", "building", "storey"),
        help="what you already know: all maps are of one building, or of one storey (default nothing)",
    ),
    build_option(
        "--risk", type=parse_positive, metavar="N", help="accept so many false merges in a thousand pairs; sets the threshold"
    ),
    build_option(
        "--threshold",
        type=parse_share,
        metavar="P",
        help="merge from this probability on (default 0.61; in an atlas 0.8, or 0.9 above eleven maps)",
    ),
)
ATLAS_OPTIONS = (
    build_option("--scale", choices=("fixed", "free"), help="free: the maps may differ in scale (default fixed)"),
    *BELIEF_OPTIONS,
    build_option(
        "--descriptor",
        dest="embedder",
        choices=("learned", "engineered", "shapedna", "feather"),
        help="also try the poses that matched rooms propose; takes twice as long (default: walls only)",
    ),
)
SENSORS = ("tls", "lidar", "depth", "tablet", "laser2d", "drawing")  # those of registration/bend/drift.json
JOBS = build_option(
    "--jobs",
    type=parse_count,
    metavar="N",
    help="extract at most N large clouds at once (default: what cores and memory allow)",
)
NO_EDITS = build_option(
    "--no-edits",
    dest="edits",
    action="store_const",
    const=0,
    help="read maps as they were extracted, without the corrections in A.edits.jsonl beside A.tmap",
)
CONTEXT_STEPS = build_option(
    "--k", type=parse_whole_number, default=0, metavar="K", help="steps of context around each room (default 0)"
)
TEXT = (
    build_option("--no-text", dest="text", action="store_false", help="don't read signs and tags on the pictures of a recording"),
    build_option(
        "--text",
        dest="text",
        action="store_true",
        help="read signs and tags on pictures, or fail (default: where topomerge[text] is installed)",
    ),
    build_option(
        "--tag-size",
        type=parse_positive,
        metavar="S",
        help="side of the black square of the tags on pictures, m: they are placed by it (default: by depth)",
    ),
)
RESOLUTION = build_option("--resolution", type=parse_positive, metavar="R", help="m per pixel of a plain image of a floor plan")
PAGE = build_option(
    "--page",
    type=parse_count,
    metavar="N",
    help="page of a PDF, from 1 (default: the only one with content), or plan of a picture or a DXF",
)
TOPIC = build_option("--topic", metavar="NAME", help="topic to read, where a bag has points of several sensors, or maps as well")
READING_OPTIONS = (  # all that readers of a single input take
    UP,
    UNIT,
    ONE_FRAME,
    *TEXT,
    build_option("--scale", type=parse_positive, metavar="S", help="multiply coordinates by this (default 1)"),
    RESOLUTION,
    build_option(
        "--no-drawing",
        dest="drawing",
        action="store_const",
        const=False,
        help="dark pixels of a plain image are walls, also where it is a page with a drawn plan",
    ),
    PAGE,
    build_option("--extrude", type=parse_positive, metavar="H", help="m of wall height for 2D maps (default 2.5)"),
    build_option("--ceiling", action="store_true", help="close 2D maps with a ceiling"),
    build_option(
        "--spacing",
        type=parse_positive,
        metavar="D",
        help="m between points on surfaces of meshes, models and 2D maps, or at the finest level of an octree",
    ),
    build_option("--doors", action="store_true", help="keep the door leaves of building models, where doors are modelled shut"),
    build_option(
        "--poses",
        metavar="TRAJECTORY",
        help="where scans were taken: a KITTI or TUM file, or a topic of the bag (default: a trajectory beside the scans; "
        "in a bag tf, then odometry)",
    ),
    TOPIC,
)
READING_NAMES = (
    *("scale", "resolution", "extrude", "spacing", "tag_size", "up", "unit", "drawing", "ceiling", "doors", "poses", "topic"),
    *("one_frame", "text", "page"),
)
PICTURES = (".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tif", ".tiff", ".pdf")
SELECTIVE = {  # of `CLOUD_OPTIONS`: inputs that take it, in words and as suffixes; none: folders
    "one_frame": ("folders of files", "folder", ()),
    "resolution": ("pictures, PDF and SVG", "file", (*PICTURES, ".svg")),
    "page": ("pictures, PDF and DXF", "file", (*PICTURES, ".dxf")),
    "topic": ("ROS bags", "bag", (".bag", ".db3", ".mcap")),
}
CLOUD_OPTIONS = (
    build_option("--voxel-size", type=parse_positive, metavar="E", help="edge length of the cells of a cloud, m (default 0.1)"),
    UP,
    UNIT,
    ONE_FRAME,
    *TEXT,
    RESOLUTION,
    PAGE,
    TOPIC,
    build_option(
        "--sensor",
        choices=SENSORS,
        help="sensor of the clouds: sets how much drift merge may bend away (default: unknown, as much as for a phone)",
    ),
)
