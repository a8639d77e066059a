"""Floor plans and OctoMaps: frames, thresholds, trees."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image
from topomerge.datasets.plans import grid as plan_grid

from tests.samples import FULL_OCTOMAP_HEADER, full_node, octomap_node, write_octomap
from topomerge.errors import InputError
from topomerge.io import grid, read_points

FREE_PIXEL, WALL_PIXEL, UNKNOWN_PIXEL = 254, 0, 205


def write_map(folder: Path, pixels: list[list[int]], *, text: str = "", suffix: str = ".pgm", **values: object) -> Path:
    said = {"image": f"map{suffix}", "resolution": 0.5, "origin": [0.0, 0.0, 0.0], "negate": 0} | values
    Image.fromarray(np.array(pixels, np.uint8)).save(folder / f"map{suffix}")
    path = folder / "map.yaml"
    path.write_text("".join(f"{k}: {v}\n" for k, v in said.items()) + text)
    return path


def floor_and_walls(path: Path, **options: object) -> tuple[set[tuple[float, ...]], set[tuple[float, ...]]]:
    """(x, y) of floor points and of wall points, rounded to millimetres."""
    points = np.round(read_points(path, **options).points.astype(float), 3) + 0.0  # type: ignore[arg-type]
    tall = {tuple(p[:2]) for p in points.tolist() if p[2] > 0}
    return {tuple(p[:2]) for p in points.tolist()} - tall, tall


def test_the_origin_is_the_lower_left_corner(tmp_path: Path) -> None:
    path = write_map(tmp_path, [[WALL_PIXEL, UNKNOWN_PIXEL], [FREE_PIXEL, FREE_PIXEL]], origin=[10.0, 20.0, 0.0])
    floor, walls = floor_and_walls(path)
    assert floor == {(10.25, 20.25), (10.75, 20.25)}
    assert walls == {(10.25, 20.75)}


def test_yaw_turns_about_the_origin(tmp_path: Path) -> None:
    path = write_map(tmp_path, [[WALL_PIXEL, UNKNOWN_PIXEL], [FREE_PIXEL, FREE_PIXEL]], origin=[10.0, 20.0, np.pi / 2])
    floor, walls = floor_and_walls(path)
    assert floor == {(9.75, 20.25), (9.75, 20.75)}
    assert walls == {(9.25, 20.25)}


def test_negate_swaps_black_and_white(tmp_path: Path) -> None:
    path = write_map(tmp_path, [[255, 0]], negate=1)
    floor, walls = floor_and_walls(path)
    assert (floor, walls) == ({(0.75, 0.25)}, {(0.25, 0.25)})


def test_thresholds_are_open_and_the_usual_grey_is_unknown(tmp_path: Path) -> None:
    # 205 is (255 - 205) / 255 = 0.19608, just above the usual free_thresh of 0.196
    path = write_map(tmp_path, [[205, 206, 89, 90]], occupied_thresh=0.65, free_thresh=0.196)
    floor, walls = floor_and_walls(path)
    assert (floor, walls) == ({(0.75, 0.25)}, {(1.25, 0.25)})


def test_raw_mode_reads_percent(tmp_path: Path) -> None:
    path = write_map(tmp_path, [[0, 50, 100, 255]], mode="raw", occupied_thresh=0.65, free_thresh=0.196)
    floor, walls = floor_and_walls(path)
    assert (floor, walls) == ({(0.25, 0.25)}, {(1.25, 0.25)})


def test_transparent_pixels_are_unknown(tmp_path: Path) -> None:
    rgba = np.zeros((1, 3, 4), np.uint8)
    rgba[0, 0], rgba[0, 1], rgba[0, 2] = (0, 0, 0, 255), (255, 255, 255, 255), (0, 0, 0, 0)
    Image.fromarray(rgba).save(tmp_path / "map.png")
    floor, walls = floor_and_walls(tmp_path / "map.png", resolution=0.5)
    assert (floor, walls) == ({(0.75, 0.25)}, {(0.25, 0.25)})


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "I;16"])
def test_images_of_many_kinds(tmp_path: Path, mode: str) -> None:
    grey = Image.fromarray(np.array([[0, 255]], np.uint8))
    if mode == "I;16":
        grey = Image.fromarray(np.array([[0, 65535]], np.uint16))
    else:
        grey = grey.convert(mode)
    grey.save(tmp_path / "map.png")
    assert floor_and_walls(tmp_path / "map.png", resolution=0.5) == ({(0.75, 0.25)}, {(0.25, 0.25)})


def test_walls_ceiling_and_spacing(tmp_path: Path) -> None:
    path = write_map(tmp_path, [[WALL_PIXEL, FREE_PIXEL]], resolution=0.1)
    points = read_points(path, extrude=2.0).points
    np.testing.assert_allclose(points[points[:, 0] < 0.1, 2], np.linspace(0, 2, 21), atol=1e-6)
    assert len(points) == 21 + 1
    closed = read_points(path, extrude=2.0, ceiling=True).points
    assert closed[closed[:, 0] > 0.1, 2].tolist() == [0, 2]
    fine = read_points(path, extrude=2.0, spacing=0.05).points
    assert len(fine) == 4 * 41 + 4
    assert len(np.unique(fine[:, 0])) == 4
    doubled = read_points(path, extrude=2.0, scale=2.0).points
    assert doubled[:, 2].max() == 2.0 and doubled[:, 0].max() == pytest.approx(0.3)


@pytest.mark.parametrize("named", ["map.pgm", "/home/robot/maps/map.pgm", "C:\\maps\\map.pgm", "other.pgm"])
def test_the_image_is_found_beside_the_yaml(tmp_path: Path, named: str) -> None:
    path = write_map(tmp_path, [[WALL_PIXEL, FREE_PIXEL]], suffix=".png")
    path.write_text(path.read_text().replace("map.png", named))
    (warning,) = read_points(path).warnings
    assert "map.png beside it was read" in warning


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("resolution: nan\n", "resolution is 'nan'"),
        ("resolution: -1\n", "can't be used"),
        ("resolution: [1]\n", "instead of a number"),
        ("origin: 3\n", "origin is 3"),
        ("origin: [1, x, 0]\n", "instead of a number"),
        ("mode: fast\n", "can't be used"),
        ("negate: 7\n", "can't be used"),
        ("image: none.pgm\n", ""),
        ("a: [\n", "damaged"),
        ("a: &a [*a]\n", ""),
    ],
)
def test_bad_map_files_are_named(tmp_path: Path, text: str, says: str) -> None:
    path = write_map(tmp_path, [[WALL_PIXEL, FREE_PIXEL]], text=text)
    if not says:
        read_points(path)  # the last image is found by the yaml's stem, and other keys don't matter
        return
    with pytest.raises(InputError, match=says):
        read_points(path)


def test_yaml_that_is_no_map_and_maps_without_image(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("- 1\n- 2\n")
    with pytest.raises(InputError, match="not a map_server file"):
        read_points(tmp_path / "a.yaml")
    (tmp_path / "a.yaml").write_text("image: a.pgm\nresolution: 0.05\n")
    with pytest.raises(InputError, match=r"its image a\.pgm does not exist"):
        read_points(tmp_path / "a.yaml")


@pytest.mark.parametrize("data", [b"\x89PNG\xff\xfe\x00", b"image: a\x00.png\n", "resolution: é".encode("latin-1")])
def test_yaml_that_is_no_text(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_points(path)
    assert str(caught.value) == f"{path}: is no text; give the yaml that names the image"


POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 20 20\n%%EndComments\nshowpage\n%%EOF\n"


def test_a_picture_starts_no_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """PostScript under the name of a picture: Pillow would hand it to Ghostscript."""
    started = []
    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *a, **k: started.append(a) or Image.new("RGB", (20, 20)).im)
    path = tmp_path / "plan.png"
    path.write_bytes(POSTSCRIPT)
    with pytest.raises(InputError, match="is not an image of PPM, PNG, JPEG, BMP, TIFF") as caught:
        read_points(path, resolution=0.1)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)
    (tmp_path / "plan.yaml").write_text("image: plan.png\nresolution: 0.1\n")
    with pytest.raises(InputError, match=r"plan\.png: is not an image"):
        read_points(tmp_path / "plan.yaml")
    with pytest.raises(InputError, match=r"damaged image: plan\.png"):
        plan_grid._read_image(path)
    assert not started


@pytest.mark.parametrize("kind", grid.IMAGE_FORMATS)
def test_the_content_tells_the_format(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "plan.png"
    Image.fromarray(np.full((4, 5), FREE_PIXEL, np.uint8)).save(path, format=kind)
    bright, _ = grid.read_image(path)
    assert bright.shape == (4, 5) and (bright > 0.98).all()


def test_an_image_needs_a_resolution_and_a_map_has_one(samples: dict[str, Path]) -> None:
    with pytest.raises(InputError, match=r"give --resolution .*or read plan\.yaml instead"):
        read_points(samples["plan.yaml"].with_suffix(".pgm"))
    with pytest.raises(InputError, match="leave --resolution out"):
        read_points(samples["plan.yaml"], resolution=0.1)


def test_huge_images_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.pgm").write_bytes(b"P5\n100000 100000\n255\n" + bytes(100))
    with pytest.raises(InputError, match="too many pixels|limit is 200 megapixels"):
        read_points(tmp_path / "a.pgm", resolution=0.1)
    monkeypatch.setattr(grid, "PIXELS", 10)
    Image.new("L", (5, 5)).save(tmp_path / "b.png")
    with pytest.raises(InputError, match="5 x 5 pixels"):
        read_points(tmp_path / "b.png", resolution=0.1)


def leaves_by_hand(data: bytes, keys: tuple[int, int, int], depth: int, at: list[int]) -> list[tuple[int, int, int, int, int]]:
    """(x, y, z, depth, state) of each leaf: the slow and obvious twin of the compiled walk."""
    bits = data[at[0]] + 256 * data[at[0] + 1]
    at[0] += 2
    leaves = []
    for child in range(8):
        state = bits // 4**child % 4
        side = 2 ** (15 - depth)
        corner = (keys[0] + child % 2 * side, keys[1] + child // 2 % 2 * side, keys[2] + child // 4 * side)
        if state == 3:
            leaves += leaves_by_hand(data, corner, depth + 1, at)
        elif state:
            leaves.append((*corner, depth + 1, state))
    return leaves


def test_the_compiled_walk_equals_its_twin() -> None:
    from topomerge.kernels.codecs import read_octree_leaves

    rng = np.random.default_rng(0)

    def tree(depth: int) -> bytes:
        states = rng.integers(0, 4 if depth < 15 else 3, 8).tolist()
        if depth < 6:
            states[int(rng.integers(8))] = 3
        else:
            states = [s if s < 3 else 2 for s in states]
        return octomap_node(states) + b"".join(tree(depth + 1) for s in states if s == 3)

    data = tree(0)
    keys, depths, states = read_octree_leaves(np.frombuffer(data, np.uint8)) or ([], [], [])
    leaves = sorted((*k, d, s) for k, d, s in zip(np.asarray(keys).tolist(), depths, states, strict=True))
    assert leaves == sorted(leaves_by_hand(data, (0, 0, 0), 0, [0]))


def test_a_small_octomap(tmp_path: Path) -> None:
    # Down along the child that touches the origin of coordinates from above, to a node of two smallest cells a side.
    top = octomap_node([0, 0, 0, 0, 0, 0, 0, 3])
    inner = octomap_node([3, 0, 0, 0, 0, 0, 0, 0])
    last = octomap_node([2, 1, 0, 0, 0, 0, 0, 2])
    write_octomap(tmp_path / "a.bt", top + inner * 13 + octomap_node([3, 0, 1, 0, 0, 0, 0, 0]) + last, 20)
    cloud = read_points(tmp_path / "a.bt")
    np.testing.assert_allclose(sorted(cloud.points.tolist()), [[0.05, 0.05, 0.05], [0.15, 0.15, 0.15]], atol=1e-6)
    assert cloud.free is not None and cloud.free.edge == pytest.approx(0.1)
    centres = {tuple(c) for c in np.round(cloud.free.compute_centroids(), 3).tolist()}
    large = {
        (round(0.05 + 0.1 * i, 3), round(0.25 + 0.1 * j, 3), round(0.05 + 0.1 * k, 3))
        for i in (0, 1)
        for j in (0, 1)
        for k in (0, 1)
    }
    assert centres == {(0.15, 0.05, 0.05)} | large


def test_octomaps_that_would_explode(tmp_path: Path) -> None:
    write_octomap(tmp_path / "a.bt", octomap_node([2, 2, 0, 0, 0, 0, 0, 0]), 3)
    with pytest.raises(InputError, match="occupied cells"):
        read_points(tmp_path / "a.bt")
    small = octomap_node([3, 0, 0, 0, 0, 0, 0, 1]) + octomap_node([3, 0, 0, 0, 0, 0, 0, 0]) * 14 + octomap_node([2] * 8)
    write_octomap(tmp_path / "a.bt", small, 25)
    cloud = read_points(tmp_path / "a.bt")
    assert cloud.free is None and len(cloud) == 8
    assert any("free space is left out" in w for w in cloud.warnings)


def as_full(data: bytes, at: list[int], rng: np.random.Generator, more: bytes) -> bytes:
    """The nodes of a binary tree from a place on, as those of a full tree."""
    bits = int.from_bytes(data[at[0] : at[0] + 2], "little")
    at[0] += 2
    states = [(bits >> (2 * child)) & 3 for child in range(8)]
    out = full_node(0.5, sum(1 << child for child, state in enumerate(states) if state), more)
    inner = [as_full(data, at, rng, more) for state in states if state == 3]
    for state in states:
        sure = float(rng.uniform(0, 3))
        leaf = full_node(-sure - 1e-3 if state == 1 else sure, 0, more)
        out += inner.pop(0) if state == 3 else leaf if state else b""
    return out


@pytest.mark.parametrize(("kind", "more"), [("OcTree", b""), ("ColorOcTree", b"rgb")])
def test_a_full_octomap_is_the_binary_one(tmp_path: Path, kind: str, more: bytes) -> None:
    """The same cells and the same free space; damaged, it is refused."""
    down = octomap_node([0, 0, 0, 0, 0, 0, 0, 3]) + octomap_node([3, 0, 0, 0, 0, 0, 0, 0]) * 12
    inner = (octomap_node(states) for states in ([3, 0, 1, 2, 0, 0, 3, 0], [3, 1, 0, 2, 0, 0, 0, 0]))
    data = down + b"".join(inner) + octomap_node([2, 1, 0, 0, 1, 0, 0, 2]) + octomap_node([0, 1, 2, 0, 0, 0, 0, 0])
    write_octomap(tmp_path / "a.bt", data, 30)
    head = FULL_OCTOMAP_HEADER.replace(b"id OcTree", f"id {kind}".encode())
    nodes = as_full(data, [0], np.random.default_rng(0), more)
    (tmp_path / "a.ot").write_bytes(head + nodes)
    binary, full = read_points(tmp_path / "a.bt"), read_points(tmp_path / "a.ot")
    np.testing.assert_array_equal(np.unique(full.points, axis=0), np.unique(binary.points, axis=0))
    assert full.free is not None and binary.free is not None and len(full) == len(binary) > 0
    np.testing.assert_array_equal(full.free.cells, binary.free.cells)
    wrong = {
        "cut": head + nodes[:-1],
        "more": head + nodes + b"\0",
        "nan": head + struct.pack("<f", np.nan) + nodes[4:],
        "kind": head.replace(b"id " + kind.encode(), b"id CountingOcTree") + nodes,
        "binary": (tmp_path / "a.bt").read_bytes(),
    }
    says = dict.fromkeys(("cut", "more", "nan"), "its tree does not end") | {
        "kind": "only OcTree and ColorOcTree",
        "binary": "not a full OctoMap",
    }
    for name, broken in wrong.items():
        (tmp_path / "a.ot").write_bytes(broken)
        with pytest.raises(InputError, match=says[name]):
            read_points(tmp_path / "a.ot")


def test_zero_log_odds_are_occupied(tmp_path: Path) -> None:
    """Octomap's threshold is a probability of 0.5; a child that is not there is unknown."""
    leaves = b"".join(full_node(odds, 0) for odds in (0.0, -0.0, -1e-6, 3.5))
    (tmp_path / "a.ot").write_bytes(FULL_OCTOMAP_HEADER + full_node(0, 1) * 15 + full_node(0, 0b10111) + leaves)
    cloud = read_points(tmp_path / "a.ot")
    assert len(cloud) == 3 and cloud.free is not None and len(cloud.free) == 1


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, 3), (8, 1)])
@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_a_photograph_is_read_as_its_camera_was_held(tmp_path: Path, suffix: str, orientation: int, turns: int) -> None:
    picture = np.full((64, 96, 3), 255, np.uint8)
    picture[8:24, 16:80] = 0
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(picture).save(tmp_path / f"a.{suffix}", exif=exif)
    upright = np.rot90(picture, turns)
    seen, (bright, _) = grid.read_picture(tmp_path / f"a.{suffix}"), grid.read_image(tmp_path / f"a.{suffix}")
    assert seen.shape == upright.shape and ((seen > 127) == (upright > 127)).all()
    assert ((bright > 0.5) == (upright[..., 0] > 127)).all()
