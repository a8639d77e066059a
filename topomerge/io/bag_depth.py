"""Depth images in bags, each with the camera that its CameraInfo states.

Read are Image of 16UC1 (mm) and 32FC1 (m), and CompressedImage of 16UC1 as PNG (compressedDepth), as REP 118 and image_transport
have them. The CameraInfo is the topic `camera_info` beside the images, or the only one of their frame.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.io.bag_file import Bag, Message, Topic
from topomerge.io.depth_images import Camera, depth_points, read_pixels
from topomerge.types import Array

IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
ENCODINGS = {"16UC1": ("u2", 1000.0), "32FC1": ("f4", 1.0)}  # kind of number, values of depth in a metre
TRANSPORT = "/compressedDepth"  # how the name of a packed topic ends
PACKED_HEAD = 12  # bytes before the image of a packed message
Decoder = Callable[[Path, Message], tuple[Array, Array | None]]


def depth_topics(bag: Bag) -> list[Topic]:
    """The topics whose first message is a depth image; packed ones only where the plain ones were not recorded."""
    plain = [t for t in bag.of_type(IMAGE) if _first(bag, t).encoding in ENCODINGS]
    names = {t.name for t in plain}
    packed = [t for t in bag.of_type(COMPRESSED_IMAGE) if "compressedDepth" in _first(bag, t).format]
    return plain + [t for t in packed if t.name.removesuffix(TRANSPORT) not in names]


def depth_decoder(bag: Bag, topic: Topic) -> Decoder:
    """What makes points of the messages of a topic of depth images.

    Raises:
        InputError: there is no CameraInfo for them, or it states no camera.
    """
    camera = _camera(bag, topic)

    def decode(path: Path, message: Message) -> tuple[Array, Array | None]:
        depth, metre = _packed(path, message) if topic.type == COMPRESSED_IMAGE else _plain(path, message)
        named = f"{path}: message {message.number} of {message.topic}"
        points, _, _ = depth_points(named, depth, Camera(camera.focal, camera.centre, metre, camera.size, camera.mend))
        return points, None

    return decode


def _first(bag: Bag, topic: Topic) -> Any:
    return next(bag.messages([topic])).content


def _camera(bag: Bag, topic: Topic) -> Camera:
    """The camera of a topic of images, as its CameraInfo states it after rectification (P), else before (K)."""
    beside = bag.named(topic.name.removesuffix(TRANSPORT).rstrip("/").rpartition("/")[0] + "/camera_info")
    if beside is None or beside.type != CAMERA_INFO or not beside.count:
        frame = _first(bag, topic).header.frame_id
        fitting = [t for t in bag.of_type(CAMERA_INFO) if _first(bag, t).header.frame_id == frame]
        if len(fitting) != 1:
            have = f"no CameraInfo beside {topic.name}, and {len(fitting)} of its frame {frame!r}"
            raise InputError(f"{bag.path}: has {have}; record camera_info, too: the bag holds {bag.listing()}")
        beside = fitting[0]
    message = next(bag.messages([beside]))
    info = message.content
    projection, matrix = (np.asarray(getattr(info, name, getattr(info, name.lower(), ())), float) for name in "PK")
    numbers = projection.reshape(3, 4) if projection.size == 12 and projection[0] > 0 else matrix.reshape(3, 3)
    try:
        mend = f"calibrate it, or give another --topic ({beside.name} states the camera)"
        focal, centre = (numbers[0, 0], numbers[1, 1]), (numbers[0, 2], numbers[1, 2])
        return Camera(focal, centre, 1.0, (int(info.height), int(info.width)), mend)
    except ValueError as error:
        raise message.fault(
            bag.path, "states no camera (its K and P are zero)", "calibrate it, or give another --topic"
        ) from error


def _plain(path: Path, message: Message) -> tuple[Array, float]:
    """(h, w) values of an Image, and how many of them are a metre."""
    image = message.content
    if image.encoding not in ENCODINGS:
        able = " or ".join(ENCODINGS)
        raise message.fault(path, f"has the encoding {image.encoding[:40]!r}, which is no depth ({able})", "give another --topic")
    kind, metre = ENCODINGS[image.encoding]
    kind = (">" if image.is_bigendian else "<") + kind
    height, width, step = int(image.height), int(image.width), int(image.step)
    size = np.dtype(kind).itemsize
    if not 0 < width * size <= step or not 0 < height * step <= len(image.data) or step % size:
        raise message.fault(path, f"promises {width} x {height} pixels and has {len(image.data):,} bytes")
    return np.frombuffer(image.data, kind, height * step // size).reshape(height, step // size)[:, :width], metre


def _packed(path: Path, message: Message) -> tuple[Array, float]:
    """The same of a CompressedImage."""
    image = message.content
    if not image.format.startswith("16UC1") or "rvl" in image.format.lower():
        advice = "record the plain images, or unpack them (image_transport republish)"
        raise message.fault(path, f"is packed as {image.format[:60]!r}; only 16UC1 as PNG is read", advice)
    values = read_pixels(bytes(image.data[PACKED_HEAD:]), f"{path}: message {message.number} of {message.topic}")
    if values.ndim != 2 or values.dtype == np.uint8:
        raise message.fault(path, "holds no image of 16 bits")
    return values, ENCODINGS["16UC1"][1]
