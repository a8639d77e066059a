"""Read signs and tags on posed pictures: which pictures are looked at, and where what they show stands.

Texts are read by RapidOCR, tags of the family 36h11 by AprilTag. Both are optional packages; their models are in their wheels.
Depth says where a sign is and which way it faces.
Sources: https://github.com/RapidAI/RapidOCR; E. Olson, "AprilTag: a robust and flexible visual fiducial system", 2011.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.depth_images import Camera, Frame, iter_pieces, iter_posed_scans
from topomerge.io.piece import Piece, ReadOptions
from topomerge.io.sightings import MOST_SIGHTINGS, Sighting, clean_text, compute_heading, fuse_sightings, is_legible
from topomerge.progress import Stopwatch
from topomerge.types import Array, Landmarks

KEY_DISTANCE, KEY_ANGLE = 0.5, 15.0  # m and degrees by which the camera moves between two pictures that are read
MOST_PICTURES, FIRST_PICTURES = 600, 30  # that are read of a recording, evenly; 4 minutes of one core
VIEWS_COMPARED = 50  # pictures, from the nearest of which the camera moved
SMALLEST_SIDE, LONGEST_SIDE = 240, 1280  # pixels: below nothing is legible, above the picture is shrunk
SHORTER_SIDE = (
    480  # pixels to which smaller pictures are enlarged; 736, the reader's own, takes 2.5 times as long and reads no more
)
UPRIGHT = 1.5  # height of a line of text by its width, from which on it is turned
LEAST_EDGE = 20.0  # grey levels of the strongest edges, below which a picture shows nothing to read
BLURRED, PICTURES_COMPARED = 0.4, 20  # times the median of the strongest edges of the last pictures
BLURRED_WAY = 2.0  # times the distance and the angle, after which a blurred picture is read, too
FARTHEST_SIGN = 12.0  # m
LEAST_MEASURED, SHARE_MEASURED = 4, 0.1  # pixels of depth that a sign has at least, and of its box
SURFACE_BAND = 0.1  # of the depth: what is that near to the median belongs to the sign
NORMAL_PIXELS, MOST_SIGN_PIXELS = 15, 3000  # of depth, from which on the surface says where a sign faces
FLATNESS = 0.25  # thickness of that surface by its width
POSE_SIGMA, PIXEL_SIGMA, DEPTH_SIGMA = 0.05, 0.01, 0.003  # m; of the distance, of its square (1/m): cameras of depth
CORNER_ERROR, SMALLEST_TAG = 0.5, 8.0  # pixels, of the corners of a tag, and of the side of one that tells a pose
LEAST_TAG_MARGIN = 30.0  # of AprilTag's decision: below, tags are seen in patterns
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture with the depth of what it shows.

    Args:
        image: (h, w, 3) uint8, red, green and blue.
        lens: the camera that took it.
        depth: (h, w) of any size, in values of `camera`.
        camera: that of the depth, at the same place and looking the same way.
        pose: (4, 4) in the fixed frame.
        time: s; nan: not known.
    """

    image: Array
    lens: Camera
    depth: Array
    camera: Camera
    pose: Array
    time: float = math.nan


