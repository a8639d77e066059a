"""Signs and tags on the pictures of recordings: found where they hang, fused, and nothing made up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.io.rgbd import CENTRE, FOCAL, START, looking
from tests.io.signs import SIGNS, SIZE, TAG_SIGNS, Sign, take_picture, walk_poses
from tests.io.walks import write_tum
from topomerge.errors import InputError
from topomerge.io import pictures, read_points, sightings
from topomerge.io.depth_images import Camera, Frame
from topomerge.io.pictures import (
    Picture,
    PictureReader,
    estimate_normal,
    measure_strongest_edges,
    place_box,
    place_square,
    shrink_picture,
)
from topomerge.io.sightings import (
    LONGEST_TEXT,
    Sighting,
    clean_text,
    compute_heading,
    count_edits,
    fuse_sightings,
    is_legible,
)
from topomerge.types import Landmarks

CAMERA = Camera(FOCAL, CENTRE, 1.0)


def write_corridor(folder: Path, poses: np.ndarray, signs: tuple[Sign, ...] = SIGNS + TAG_SIGNS) -> Path:
    """A recording of the corridor as the TUM benchmark lays it out."""
    for name in ("depth", "rgb"):
        (folder / name).mkdir(parents=True)
    times = START + np.arange(len(poses))
    for pose, when in zip(poses, times.tolist(), strict=True):
        image, depth = take_picture(pose, signs)
        Image.fromarray(np.rint(depth * 5000).astype(np.uint16)).save(folder / "depth" / f"{when:.6f}.png")
        Image.fromarray(image).save(folder / "rgb" / f"{when:.6f}.png")
    for name in ("depth", "rgb"):
        (folder / f"{name}.txt").write_text("".join(f"{t:.6f} {name}/{t:.6f}.png\n" for t in times))
    (folder / "camera.txt").write_text(f"{FOCAL[0]} {FOCAL[1]} {CENTRE[0]} {CENTRE[1]} 5000\n")
    write_tum(folder / "groundtruth.txt", poses, times)
    return folder


def assert_hang(landmarks: Landmarks | None, signs: tuple[Sign, ...], reach: float = 0.1) -> None:
    """Exactly these signs are found, where they hang, facing where they face."""
    assert landmarks is not None
    values = landmarks.get_values().tolist()
    assert sorted(values) == sorted(sign.text for sign in signs)
    for sign in signs:
        row = landmarks.table[values.index(sign.text)]
        assert np.abs(row["position"] - sign.position).max() < reach
        assert abs((row["number"] - sign.heading + np.pi) % (2 * np.pi) - np.pi) < 0.1
        assert 0.02 < row["sigma"] < 0.3 and row["confidence"] > 0.8


@pytest.mark.longer
def test_signs_and_tags_of_a_folder(tmp_path: Path) -> None:
    pytest.importorskip("rapidocr_onnxruntime", exc_type=ImportError)
    pytest.importorskip("pupil_apriltags", exc_type=ImportError)
    cloud = read_points(write_corridor(tmp_path / "walk", walk_poses()))
    assert_hang(cloud.landmarks, SIGNS + TAG_SIGNS)
    assert cloud.landmarks is not None and cloud.landmarks.sources == ("pictures",)
    assert np.isfinite(cloud.landmarks.table["time"]).all() and cloud.warnings == ()
    assert read_points(tmp_path / "walk", text=False).landmarks is None


@pytest.mark.longer
def test_parts_of_signs_are_not_signs(tmp_path: Path) -> None:
    """Pictures that cut a sign off show a part of it."""
    pytest.importorskip("rapidocr_onnxruntime", exc_type=ImportError)
    poses = [looking(np.pi / 2 + turn, (4.6, 0.9, 1.5)) for turn in (0.3, 0.1, -0.1, -0.7, -0.75)]
    cut = take_picture(poses[-1])[0]
    found = pictures.load_text_reader()
    assert found is not None and {text for _, text, _ in found(cut)} not in ({"Labor 2.114"}, set())
    cloud = read_points(write_corridor(tmp_path / "walk", np.stack(poses), SIGNS))
    assert_hang(cloud.landmarks, (SIGNS[1],))


def test_without_the_package_a_line_says_what_helps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "load_text_reader", lambda: None)
    monkeypatch.setattr(pictures, "load_tag_reader", lambda: None)
    monkeypatch.setattr(pictures, "explain_missing_reader", lambda: "pip install topomerge[text]")
    folder = write_corridor(tmp_path / "walk", walk_poses(4))
    cloud = read_points(folder)
    assert [w for w in cloud.warnings if "topomerge[text]" in w] == [
        "signs on pictures are not read: pip install topomerge[text] (--no-text: without this line)"
    ]
    assert read_points(folder, text=False).warnings == ()
    with pytest.raises(InputError, match=r"--text: .*pip install topomerge\[text\]"):
        read_points(folder, text=True)


def counting_reader(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Stands for the readers: keeps the pictures that it is given."""
    given: list[np.ndarray] = []
    monkeypatch.setattr(pictures, "load_text_reader", lambda: lambda image: given.append(image) or [])
    monkeypatch.setattr(pictures, "load_tag_reader", lambda: None)
    return given


