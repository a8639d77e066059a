"""Maps whose thresholds, colours or noise make floor of what nobody saw."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from topomerge.errors import InputError
from topomerge.io import grid, read_points
from topomerge.io.floor_masks import is_inverted, measure_outside_share

CELL = 0.05  # m a pixel
WALL, FLOOR, UNKNOWN = 0, 254, 205


def two_rooms(unknown: int = UNKNOWN, floor: int = FLOOR, margin: int = 60) -> np.ndarray:
    """A picture (h, w) of two rooms of 4 m by 5 m with a doorway, in the midst of what nobody saw."""
    picture = np.full((100 + 2 * margin, 162 + 2 * margin), unknown, np.uint8)
    inner = picture[margin : margin + 100, margin : margin + 162]
    inner[:] = WALL
    inner[1:-1, 1:80] = inner[1:-1, 82:-1] = floor
    inner[40:60, 80:82] = floor
    return picture


def write(folder: Path, picture: np.ndarray, name: str = "map.pgm", text: str = "", **saving: object) -> Path:
    Image.fromarray(picture).save(folder / name, **saving)  # type: ignore[arg-type]
    path = folder / "map.yaml"
    path.write_text(f"image: {name}\nresolution: {CELL}\norigin: [0, 0, 0]\n{text}")
    return path


def read(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    return grid.read_pixels(path, grid.read_yaml(path))


@pytest.mark.parametrize("unknown", [128, 178, 194, 200, 205, 206, 230])
@pytest.mark.parametrize("threshold", [0.1, 0.196, 0.25, 0.4, 0.52])
def test_the_grey_of_unknown_is_unknown(tmp_path: Path, unknown: int, threshold: float) -> None:
    picture = two_rooms(unknown)
    occupied, free, said = read(write(tmp_path, picture, text=f"free_thresh: {threshold}\n"))
    np.testing.assert_array_equal(free, picture == FLOOR)
    np.testing.assert_array_equal(occupied, picture == WALL)
    if 1 - unknown / 255 < threshold:
        (warning,) = said
        assert warning.startswith(f"map.pgm: its grey of unknown ({unknown}) counts as floor by free_thresh {threshold:g} and")
        written = warning.split("write free_thresh: ")[1].removesuffix(" into map.yaml")
        mended = write(tmp_path, picture, text=f"free_thresh: {written}\n")
        assert read(mended)[2] == () and (read(mended)[1] == free).all()
    else:
        assert said == ()


def test_a_negated_picture_and_one_of_16_bits(tmp_path: Path) -> None:
    picture = two_rooms()
    _, free, said = read(write(tmp_path, 255 - picture, text="negate: 1\nfree_thresh: 0.25\n"))
    np.testing.assert_array_equal(free, picture == FLOOR)
    assert len(said) == 1
    _, free, said = read(write(tmp_path, picture.astype(np.uint16) * 257, "map.png", "free_thresh: 0.3\n"))
    np.testing.assert_array_equal(free, picture == FLOOR)
    assert len(said) == 1


def test_numbers_that_are_none_are_unknown(tmp_path: Path) -> None:
    picture = two_rooms().astype(np.float32)
    picture[picture == UNKNOWN] = np.nan
    picture[0, :5] = np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        occupied, free, said = read(write(tmp_path, picture, "map.tif"))
        np.testing.assert_array_equal(occupied, picture == WALL)
        np.testing.assert_array_equal(free, picture == FLOOR)
        assert said == ()
        with pytest.raises(InputError, match="shows neither floor nor walls"):
            read(write(tmp_path, np.full((9, 9), np.nan, np.float32), "map.tif"))


def test_transparent_pixels_are_not_counted(tmp_path: Path) -> None:
    picture = two_rooms()
    rgba = np.dstack([picture] * 3 + [np.full_like(picture, 255)])
    rgba[:, :100, 3] = 0
    _, free, said = read(write(tmp_path, rgba, "map.png", "free_thresh: 0.25\n"))
    np.testing.assert_array_equal(free, (picture == FLOOR) & (rgba[..., 3] > 0))
    assert len(said) == 1


@pytest.mark.parametrize("mode", ["scale", "raw"])
def test_other_modes_are_left_to_the_thresholds(tmp_path: Path, mode: str) -> None:
    """There the greys are probabilities, whatever they are."""
    path = write(tmp_path, two_rooms(20 if mode == "raw" else UNKNOWN, 0 if mode == "raw" else FLOOR), text=f"mode: {mode}\n")
    path.write_text(path.read_text() + "free_thresh: 0.25\n")
    plan = grid.read_yaml(path)
    _, free = grid.classify(grid.read_image(plan.image), plan)
    np.testing.assert_array_equal(read(path)[1], free)


def test_light_grey_rooms_on_white_paper_are_floor(tmp_path: Path) -> None:
    """The white around the building is not less known than the fill of its rooms."""
    picture = two_rooms(unknown=255, floor=225)
    _, free, said = read(write(tmp_path, picture, "map.png"))
    np.testing.assert_array_equal(free, picture != WALL)
    assert len(said) == 1 and "lies outside of every wall" in said[0]


@pytest.mark.parametrize("quality", [95, 75, 50, 30])
@pytest.mark.parametrize("unknown", [127, 194, 205])
@pytest.mark.parametrize("threshold", [0.196, 0.25])
def test_noise_of_jpeg_is_no_floor(tmp_path: Path, quality: int, unknown: int, threshold: float) -> None:
    picture = two_rooms(unknown)
    picture[::23, :50] = WALL  # noise stands beside walls
    path = write(tmp_path, picture, "map.jpg", f"free_thresh: {threshold}\n", quality=quality)
    occupied, free, _ = read(path)
    wrong = (free != (picture == FLOOR)).sum()
    assert wrong <= 0.01 * (picture == FLOOR).sum()
    assert (occupied != (picture == WALL)).sum() <= 0.02 * (picture == WALL).sum()


def test_a_jpeg_of_two_values_stays_as_the_thresholds_have_it(tmp_path: Path) -> None:
    path = write(tmp_path, two_rooms(unknown=255, floor=255), "map.jpg", quality=60)
    plan = grid.read_yaml(path)
    _, free = grid.classify(grid.read_image(plan.image), plan)
    np.testing.assert_array_equal(read(path)[1], free)


def test_noise_of_a_jpeg_saved_as_png(tmp_path: Path) -> None:
    picture = two_rooms()
    picture[::7, :50] = WALL
    Image.fromarray(picture).save(tmp_path / "map.jpg", quality=92)
    noisy = np.asarray(Image.open(tmp_path / "map.jpg"))
    _, free, said = read(write(tmp_path, noisy, "map.png"))
    np.testing.assert_array_equal(free, picture == FLOOR)
    assert len(said) == 1 and "of the floor around its grey of unknown (205)" in said[0]


def test_a_few_smoothed_edges_stay(tmp_path: Path) -> None:
    picture = two_rooms()
    rows, columns = np.nonzero(picture == FLOOR)
    picture[rows[::80], columns[::80]] = np.linspace(207, 245, len(rows[::80])).astype(np.uint8)
    path = write(tmp_path, picture)
    plan = grid.read_yaml(path)
    np.testing.assert_array_equal(read(path)[1], grid.classify(grid.read_image(plan.image), plan)[1])


@pytest.mark.parametrize("unknown", [127, 128])
@pytest.mark.parametrize("name", ["map.pgm", "map.jpg"])
@pytest.mark.parametrize("threshold", [0.196, 0.25, 0.49])
def test_probabilities_stay(tmp_path: Path, unknown: int, name: str, threshold: float) -> None:
    """Cartographer writes how likely each cell is a wall: what is nearly as likely as not stays floor if the file says so."""
    rng = np.random.default_rng(3)
    picture = two_rooms(unknown)
    floor, wall = picture == FLOOR, picture == WALL
    picture[floor] = 255 * (1 - np.clip(rng.beta(2, 10, floor.sum()), 0.02, 0.48))
    picture[wall] = 255 * (1 - rng.uniform(0.52, 0.98, wall.sum()))
    path = write(tmp_path, picture, name, f"free_thresh: {threshold}\noccupied_thresh: 0.51\n")
    plan = grid.read_yaml(path)
    occupied, free, said = read(path)
    assert (occupied == grid.classify(grid.read_image(plan.image), plan)[0]).all()
    assert (free == grid.classify(grid.read_image(plan.image), plan)[1]).all() and said == ()


@pytest.mark.parametrize("angle", [0, 30])
def test_floor_outside_of_walls_is_told(tmp_path: Path, angle: int) -> None:
    """A yard around the building, white like its floor."""
    turned = Image.fromarray(two_rooms(FLOOR, margin=90)).rotate(angle, fillcolor=FLOOR)
    (warning,) = read(write(tmp_path, np.asarray(turned)))[2]
    assert warning.startswith("map.pgm: ") and "% of the floor lies outside of every wall; " in warning
    inside = two_rooms()
    assert measure_outside_share(inside == WALL, inside == FLOOR) == 0


def test_large_pictures_are_looked_at_in_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    picture = two_rooms(FLOOR)
    whole = measure_outside_share(picture == WALL, picture == FLOOR)
    monkeypatch.setattr("topomerge.io.floor_masks.SAMPLED_PIXELS", 6000)
    assert measure_outside_share(picture == WALL, picture == FLOOR) == pytest.approx(whole, abs=0.05)


def outside_by_hand(occupied: np.ndarray, free: np.ndarray) -> float:
    """The slow and obvious twin: walk from every free pixel in eight directions."""
    few = 0
    for row, column in np.argwhere(free):
        met = 0
        for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            y, x = row, column
            while 0 <= y < len(free) and 0 <= x < free.shape[1] and not occupied[y, x]:
                y, x = y + dy, x + dx
            met += 0 <= y < len(free) and 0 <= x < free.shape[1]
        few += met <= 4
    return few / free.sum()


def test_directions_are_those_of_its_twin() -> None:
    rng = np.random.default_rng(0)
    for shape in ((13, 21), (17, 9)):
        values = rng.random(shape)
        occupied, free = values < 0.08, values > 0.4
        assert measure_outside_share(occupied, free) == pytest.approx(outside_by_hand(occupied, free))


@pytest.mark.parametrize("values", [(0, 205, 254), (0, 255, 255), (0, 127, 255)])
def test_inverted_colours_are_named(tmp_path: Path, values: tuple[int, int, int]) -> None:
    wall, unknown, floor = values
    picture = two_rooms(unknown, floor)
    picture[picture == WALL] = wall
    occupied, free, said = read(write(tmp_path, 255 - picture))
    assert "of the picture counts as wall; are its colours inverted? set negate: 1" in said[-1]
    assert is_inverted(occupied, free, CELL)
    _, _, said = read(write(tmp_path, picture, text="negate: 1\n"))
    assert said[-1].endswith("set negate: 0")
    Image.fromarray(255 - picture).save(tmp_path / "plain.png")
    told = "give a yaml of map_server with negate: 1" if unknown != floor else "turned into dark lines on light paper"
    assert any(told in w for w in read_points(tmp_path / "plain.png", resolution=CELL, text=False).warnings)


def test_a_building_in_solid_black_is_not_inverted(tmp_path: Path) -> None:
    picture = two_rooms(unknown=WALL)
    occupied, free, said = read(write(tmp_path, picture))
    assert occupied.mean() > 0.5 and not is_inverted(occupied, free, CELL) and said == ()


def test_a_picture_without_floor_and_walls_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, np.full((20, 20), UNKNOWN, np.uint8))
    with pytest.raises(InputError, match=r"map\.yaml: shows neither floor nor walls .*mend thresholds, negate or mode$"):
        read_points(path)


@pytest.mark.parametrize("yaw", ["-nan", "nan", ".nan", ".NaN", "-NaN"])
def test_a_yaw_that_is_no_number_is_no_turn(tmp_path: Path, yaw: str) -> None:
    path = write(tmp_path, two_rooms())
    plain = read_points(path)
    path.write_text(path.read_text().replace("[0, 0, 0]", f"[0, 0, {yaw}]"))
    cloud = read_points(path)
    np.testing.assert_array_equal(cloud.points, plain.points)
    (warning,) = cloud.warnings
    assert warning.startswith("map.yaml: the yaw of its origin is ") and warning.endswith("was read as 0; write 0 in its place")


@pytest.mark.parametrize("origin", ["[-nan, 0, 0]", "[0, nan, 0]", "[0, 0, inf]", "[0, 0, north]", "[0, 0, null]"])
def test_other_origins_that_are_no_numbers_are_refused(tmp_path: Path, origin: str) -> None:
    path = write(tmp_path, two_rooms())
    path.write_text(path.read_text().replace("[0, 0, 0]", origin))
    with pytest.raises(InputError, match=r"origin is .* instead of a number; mend it"):
        read_points(path)


@pytest.mark.longer
@pytest.mark.data
def test_cases_of_strangers(case_dir: Path) -> None:
    """A map of Nav2, one map as JPEG and as PNG, a yaw of nan, inverted colours."""
    robocup = case_dir / "nav2-free-thresh" / "robocup.yaml"
    _, free, said = read(robocup)
    assert 80 <= free.sum() * CELL**2 <= 95 and len(said) == 1  # the laboratory has 92 m2
    assert "counts as floor by free_thresh 0.25 and was read as unknown; write free_thresh: 0.1 into robocup.yaml" in said[0]
    noisy, clean = (read(case_dir / "jpeg-map" / f"level5_hokuyo{n}.yaml") for n in ("", "_same_map"))
    for one, other in zip(noisy[:2], clean[:2], strict=True):
        (top, left), (y, x) = np.argwhere(one).min(axis=0), np.argwhere(other).min(axis=0)
        height, width = np.argwhere(other).max(axis=0) + 1 - (y, x)
        np.testing.assert_array_equal(one[top : top + height, left : left + width], other[y : y + height, x : x + width])
        assert one.sum() == other.sum()
    assert len(read(case_dir / "nan-yaw" / "map.yaml")[2]) == 0
    assert "'-nan' and was read as 0" in read_points(case_dir / "nan-yaw" / "map.yaml").warnings[0]
    assert (
        "98% of the picture counts as wall; are its colours inverted? set negate: 1"
        in read(case_dir / "inverted" / "inverted.yaml")[2][-1]
    )


@pytest.mark.data
@pytest.mark.parametrize(("name", "least", "most"), [("eng2-8f", 0.1, 0.2), ("eng2-2f", 0.2, 0.3), ("eng2-7f_raw", 0.1, 0.2)])
def test_real_storeys_are_not_drowned_in_floor(data_dir: Path, name: str, least: float, most: float) -> None:
    """Their editor saved unknown as 206, which free_thresh 0.196 takes for floor."""
    assert least < read(data_dir / "storeys_jsk" / f"{name}.yaml")[1].mean() < most


def test_walls_washed_out_by_scaling_are_walls(tmp_path: Path) -> None:
    picture = two_rooms()
    small = np.asarray(Image.fromarray(picture).resize((picture.shape[1] // 2, picture.shape[0] // 2), Image.Resampling.BOX))
    small = np.where(small == (WALL + UNKNOWN + 1) // 2, 130, small)
    occupied, free, _ = read(write(tmp_path, small, name="small.png"))
    assert ndimage.label(free)[1] == 1 and not (occupied & free).any()
    outside, _ = ndimage.label(~occupied)
    assert outside[0, 0] != outside[small.shape[0] // 2, small.shape[1] // 2]  # no way leads out through the walls


def test_grey_areas_and_rims_of_walls_stay_unknown(tmp_path: Path) -> None:
    picture = two_rooms()
    picture[10:20, 10:30] = 120  # painted by hand
    picture[59, 60:222] = 140  # along the outer side of a black wall
    occupied, _, _ = read(write(tmp_path, picture))
    np.testing.assert_array_equal(occupied, picture == WALL)