class PictureReader:
    """Reads signs and tags on the pictures of one recording.

    Args:
        text: True: the packages must be there; None: read with those that are; False: nothing is read.
        tag_size: m, the side of the black square of all tags, by which their poses are computed; None: by depth.

    Raises:
        InputError: a package is missing that must be there.
    """

    def __init__(self, text: bool | None = None, tag_size: float | None = None) -> None:
        self.reads_text, self.tag_size = text is not False, tag_size
        if text and load_text_reader() is None:
            raise InputError("--text: reading signs on pictures needs rapidocr_onnxruntime: pip install topomerge[text]")
        self.warnings: list[str] = []
        self.sightings: list[Sighting] = []
        self.read = self.unplaced = self.unread = 0
        self.watch = Stopwatch()
        self._views = np.zeros((0, 4, 4))  # poses of the last pictures that were read
        self._edges: list[float] = []

    def is_due(self, pose: Array | None, done: float) -> bool:
        """Return whether a picture at a pose is to be read: the camera moved, and the share `done` of all allows for it."""
        if not self.reads_text or pose is None or len(self.sightings) >= MOST_SIGHTINGS or not np.isfinite(pose).all():
            return False
        return self.read < FIRST_PICTURES + MOST_PICTURES * done and self._measure_way(pose) >= 1

    def _measure_way(self, pose: Array) -> float:
        """Measure how far the camera moved since the nearest of the last pictures, in distances and angles between two."""
        moved = np.linalg.norm(self._views[:, :3, 3] - pose[:3, 3], axis=1) / KEY_DISTANCE
        cosine = (np.einsum("kij,ij->k", self._views[:, :3, :3], pose[:3, :3]) - 1) / 2
        lengths = np.maximum(moved, np.degrees(np.arccos(np.clip(cosine, -1, 1))) / KEY_ANGLE)
        return float(lengths.min(initial=BLURRED_WAY))

    def read_frame(self, frame: Frame, depth: Array, image: Array | None) -> None:
        """Read the colours of a frame of depth, if it is due."""
        if image is None or not self.is_due(frame.pose, frame.done):
            return
        lens = frame.lens or scale_camera(frame.camera, depth.shape, image.shape)
        assert frame.pose is not None
        if lens is not None:
            self.read_picture(Picture(image, lens, depth, frame.camera, frame.pose, frame.time))

    def read_picture(self, picture: Picture) -> None:
        """Read a picture that is due, unless it is blurred, small or empty."""
        if min(picture.image.shape[:2]) < SMALLEST_SIDE:
            return
        grey = picture.image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
        edge = measure_strongest_edges(grey)
        blurred = bool(self._edges) and edge < BLURRED * float(np.median(self._edges[-PICTURES_COMPARED:]))
        self._edges.append(edge)
        if edge < LEAST_EDGE or (blurred and self._measure_way(picture.pose) < BLURRED_WAY):
            return
        self._views = np.concatenate([self._views, picture.pose[None]])[-VIEWS_COMPARED:]
        text_reader, tag_reader = load_text_reader(), load_tag_reader()
        self.unread += text_reader is None
        if text_reader is None and tag_reader is None:
            return
        with self.watch.measure("read"):
            shrunk, factor = shrink_picture(picture.image)
            for box, text, confidence in text_reader(shrunk) if text_reader is not None else ():
                value = clean_text(text)
                if is_legible(value, confidence):
                    self._place("text", value, confidence, box * factor, picture)
            for corners, value in tag_reader(grey.astype(np.uint8)) if tag_reader is not None else ():
                self._place("tag", value, 1.0, corners, picture)
        self.read += 1

    def _place(self, kind: str, value: str, confidence: float, box: Array, picture: Picture) -> None:
        place = place_square(box, picture, self.tag_size) if kind == "tag" and self.tag_size else place_box(box, picture)
        if place is None:
            self.unplaced += 1
            return
        position, sigma, heading = place
        self.sightings.append(Sighting(kind, value, position, sigma, confidence, heading, picture.time, self.read))

    def collect(self) -> Landmarks:
        """Return the landmarks of all pictures; what the user should know is in `warnings`."""
        if self.unread:
            self.warnings.append(f"signs on pictures are not read: {explain_missing_reader()} (--no-text: without this line)")
        if self.read:
            seconds = self.watch.seconds["read"]
            log.info("%d pictures were read in %.1f s, %.2f s each", self.read, seconds, seconds / self.read)
        if self.unplaced:
            log.info("%d texts and tags on pictures have no depth and are left out", self.unplaced)
        return fuse_sightings(self.sightings, "pictures")


def iter_frame_pieces(path: Path, frames: Iterable[Frame | None], warnings: list[str], options: ReadOptions) -> Iterator[Piece]:
    """Yield the points of posed frames, and with the last piece the signs and tags on their colours.

    Args:
        path: of the recording, for messages.
        frames: as `iter_posed_scans` takes them.
        said: takes warnings.
        options: of reading pictures.
    """
    reader = PictureReader(options.text, options.tag_size)

    def collect() -> Landmarks:
        landmarks = reader.collect()
        warnings.extend(reader.warnings)
        return landmarks

    yield from iter_pieces(iter_posed_scans(path, frames, warnings, reader.read_frame), warnings, collect)


def scale_camera(camera: Camera, shape: tuple[int, ...], other: tuple[int, ...]) -> Camera | None:
    """Return the camera of a picture (h, w) that shows what another of a shape shows; None: it has another form."""
    y, x = other[0] / shape[0], other[1] / shape[1]
    if abs(y / x - 1) > 0.02:
        return None
    return Camera((camera.focal[0] * x, camera.focal[1] * y), (camera.centre[0] * x, camera.centre[1] * y), camera.metre)


