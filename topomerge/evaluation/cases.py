"""Sets of maps that rooms are measured on. Only `dev` may be developed on: the others are test buildings."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from topomerge.evaluation.scans import Case

TEST = 900_000  # the first test seed of procedural buildings
BUILDING_KINDS = ("office", "openplan", "apartment", "hotel", "hospital", "school", "lab", "house")
CASE_SENSORS = ("tls", "lidar", "depth", "tablet", "mono", "laser2d")
ROOM_NUMBERS = 8  # that are visited, of the larger ones
IPA = ("Freiburg52_scan", "Freiburg101_scan", "lab_a_scan", "lab_b_scan", "lab_c_scan", "lab_d_scan", "lab_f_scan", "lab_ipa")
BARE = {"furniture": 0.0, "clutter": 0.0}
HARD: dict[str, tuple[dict[str, float], str]] = {  # set -> difficulty, and what is done to the points
    "ordinary": ({}, ""),
    "half of the lintels": ({"lintels": 0.5}, ""),
    "no lintels": ({"lintels": 0.0}, ""),
    "mixed ceilings": ({"ceiling_spread": 0.5, "slopes": 0.3}, ""),
    "nothing above 2 m": ({}, "below2"),
    "lamps and pillars": ({"lamps": 1.0, "beams": 0.5, "columns": 1.0}, ""),
    "crammed": ({"furniture": 2.0, "clutter": 1.0}, ""),
    "5 % of the points": ({}, "sparse"),
    "4 cm noise": ({}, "noise"),
    "drift": ({}, "drift"),
    "glass": ({"glass": 0.6}, ""),
}
HOMES = (
    "1c_1096_areacleanup",
    "1c_1096_virtualwall_and_forbidden_zone",
    "S5_FW2008_with_segments",
    "S6_FW2652_with_active_segment_and_no_mop_zone",
    "converted_3790",
    "d9_1058_with_custom_named_segments",
    "d9_1093_huge",
    "l10su_1058_goto_target",
    "l10su_1121_new_path",
    "misc_monastery_with_cutoff",
    "viomi_v6_41_virtual_restrictions_and_active_zones",
    "x10plus_1104_with_obstacle",
    "z10_1056_virtual_restrictions",
)
TSC = "grids_rose2_homes_strands"
LOOK = (
    "octomap_freiburg078/fr_078_tidyup.bt",
    "ipad_lidar_rooms/pix4d_database/808_db.ply",
    "ipad_lidar_rooms/pix4d_user/470_user.ply",
    "ipad_lidar_rooms/user/808-60.ply",
    f"{TSC}/strands_maps/strands_maps/tsc_y3/maps/tsc20160523.yaml",
    f"{TSC}/strands_morse/aachen/UMIC_first_floor.yaml",
    f"{TSC}/strands_morse/g4s/g4s_y2.yaml",
)

# Places told apart by eye on robots' grids for development, m: fans of rays behind windows and doors, rooms in which the robot
# stood (or that were drawn after it), and letters painted on the map.
MARKS: dict[str, dict[str, tuple[tuple[float, float], ...]]] = {
    f"{TSC}/strands_maps/strands_maps/tsc_y3/maps/tsc20160523.yaml": {
        "fan": ((1.5, 31.7), (-12.8, 22), (-11, 10.5), (-12.8, 1.2), (-12.6, 0.2), (-9.5, 0.8), (-20.2, -6.1), (-17.1, -6.4),
                (-26.2, -6.3), (-49.7, 4.4), (-51.1, 3.1), (-40.7, 1.2), (-61.7, -37.6), (-63.9, -10.9), (-58.5, -17.9),
                (-62.2, -20.5), (-72.2, -23.1), (-68.4, -22.6), (-64.6, -26.1), (-61.9, -28), (-60.1, -22.9), (-58.6, -37.1),
                (-50.9, -47.1), (-12.2, -26.4), (-13.8, -23.6), (-6, -28), (-5.7, -23.8), (-2.2, -27.8), (-0.5, -24.3), (1.2,
                -24.3), (4.3, -20.6), (-63.2, -9.2), (8.8, 16.8), (9.2, 13.6), (-24.1, -5.5),),
        "room": ((-53.6, -33.8), (-50.8, -8.6), (-46, -29.2), (-51, -17.9), (-1, 9.5), (-12.4, -18), (-45.4, -1), (-6, 24.7),
                (-42.5, -15.8), (-17.9, -11.1), (-55.6, -22), (-2.5, -10), (2.8, 4.9), (-2.7, -18.9), (-1, 28.7), (-34.8,
                -11.2), (-28.4, -10.4), (-8.7, -10.2), (1.8, -2.3), (-5.8, -4.6), (0, -5.6), (-0.4, -11.6), (-0.2, -16.9),),
    },
    f"{TSC}/strands_morse/aachen/UMIC_first_floor.yaml": {
        "fan": ((-18.4, 8.4),),
        "room": ((-23.8, -0.8), (-23.6, 8.4), (22.1, -0.8), (26.9, 8.7), (7.8, -0.8), (17.4, -0.6), (-18.9, -0.8), (12.4,
                -0.8), (-8.9, -0.8), (-1.9, -0.9), (15.2, 5.8), (26.9, -0.8), (2.9, -0.8), (22.1, 9.4), (12.4, 9.3), (17.3,
                9.2), (-4.4, 9.2), (-14.1, -0.8), (17.8, 3.9), (26.4, 3.9), (-13.8, 9.2), (-8.9, 9.3), (7.8, 9.3), (-23.8,
                3.6), (-13.4, 5.8), (21.9, 4.1), (7.8, 6.4),),
    },
    f"{TSC}/strands_morse/g4s/g4s_y2.yaml": {
        "room": ((17.6, 15.1), (17.2, 25.9), (9.9, 17.1), (14.7, 22.8), (7.3, 9.4), (21.2, 27.8), (6.9, 3), (3.3, 8),),
    },
    "storeys_jsk/eng8-b1f.yaml": {
        "fan": ((13.5, 5), (20.5, 3), (9.6, 8.6),),
        "room": ((13.2, 12.8), (26.2, 27.2), (13.5, 47.1), (19.5, 11.6), (16.1, 31), (19.1, 15), (18.2, 47.8), (9, 47), (9.5,
                51.9), (7.7, 12.2), (11.5, 44.2),),
        "letter": ((28.1, 51.5), (27.9, 48.9),),
    },
    "storeys_jsk/eng2-3f.yaml": {
        "room": ((4.9, 9.8), (38.8, 7.8), (17.2, 4.8), (54.1, 44), (67.6, 40), (29.4, 43.4), (66.7, 17.6), (11.2, 30), (11.6,
                49.8), (17.1, 39.8), (62.6, 18.2),),
        "letter": ((20.4, 32.5), (24.2, 32.4),),
    },
    "storeys_jsk/eng2-7f_raw.yaml": {
        "room": ((19.2, 55.4), (6.3, 53.6), (29.1, 21.2), (29.4, 41.6), (11.8, 31.4), (46.7, 11.3), (46.8, 31.4), (46.8,
                51.2), (12, 49.8), (11.8, 11.3),),
        "letter": ((19.2, 10.6),),
    },
    "storeys_jsk/eng2-8f.yaml": {
        "fan": ((14.4, 51.1), (24, 49.9), (14.6, 12.7),),
        "room": ((24.1, 20.2), (18.1, 47.6), (33.2, 41.7), (39.9, 21.4), (46.7, 10.6), (11.8, 31.5), (12.1, 50), (46.7, 31.7),
                (46.8, 51.2),),
        "letter": ((19.2, 10.2), (23.4, 10.4),),
    },
}  # fmt: skip


def _freeze(difficulty: dict[str, float]) -> tuple[tuple[str, float], ...]:
    return tuple(sorted(difficulty.items()))


def dev() -> list[Case]:
    """Return a small set to develop on: training seeds and plans only."""
    cases: tuple[tuple[str, int, str, dict[str, float], str], ...] = (
        ("office", 1, "tls", {}, ""),
        ("office", 2, "depth", {}, ""),
        ("office", 3, "lidar", {"glass": 0.6}, ""),
        ("school", 1, "tls", {"ceiling_spread": 0.5}, ""),
        ("school", 2, "tablet", {}, ""),
        ("hospital", 1, "lidar", {}, ""),
        ("hospital", 2, "tls", {"lintels": 0.0}, ""),
        ("hospital", 3, "depth", {}, ""),
        ("hotel", 1, "tls", {}, ""),
        ("hotel", 2, "lidar", {"lamps": 1.0, "columns": 1.0, "beams": 0.5}, ""),
        ("apartment", 1, "depth", {}, ""),
        ("apartment", 2, "tls", {}, "below2"),
        ("lab", 1, "tls", {"lintels": 0.5}, ""),
        ("lab", 2, "tablet", {}, ""),
        ("house", 1, "depth", {}, ""),
        ("house", 2, "tls", {"furniture": 2.0, "clutter": 1.0}, ""),
        ("openplan", 1, "lidar", {}, ""),
        ("openplan", 2, "tls", {}, "sparse"),
        ("office", 4, "depth", {}, "drift"),
        ("office", 5, "tls", {}, "noise"),
    )
    out = [
        Case("dev", "procedural", k, sensor, seed, rooms=12, difficulty=_freeze(d), spoil=s) for k, seed, sensor, d, s in cases
    ]
    out += [Case("dev", "procedural", "office", "lidar", 6, storeys=2, rooms=20)]
    out += [Case("dev", "procedural", "house", "tls", 7, storeys=2)]
    out += [Case("dev", "r2v", "00/02/09a30b61b563f93faf6a6466ffab/0001", "depth", 1)]
    out += [Case("dev", "r2v", "00/04/3683ef8c7d3d97b5d9231ea1566b/0001", "tls", 1)]
    out += [Case("dev", "campus", "office/37s-floorplan-big", "tls", 1, rooms=15)]
    return [*out, Case("dev", "campus", "office/AtlanticSuites", "lidar", 1, rooms=15)]


def simulate_scan() -> list[Case]:
    """List every kind of building by every sensor."""
    return [
        Case(f"by {sensor}", "procedural", kind, sensor, TEST + 10 * i + 2, rooms=ROOM_NUMBERS)
        for sensor in CASE_SENSORS
        for i, kind in enumerate(BUILDING_KINDS)
    ]


def hard() -> list[Case]:
    """Return the same five buildings made hard in one way after the other; and buildings of two to four storeys."""
    places = (("office", "tls"), ("school", "lidar"), ("hospital", "depth"), ("hotel", "tls"), ("lab", "depth"))
    out = [
        Case(name, "procedural", kind, sensor, TEST + 100 + i, rooms=ROOM_NUMBERS, difficulty=_freeze(difficulty), spoil=spoil)
        for name, (difficulty, spoil) in HARD.items()
        for i, (kind, sensor) in enumerate(places)
    ]
    high = (("house", "tls", 0), ("office", "lidar", 20), ("hotel", "tls", 20))
    return out + [
        Case(f"{k} storeys", "procedural", kind, sensor, TEST + 200 + 10 * k + i, k, rooms)
        for k in (2, 3, 4)
        for i, (kind, sensor, rooms) in enumerate(high)
    ]


def plans() -> list[Case]:
    """List real plans, erected and scanned."""
    r2v = (
        "00/0b/0513fae730eaf65b98f9580d024d/0001",
        "00/0e/4a5243dead16df7eab33ef0d3a69/0001",
        "00/3a/b20ab32cf1ec8262e1e447181ec4/0004",
        "00/3f/2d397ee85ccffb737d5a86280fe4/0002",
    )
    campus = ("school/Franch1", "school/Sabadell1", "school/Sabadell2", "school/Sabadell3")
    sensors = ("tls", "lidar", "depth", "tls")
    out = [Case("flats (real plans)", "r2v", name, s, TEST + i) for i, (name, s) in enumerate(zip(r2v, sensors, strict=True))]
    return out + [
        Case("schools (real plans)", "campus", name, s, TEST + i, rooms=15)
        for i, (name, s) in enumerate(zip(campus, sensors, strict=True))
    ]


def grids() -> list[Case]:
    """List robots' grids with true rooms: IPA's eight, bare and furnished, raised and erected and scanned; the floors of GDC."""
    out = [Case("grids, bare", "ipa", name) for name in IPA]
    out += [Case("grids, furnished", "ipa", f"{name}_furnitures") for name in IPA]
    for k, (title, difficulty) in enumerate((("grids scanned, bare", BARE), ("grids scanned, furnished", {}))):
        sensors = ("tls", "lidar", "depth")
        out += [Case(title, "ipa-plan", n, sensors[(i + k) % 3], TEST, difficulty=_freeze(difficulty)) for i, n in enumerate(IPA)]
    return out + [Case("GDC's floors", "gdc", floor) for floor in "1234"]


def ifc() -> list[Case]:
    """List building models scanned from inside."""
    names = ("ExampleHOM", "LargeBuilding", "TallBuilding", "duplex", "Office_A_20110811")
    out = [Case("models", "ifc", name, "tls", TEST) for name in names]
    return out + [Case("models", "ifc", name, "depth", TEST, rooms=20) for name in ("duplex", "Office_A_20110811")]


def pairs() -> list[Case]:
    """Return two sessions in one building, by two sensors, with 60 % of the rooms in common."""
    sensors = (("tls", "depth"), ("lidar", "tls"), ("depth", "depth"), ("lidar", "depth"))
    moved = {"moved": 0.6, "gone": 0.2, "doors_moved": 0.6}
    sets: tuple[tuple[str, dict[str, float], tuple[str, ...]], ...]
    sets = (("two sessions", {}, BUILDING_KINDS), ("two sessions, furniture moved", moved, BUILDING_KINDS[::2]))
    return [
        Case(name, "procedural", kind, sensor, TEST + 300 + i, rooms=ROOM_NUMBERS, difficulty=_freeze(difficulty), day=day)
        for name, difficulty, kinds in sets
        for i, kind in enumerate(kinds)
        for day, sensor in enumerate(sensors[i % 4], 1)
    ]


def homes() -> list[Case]:
    """List real homes as vacuum robots drew them, against the robots' own rooms: for development."""
    return [Case("homes of vacuum robots", "home", name) for name in HOMES]