def test_pictures_are_read_where_the_camera_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not while it stands, not blurred ones, not twice from one place, not blank or small ones."""
    given = counting_reader(monkeypatch)
    reader = PictureReader()
    pose = looking(np.pi / 2, (2, 0.6, 1.5))
    image, depth = take_picture(pose)
    step = np.eye(4)
    for x in (0.0, 0.01, 0.1, 0.3, 0.6, 0.61, 0.0, 1.2):
        step[0, 3] = x
        reader.read_frame(Frame("a", depth, CAMERA, step @ pose, done=0.5), depth, image)
    assert len(given) == 3
    smooth = np.repeat(np.linspace(0, 255, 640, dtype=np.uint8)[None, :, None], 480, axis=0).repeat(3, axis=2)
    grey = image.astype(np.float32).mean(axis=2)
    blurred = np.mean([np.roll(grey, k, axis=1) for k in range(-8, 9)], axis=0).astype(np.uint8)[..., None].repeat(3, axis=2)
    assert measure_strongest_edges(blurred.astype(np.float32)[..., 0]) < 0.4 * measure_strongest_edges(grey)
    for k, other in enumerate((smooth, blurred, image[:200, :200])):
        step[0, 3] = 2 + 0.55 * k
        reader.read_frame(Frame("a", depth, CAMERA, step @ pose, done=0.5), depth, other)
    assert len(given) == 3
    step[0, 3] = 9.0  # the camera went far since: better a blurred picture than none
    monkeypatch.setattr(pictures, "LEAST_EDGE", 1.0)
    reader.read_frame(Frame("a", depth, CAMERA, step @ pose, done=0.5), depth, blurred)
    assert len(given) == 4


def test_the_number_of_pictures_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a long walk so many are read, evenly along it."""
    given = counting_reader(monkeypatch)
    monkeypatch.setattr(pictures, "MOST_PICTURES", 40)
    reader = PictureReader()
    pose = looking(np.pi / 2, (2, 0.6, 1.5))
    image, depth = take_picture(pose)
    read_at = []
    for k in range(400):
        pose[0, 3] = 0.6 * k
        reader.read_frame(Frame("a", depth, CAMERA, pose.copy(), done=k / 400), depth, image)
        read_at += [k] * (len(given) > len(read_at))
    assert 60 <= len(given) <= 70
    assert sum(k > 200 for k in read_at) >= 18


def test_large_pictures_are_shrunk() -> None:
    image = np.zeros((2000, 3000, 3), np.uint8)
    image[1000:1020, 1500:1530] = 255
    small, factor = shrink_picture(image)
    assert small.shape == (853, 1280, 3) and factor == pytest.approx(3000 / 1280)
    rows, columns = np.nonzero(small[..., 0] > 100)
    assert columns.mean() * factor == pytest.approx(1515, abs=4) and rows.mean() * factor == pytest.approx(1010, abs=4)


