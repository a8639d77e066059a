"""A corridor with signs and tags on its walls, and the pictures and depth that a camera takes there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from tests.io.rgbd import CENTRE, FOCAL, SHAPE, looking

SIZE = np.array([10.0, 2.4, 2.6])  # m, of the corridor
PIXELS = 400  # of a metre of wall
TAGS = {0: 0xD5D628584, 1: 0xD97F18B49, 2: 0xDD280910E}  # code words of tag36h11, row by row from the upper left
TAG_SIZE = 0.4  # m, with its white margin


@dataclass(frozen=True)
class Sign:
    """What hangs on one of the long walls: at y = 0 and facing +y, or at y = 2.4 and facing -y."""

    text: str
    x: float
    z: float
    far: bool
    height: float = 0.09  # m, of the letters

    @property
    def position(self) -> np.ndarray:
        return np.array([self.x, SIZE[1] if self.far else 0.0, self.z])

    @property
    def heading(self) -> float:
        return -np.pi / 2 if self.far else np.pi / 2


SIGNS = (Sign("2.113", 2.0, 1.5, True), Sign("Labor 2.114", 5.0, 1.6, True), Sign("2.115", 3.5, 1.5, False))
TAG_SIGNS = (Sign("tag36h11:1", 7.5, 1.4, True), Sign("tag36h11:2", 6.5, 1.3, False))


def draw_tag(number: int, side: int) -> Image.Image:
    """A tag with its black border and a white margin."""
    bits = [(TAGS[number] >> (35 - k)) & 1 for k in range(36)]
    cells = np.full((10, 10), 255, np.uint8)
    cells[1:9, 1:9] = 0
    cells[2:8, 2:8] = np.reshape(bits, (6, 6)) * 255
    return Image.fromarray(cells).resize((side, side), Image.Resampling.NEAREST)


@cache
def wall_texture(far: bool, signs: tuple[Sign, ...]) -> np.ndarray:
    """The wall as somebody sees it who looks at it, from above down."""
    width, height = (int(PIXELS * side) for side in SIZE[[0, 2]])
    image = Image.new("L", (width, height), 170)
    draw = ImageDraw.Draw(image)
    for sign in signs:
        if sign.far != far:
            continue
        x = PIXELS * (sign.x if far else SIZE[0] - sign.x)  # who looks along +y has x to the right
        y = PIXELS * (SIZE[2] - sign.z)
        if sign.text.startswith("tag36h11:"):
            tag = draw_tag(int(sign.text[9:]), int(PIXELS * TAG_SIZE))
            image.paste(tag, (int(x - tag.width / 2), int(y - tag.height / 2)))
            continue
        font = ImageFont.truetype(
            Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf", int(PIXELS * sign.height * 1.35)
        )
        left, top, right, bottom = draw.textbbox((x, y), sign.text, font, anchor="mm")
        draw.rectangle((left - 20, top - 20, right + 20, bottom + 20), fill=255)
        draw.text((x, y), sign.text, fill=0, font=font, anchor="mm")
    return np.asarray(image)


def take_picture(pose: np.ndarray, signs: tuple[Sign, ...] = SIGNS + TAG_SIGNS) -> tuple[np.ndarray, np.ndarray]:
    """(480, 640, 3) uint8 of what a camera sees, and (480, 640) how far away it is, m."""
    rows, columns = np.indices(SHAPE)
    rays = np.stack([(columns - CENTRE[0]) / FOCAL[0], (rows - CENTRE[1]) / FOCAL[1], np.ones(SHAPE)], axis=-1) @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(rays > 0, (SIZE - pose[:3, 3]) / rays, -pose[:3, 3] / rays)
        share = np.where(rays == 0, np.inf, share)
    axis, depth = share.argmin(axis=-1), share.min(axis=-1)
    points = pose[:3, 3] + rays * depth[..., None]
    image = np.select([axis == 2, axis == 0], [np.uint8(120), np.uint8(150)], np.uint8(170))
    for far in (True, False):
        on = (axis == 1) & ((rays[..., 1] > 0) == far)
        texture = wall_texture(far, signs)
        along = points[on, 0] if far else SIZE[0] - points[on, 0]
        u = np.clip((PIXELS * along).astype(int), 0, texture.shape[1] - 1)
        v = np.clip((PIXELS * (SIZE[2] - points[on, 2])).astype(int), 0, texture.shape[0] - 1)
        image[on] = texture[v, u]
    return np.repeat(image[..., None], 3, axis=2), depth


def walk_poses(count: int = 14) -> np.ndarray:
    """A camera that walks along the corridor, looks at one wall on its way out and at the other on its way back."""
    out = np.linspace(0.8, 9.0, count // 2)
    there = [looking(np.pi / 2 - 0.25, (x, 0.5, 1.4)) for x in out]
    back = [looking(-np.pi / 2 + 0.25, (x, 1.9, 1.4)) for x in out[::-1]]
    return np.stack([*there, *back])


def poses_before_signs() -> np.ndarray:
    """A camera in front of each sign and tag, askew."""
    places = [(sign.x - 0.2, 0.7 if sign.far else SIZE[1] - 0.7, 1.4) for sign in SIGNS + TAG_SIGNS]
    return np.stack([looking(-sign.heading + 0.15, place) for sign, place in zip(SIGNS + TAG_SIGNS, places, strict=True)])