def measure_strongest_edges(grey: Array) -> float:
    """Measure the grey levels by which the sharpest lines of a picture (h, w) differ from their neighbours."""
    across = np.abs(2 * grey[1:-1:2, 1:-1] - grey[1:-1:2, :-2] - grey[1:-1:2, 2:]).ravel()
    last = max(len(across) - max(len(across) // 500, 1), 0)
    return float(np.partition(across, last)[last])


def shrink_picture(image: Array) -> tuple[Array, float]:
    """Return a picture whose longer side has at most `LONGEST_SIDE` pixels, and how much larger the given one is."""
    factor = max(image.shape[:2]) / LONGEST_SIDE
    if factor <= 1:
        return image, 1.0
    from PIL import Image

    height, width = (max(round(side / factor), 1) for side in image.shape[:2])
    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BOX)), image.shape[1] / width


def place_box(box: Array, picture: Picture) -> tuple[Array, float, float] | None:
    """Return where the middle of a box (4, 2) on a picture lies by its depth.

    Returns:
        (3,) m, its uncertainty, m, and the heading (rad, nan: not known) that it faces; None: there is no depth.
    """
    rays = (box - picture.lens.centre) / picture.lens.focal
    measured = _unproject_patch(rays, picture)
    if measured is None:
        return None
    distance = float(np.median(measured[:, 2]))
    surface = measured[np.abs(measured[:, 2] - distance) <= SURFACE_BAND * distance]
    middle = np.append(rays.mean(axis=0), 1.0) * distance
    normal = estimate_normal(surface)
    heading = math.nan if normal is None else compute_heading(picture.pose[:3, :3] @ normal)
    sigma = math.hypot(POSE_SIGMA, PIXEL_SIGMA * distance, DEPTH_SIGMA * distance**2)
    return picture.pose[:3, :3] @ middle + picture.pose[:3, 3], sigma, heading


def place_square(corners: Array, picture: Picture, side: float) -> tuple[Array, float, float] | None:
    """Return where the middle of a square of known size lies, by its corners (4, 2) on a picture, one after the other.

    Source: Z. Zhang, "A flexible new technique for camera calibration", 2000 (pose of a plane by its homography).

    Args:
        side: of the square, m.

    Returns:
        As `place_box`; None: it is too small on the picture, or seen from its edge.
    """
    rays = (corners - picture.lens.centre) / picture.lens.focal
    pixels = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min())
    if not np.isfinite(rays).all() or pixels < SMALLEST_TAG:
        return None
    square = np.column_stack([side / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]), np.ones(4)])
    nothing = np.zeros((4, 3))
    rows = [np.hstack([square, nothing, -rays[:, :1] * square]), np.hstack([nothing, square, -rays[:, 1:] * square])]
    _, spread, axes = np.linalg.svd(np.concatenate(rows))
    if spread[-1] < 1e-9 * spread[0]:  # corners that lie in a line tell no plane
        return None
    plane = axes[-1].reshape(3, 3)
    plane = plane * (np.sign(plane[2, 2]) / np.sqrt(np.linalg.norm(plane[:, 0]) * np.linalg.norm(plane[:, 1])))
    middle, normal = plane[:, 2], np.cross(plane[:, 0], plane[:, 1])
    distance = float(np.linalg.norm(middle))
    if not 0 < distance <= FARTHEST_SIGN:  # false for nan
        return None
    heading = compute_heading(picture.pose[:3, :3] @ (-normal if normal @ middle > 0 else normal))
    sigma = math.hypot(POSE_SIGMA, distance * CORNER_ERROR / pixels)
    return picture.pose[:3, :3] @ middle + picture.pose[:3, 3], sigma, heading


def _unproject_patch(rays: Array, picture: Picture) -> Array | None:
    """Return (n, 3) points of the depth image within a box of rays (4, 2), in the camera's frame; None: too few."""
    camera, depth = picture.camera, picture.depth
    low, high = rays.min(axis=0) * camera.focal + camera.centre, rays.max(axis=0) * camera.focal + camera.centre
    if not np.isfinite([low, high]).all():
        return None
    height, width = depth.shape
    left, right = (int(np.clip(v, 0, width)) for v in (np.floor(low[0]), np.ceil(high[0]) + 1))
    top, bottom = (int(np.clip(v, 0, height)) for v in (np.floor(low[1]), np.ceil(high[1]) + 1))
    step = max(1, round(math.sqrt((right - left) * (bottom - top) / MOST_SIGN_PIXELS)))
    patch = depth[top:bottom:step, left:right:step] / camera.metre
    rows, columns = np.nonzero((patch > 0) & (patch <= FARTHEST_SIGN))
    if len(rows) < max(LEAST_MEASURED, SHARE_MEASURED * patch.size):
        return None
    z = patch[rows, columns]
    x = (left + step * columns - camera.centre[0]) / camera.focal[0]
    y = (top + step * rows - camera.centre[1]) / camera.focal[1]
    return np.stack([x * z, y * z, z], axis=1)


