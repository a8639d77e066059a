"""Which scans the benchmark of the extraction is made of, set by set."""

from __future__ import annotations

from extraction_scans import Case

DEV = "dev"


def dev() -> list[Case]:
    """A small set to develop on: training seeds and plans only."""
    made = [
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
    ]
    out = [
        Case(DEV, "procedural", kind, sensor, seed, rooms=12, difficulty=tuple(sorted(known.items())), spoil=spoil)
        for kind, seed, sensor, known, spoil in made
    ]
    out += [Case(DEV, "procedural", "office", "lidar", 6, storeys=2, rooms=20), Case(DEV, "procedural", "house", "tls", 7, storeys=2)]
    out += [Case(DEV, "r2v", name, sensor, 1) for name, sensor in (R2V_TRAIN[0], R2V_TRAIN[1])]
    out += [Case(DEV, "campus", name, sensor, 1, rooms=15) for name, sensor in CAMPUS_TRAIN]
    return out


R2V_TRAIN = (
    ("00/02/09a30b61b563f93faf6a6466ffab/0001", "depth"),
    ("00/04/3683ef8c7d3d97b5d9231ea1566b/0001", "tls"),
)
CAMPUS_TRAIN = (("office/37s-floorplan-big", "tls"), ("office/AtlanticSuites", "lidar"))
SETS = {DEV: dev}