def look() -> list[Case]:
    """List real maps without truth: for the eye."""
    return [Case("by eye", "file", name) for name in LOOK]


def list_marked() -> list[Case]:
    """List grids on which places were told apart by eye: for development."""
    return [Case("marked by eye", "file", name) for name in MARKS]


def peers() -> list[Case]:
    """List the cases that classic methods are compared on: every grid with true rooms, and scans from above of each sensor that
    sees more than a slice."""
    scans = [*simulate_scan(), *(case for case in plans() if case.source == "campus")]
    return [*grids(), *(case for case in scans if case.sensor != "laser2d")]


GROUPS: dict[str, Callable[[], list[Case]]] = {f.__name__: f for f in (dev, simulate_scan, hard, plans, grids, ifc, pairs, look)}
# "all" leaves these out: it holds their cases already, or they are for development.
SELECTIONS: dict[str, Callable[[], list[Case]]] = {"peers": peers, "homes": homes, "marked": list_marked}


def select_cases(names: Iterable[str], limit: int | None = None) -> list[Case]:
    """Select cases of groups ("all": all but `dev`), `limit` of each set; of a pair both."""
    requested = list(names)
    groups: list[Any] = [g for name, g in GROUPS.items() if name in requested or ("all" in requested and name != "dev")]
    groups += [g for name, g in SELECTIONS.items() if name in requested]
    out: list[Case] = []
    for group in groups:
        count: dict[str, int] = {}
        for case in group():
            count[case.set] = count.get(case.set, 0) + 1
            if limit is None or count[case.set] <= limit:
                out.append(case)
    return out