def estimate_normal(points: Array) -> Array | None:
    """Estimate the unit normal (3,), towards the camera at 0, of a plane through points (n, 3); None: they lie on none."""
    if len(points) < NORMAL_PIXELS:
        return None
    middle = points.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov((points - middle).T))
    if not np.sqrt(max(values[0], 0)) <= FLATNESS * np.sqrt(max(values[1], 0)):
        return None
    normal = vectors[:, 0]
    return np.asarray(-normal if normal @ middle > 0 else normal)


TextReader = Callable[[Array], list[tuple[Array, str, float]]]  # picture -> corners (4, 2), text, confidence
TagReader = Callable[[Array], list[tuple[Array, str]]]  # grey picture -> corners (4, 2), family and number


def explain_missing_reader() -> str:
    """Explain in a few words how the reader of texts can be had."""
    try:
        import rapidocr_onnxruntime  # noqa: F401
    except ImportError as error:
        if getattr(error, "name", None) in ("rapidocr_onnxruntime", None) and "lib" not in str(error):
            return "pip install topomerge[text]"
        return f"the package of topomerge[text] does not load ({' '.join(str(error).split())[:80]})"
    return "pip install topomerge[text]"


@cache
def load_text_reader(both_ways: bool = False) -> TextReader | None:
    """Load the reader of texts; None: its package is not installed, or does not load.

    Args:
        both_ways: read upright lines from below and from above, as plans write them; else from above alone, as signs.
    """
    try:
        from rapidocr_onnxruntime import RapidOCR
    except ImportError:
        return None
    logging.getLogger("RapidOCR").setLevel(logging.CRITICAL)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    threads = {"intra_op_num_threads": min(cores, 4), "inter_op_num_threads": 1}
    # Lines are padded to this width, twice as much by default: as many are read right, in half of the time.
    engine: Any = RapidOCR(**threads, det_limit_side_len=SHORTER_SIDE, rec_img_shape=[3, 48, 160])

    def read(image: Array) -> list[tuple[Array, str, float]]:
        found, _ = engine(np.ascontiguousarray(image[..., ::-1]), use_cls=False)
        return [(np.asarray(box, float), str(text), float(confidence)) for box, text, confidence in found or ()]

    def read_both_ways(image: Array) -> list[tuple[Array, str, float]]:
        picture = np.ascontiguousarray(image[..., ::-1])
        found, _ = engine(picture, use_cls=False, use_rec=False)
        boxes = np.asarray(found or (), np.float32).reshape(-1, 4, 2)
        lines = engine.get_crop_img_list(picture, boxes)  # upright ones lie down to the left, as they read from above
        upright = [k for k, box in enumerate(boxes) if is_upright(box)]
        texts, _ = engine.text_rec(lines) if lines else ([], 0.0)
        turned, _ = engine.text_rec([lines[k][::-1, ::-1] for k in upright]) if upright else ([], 0.0)
        for k, other in zip(upright, turned, strict=True):
            texts[k] = max(texts[k], other, key=lambda one: float(one[1]))
        rows = [(np.asarray(box, float), str(one[0]), float(one[1])) for box, one in zip(boxes, texts, strict=True)]
        return [row for row in rows if row[2] >= engine.text_score]

    return read_both_ways if both_ways else read


def is_upright(box: Array) -> bool:
    """Return whether a line of text in a box (4, 2) runs up or down: the reader turns what is so much higher than wide."""
    width, height = (max(np.linalg.norm(box[a] - box[b]) for a, b in pairs) for pairs in (((0, 1), (2, 3)), ((0, 3), (1, 2))))
    return bool(height >= UPRIGHT * width)


@cache
def load_tag_reader() -> TagReader | None:
    """Load the reader of tags; None: its package is not installed, or does not load."""
    try:
        from pupil_apriltags import Detector

        detector = Detector(families="tag36h11", nthreads=1, quad_decimate=1.0)
    except (ImportError, OSError, RuntimeError):
        return None

    def read(grey: Array) -> list[tuple[Array, str]]:
        found = detector.detect(np.ascontiguousarray(grey))
        sure = [tag for tag in found if tag.hamming == 0 or tag.decision_margin >= LEAST_TAG_MARGIN]
        return [(np.asarray(tag.corners, float), f"tag36h11:{tag.tag_id}") for tag in sure]

    return read
