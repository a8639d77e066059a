"""Crops of storeys, sampled on a device through the turn, the zoom and the drift of their maps, so that no storey is warped."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from topomerge.embedding.surroundings import TIE
from topomerge.training.batches import BEND_STEP

PIXELS_AT_ONCE = 1 << 26  # of crops: bounds the memory of coordinates
EVEN_BYTES = 0x00FF00FF00FF00FF
ROOM_BYTE = -(1 << 56)  # 255 in the highest of eight bytes


@dataclass(frozen=True)
class Storeys:
    """All storeys of a set on a device.

    Args:
        pixels: (n,) int64, eight bytes a pixel: its planes.
        rooms: (n,) int16 room of each pixel.
    """

    pixels: Tensor
    rooms: Tensor


@dataclass(frozen=True)
class Views:
    """How the storey of each part of a batch is seen.

    Args:
        seed: (P,); size: (P, 2) pixels; first: (P,) pixel of it on the device.
        rotation: (P, 2, 2) a place of a crop about its middle -> that of the storey.
        shape: (P, 3) angle in rad, zoom, and scale of lengths.
        knots: (P, m, n, 2) pixels by which places `BEND_STEP` apart moved; None: not at all.
        mask: (P,) int64 of the bytes that are seen; patches: (P, 4, n) that are not, low x, low y, high x, high y; None: all is.
    """

    seed: Tensor
    size: Tensor
    first: Tensor
    rotation: Tensor
    shape: Tensor
    knots: Tensor | None
    mask: Tensor | None
    patches: Tensor | None

    def build_back(self) -> Tensor:
        """Return (P, 2, 2): what takes back the turn and the zoom of a storey."""
        return build_turns(-self.shape[:, 0], 1 / self.shape[:, 1])

    def measure_drift(self, place: Tensor, part: Tensor) -> Tensor:
        """Return (n, m, 2) pixels by which places (n, m, 2) of storeys moved, between the four knots about each."""
        if self.knots is None:
            return torch.zeros_like(place)
        last = (self.size[part] // BEND_STEP + 1)[:, None]
        at = torch.minimum((place / BEND_STEP).clamp(min=0), (last - 1e-3).to(place.dtype))
        low = at.floor()
        (u, v), (i, j) = (at - low)[..., None].unbind(dim=-2), low.long().unbind(dim=-1)
        _, rows, columns, _ = self.knots.shape
        flat, start = self.knots.reshape(-1, 2), part[:, None] * (rows * columns) + i * columns + j
        a, b, c, d = (flat[start + k] for k in (0, columns, 1, columns + 1))
        return torch.lerp(torch.lerp(a, b, u), torch.lerp(c, d, u), v)

    def move(self, place: Tensor, part: Tensor) -> Tensor:
        """Return (n, 2) float64 where places of storeys lie after turn, zoom and drift."""
        moved = place + self.measure_drift(place.nan_to_num().float()[:, None], part)[:, 0]
        out: Tensor = (build_turns(self.shape[:, 0], self.shape[:, 1])[part].double() @ moved[..., None])[..., 0]
        return out


def build_turns(angle: Tensor, zoom: Tensor) -> Tensor:
    """Return (P, 2, 2) float32 matrices that turn by angles (P,), rad, and stretch by factors (P,)."""
    c, s = zoom * angle.cos(), zoom * angle.sin()
    return torch.stack([c, -s, s, c], dim=1).reshape(-1, 2, 2)


@dataclass(frozen=True)
class Crops:
    """Crops to take.

    Args:
        centre: (n, 2) float32 places of their middles on the storeys, but for the drift.
        turned: (n, 2, 2) a place about the middle -> of the storey.
        part: (n,) of the batch; number: (n,) of the room that is shown.
        side: pixels; step: pixels of the storey that one of a side is the mean of, a power of two.
    """

    centre: Tensor
    turned: Tensor
    part: Tensor
    number: Tensor
    side: int
    step: int

    def take(self, rows: slice) -> Crops:
        """Return some of them."""
        return Crops(self.centre[rows], self.turned[rows], self.part[rows], self.number[rows], self.side, self.step)


def place_crops(views: Views, middle: Tensor, part: Tensor, number: Tensor, side: int, step: int) -> Crops:
    """Return the crops about places of the changed storeys, showing rooms.

    Args:
        middle: (n, 2) float64 places; part: (n,) of the batch; number: (n,) rooms.
        side: pixels; step: pixels of the storey, a power of two, that one pixel is the mean of, each way.
    """
    back, whole = views.build_back()[part], (middle + (0.5 + TIE)).floor()
    centre = (back.double() @ whole[..., None])[..., 0].float()
    return Crops(centre, (back @ views.rotation[part]).float(), part, number, side, step)


def sample_by_torch(storeys: Storeys, views: Views, crops: Crops) -> Tensor:
    """Return (n, side * side) int64, eight bytes a pixel, on any device."""
    at_once = max(PIXELS_AT_ONCE // (crops.side * crops.step) ** 2, 1)
    count, pixels = len(crops.part), crops.side**2
    chunks = [_sample_pixels(storeys, views, crops.take(slice(k, k + at_once))) for k in range(0, count, at_once)]
    return torch.cat(chunks) if chunks else torch.zeros((0, pixels), dtype=torch.int64, device=crops.part.device)


def _sample_pixels(storeys: Storeys, views: Views, crops: Crops) -> Tensor:
    side, step, turned = crops.side, crops.step, crops.turned
    offset = (torch.arange(side, device=turned.device) + 0.5 - side / 2) * step  # of blocks
    centre = crops.centre[:, None] + torch.cartesian_prod(offset, offset) @ turned.mT
    place = centre - views.measure_drift(centre, crops.part)
    if step == 1:
        return _read_pixels(storeys, views, crops, place)
    fine = torch.arange(step, device=turned.device) + 0.5 - step / 2
    within = torch.cartesian_prod(fine, fine) @ turned.mT
    every = _read_pixels(storeys, views, crops, (place[:, :, None] + within[:, None]).flatten(1, 2))
    every = every.unflatten(1, (side * side, step * step))
    bits = (step * step).bit_length() - 1  # sums of eight bytes, in four wider ones each
    low, high = (((every >> k) & EVEN_BYTES).sum(dim=2) >> bits & EVEN_BYTES for k in (0, 8))
    return low | (high << 8)


def _read_pixels(storeys: Storeys, views: Views, crops: Crops, place: Tensor) -> Tensor:
    """Return (n, m) int64, eight bytes a pixel, at places (n, m, 2) of the storeys as they were."""
    part = crops.part
    x, y = place.floor().unbind(dim=-1)
    size = views.size[part].float()
    present = (x >= 0) & (y >= 0) & (x < size[:, :1]) & (y < size[:, 1:])
    if views.patches is not None:
        low_x, low_y, high_x, high_y = views.patches[part][:, None].unbind(dim=2)
        at_x, at_y = x[..., None], y[..., None]
        present &= ~((at_x >= low_x) & (at_y >= low_y) & (at_x < high_x) & (at_y < high_y)).any(dim=-1)
    at = torch.where(present, views.first[part][:, None] + x.long() * views.size[part][:, 1:] + y.long(), 0)
    pixels = storeys.pixels[at] if views.mask is None else storeys.pixels[at] & views.mask[part][:, None]
    pixels = pixels | torch.where(storeys.rooms[at] == crops.number[:, None], ROOM_BYTE, 0)
    return torch.where(present, pixels, 0)