def test_boxes_outside_of_depth_have_no_place() -> None:
    pose = looking(np.pi / 2, (2, 0.6, 1.5))
    image, depth = take_picture(pose)
    box = np.array([(300, 200), (340, 200), (340, 220), (300, 220)], float)
    place = place_box(box, Picture(image, CAMERA, depth, CAMERA, pose))
    assert (
        place is not None and place[0][1] == pytest.approx(SIZE[1], abs=0.01) and place[2] == pytest.approx(-np.pi / 2, abs=0.01)
    )
    for wrong in (box + 5000, box * np.nan, box - 1e12):
        assert place_box(wrong, Picture(image, CAMERA, depth, CAMERA, pose)) is None
    for empty in (np.zeros_like(depth), np.full_like(depth, np.nan), np.full_like(depth, 100.0)):
        assert place_box(box, Picture(image, CAMERA, empty, CAMERA, pose)) is None


TAG_SIDE = 0.32  # m, of the black square of the tags that are drawn


def test_a_square_of_known_size_by_hand() -> None:
    """Corners of a square 3 m away, turned by 40 degrees and tilted by 10, in any order along its outline; twice the size is
    twice as far."""
    image, depth = take_picture(looking(np.pi / 2, (2, 0.6, 1.5)))
    turn, tilt = np.radians(40), np.radians(10)
    x = np.array([np.cos(turn), 0, np.sin(turn)])
    y = np.array([-np.sin(turn) * np.sin(tilt), np.cos(tilt), np.cos(turn) * np.sin(tilt)])
    middle = np.array([0.4, -0.2, 3.0])
    points = middle + 0.1 * np.array([-x - y, x - y, x + y, -x + y])
    corners = points[:, :2] / points[:, 2:] * FOCAL + CENTRE
    pose = np.array([[0, 0, 1, 5], [-1, 0, 0, 6], [0, -1, 0, 7], [0, 0, 0, 1]], float)  # looks along x
    picture = Picture(image, CAMERA, np.zeros_like(depth), CAMERA, pose)
    for order in (corners, np.roll(corners, 1, axis=0), corners[::-1]):
        place = place_square(order, picture, 0.2)
        assert place is not None and np.allclose(place[0], [8.0, 5.6, 7.2], atol=1e-6)
        facing = np.cross(x, y) if np.cross(x, y)[2] < 0 else -np.cross(x, y)
        assert place[2] == pytest.approx(np.arctan2(-facing[0], facing[2]), abs=1e-6) and 0.05 <= place[1] < 0.15
    far = place_square(corners, picture, 0.4)
    assert far is not None and np.allclose(far[0] - pose[:3, 3], 2 * np.array([3.0, -0.4, 0.2]), atol=1e-6)
    for wrong in (corners * np.nan, corners[[0, 0, 0, 0]], corners[[0, 1, 0, 1]], 1e-3 * corners):
        assert place_square(wrong, picture, 0.2) is None
    assert place_square(corners, picture, 1e6) is None


@pytest.mark.longer
def test_tags_of_known_size_need_no_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the depth has holes at the tags, their size tells the place; a wrong size is told by a wrong distance."""
    pytest.importorskip("pupil_apriltags", exc_type=ImportError)
    poses = [looking(angle, (x, 1.2, 1.4)) for angle, x in ((np.pi / 2, 7.3), (np.pi / 2, 8.1), (-np.pi / 2, 6.2))]
    monkeypatch.setattr(pictures, "load_text_reader", lambda: None)
    taken, found = [take_picture(pose) for pose in poses], {}
    for size in (None, TAG_SIDE, 2 * TAG_SIDE):
        reader = PictureReader(tag_size=size)
        for k, (pose, (image, depth)) in enumerate(zip(poses, taken, strict=True)):
            reader.read_frame(Frame("a", np.zeros_like(depth), CAMERA, pose, done=(k + 1) / 3), np.zeros_like(depth), image)
        tags = reader.collect()
        found[size] = tags.select(tags.is_kind("tag"))
    assert not len(found[None]) and reader.unplaced >= 0
    assert_hang(found[TAG_SIDE], TAG_SIGNS, 0.05)
    twice = found[2 * TAG_SIDE]
    y = dict(zip(twice.get_values(), twice.table["position"][:, 1], strict=True))
    assert y["tag36h11:1"] == pytest.approx(3.6, abs=0.1) and y["tag36h11:2"] == pytest.approx(-1.2, abs=0.1)


@pytest.mark.parametrize("size", [0, -1, float("nan"), float("inf"), "wide"])
def test_a_size_that_is_none_is_refused(tmp_path: Path, size: object) -> None:
    with pytest.raises(InputError, match="--tag-size .* can't be used; give a number above 0"):
        read_points(write_corridor(tmp_path / "walk", walk_poses(2), ()), tag_size=size)


def test_normals_face_the_camera() -> None:
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-0.2, 0.2, 9), np.linspace(-0.1, 0.1, 9)))
    wall = np.stack([x, y, 2 + 0.5 * x], axis=1)
    normal = estimate_normal(wall)
    assert normal is not None and normal == pytest.approx(np.array([0.5, 0, -1]) / np.hypot(0.5, 1))
    assert estimate_normal(wall[:5]) is None
    assert estimate_normal(np.random.default_rng(0).uniform(-1, 1, (200, 3)) + (0, 0, 3)) is None
    assert compute_heading(np.array([0.0, -1, 0])) == pytest.approx(-np.pi / 2) and np.isnan(
        compute_heading(np.array([0.0, 0.1, 0.99]))
    )


def seen(value: str, x: float = 0.0, picture: int = 0, **known: float | str) -> Sighting:
    position = np.array([x, 0.0, 1.5])
    return Sighting(**{"kind": "text", "value": value, "position": position, "sigma": 0.1, "picture": picture, **known})  # type: ignore[arg-type]


def test_sightings_of_a_sign_elect_its_text() -> None:
    """Misread ones are outvoted; a stray position does not move it; two signs of one picture are two."""
    shots = [seen("2.113", 0.02 * k, k, confidence=0.9) for k in range(5)]
    shots += [seen("2.1l3", 0.03, 7, confidence=0.7), seen("2.113", 1.2, 8, confidence=0.6)]
    fused = fuse_sightings(shots, "pictures")
    assert fused.get_values().tolist() == ["2.113"]
    assert fused.table["position"][0, 0] == pytest.approx(0.04, abs=0.03)
    assert fused.table["confidence"][0] == pytest.approx(0.9 * 5.1 / 5.8)
    pair = [s for k in range(3) for s in (seen("2.113", 0.0, k), seen("2.114", 0.3, k))]
    assert fuse_sightings(pair, "pictures").get_values().tolist() == ["2.113", "2.114"]
    sides = [seen("WC", 0.0, 0, heading=0.0), seen("WC", 0.05, 1, heading=np.pi)]
    assert len(fuse_sightings(sides, "pictures")) == 2
    assert len(fuse_sightings([seen("EXIT", 0.0, 0), seen("EXIT", 4.0, 1)], "pictures")) == 2
    assert len(fuse_sightings([seen("EXIT", np.nan), seen("EXIT", 1e300)], "pictures")) == 0
    assert len(fuse_sightings([], "pictures")) == 0


def test_many_sightings_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is beyond the bound is not looked at."""
    monkeypatch.setattr(sightings, "MOST_SIGHTINGS", 200)
    fused = fuse_sightings([seen(f"{k}", 3.0 * k, k) for k in range(300)] * 40, "pictures")
    assert fused.get_values().tolist() == [f"{k}" for k in range(200)]


def test_texts_are_cleaned() -> None:
    assert clean_text("  2.113\n\x00\x1b[31m\u202e A\tB ") == "2.113 [31m A B"
    assert clean_text("x" * 10_000) == "x" * LONGEST_TEXT
    assert clean_text("<script>") == "<script>"  # shown, never run: who shows it escapes it
    assert is_legible("2.113", 0.5) and is_legible("WC", 0.95) and not is_legible("WC", 0.6) and not is_legible("-.-", 1.0)
    assert (
        count_edits("2.113", "2.1l3") == 1 and count_edits("", "abc") == 3 and count_edits("114", "Labor 2.114", within=True) == 0
    )
