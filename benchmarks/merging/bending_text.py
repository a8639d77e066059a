"""What docs/results/bending.md says beside its tables."""

from __future__ import annotations

from topomerge.registration.bend.pieces import sensor_drift

BENDING_COMMANDS = (
    "`python -m benchmarks.merging.bending simulated 36000 {split}; python -m benchmarks.merging.bending floor 3600; python -m "
    "benchmarks.merging.bending wrong 3600 {split}; python -m benchmarks.merging.bending growth 3600; python -m "
    "benchmarks.merging.bending tables docs/results/bending.md {split}`. Intervals are over physical buildings: in brackets 95 % "
    "by bootstrap; of fewer than eight the range of the buildings. Seconds are of the processor, on a machine with other jobs."
)
ROOM_HEADS = ("every room within 0.1 m, 1° %,", "median m,", "median °,")
SIMULATED = (
    "Pairs of two sensors (all pairs of tls, lidar, depth, tablet, laser2d, and each with a drawing) that share 80 m² or more, "
    "each with 0, 1, 2 and 4 times the usual drift of its sensors. A room's error is how far, and how much turned, the second "
    "map's lies beside the first's, both undrifted: the mean over places of half a metre, horizontally. Rooms are those that "
    "both surveyors were in and of which both maps show 2 m² or more. *Rigid*: the pose that registration gives, wrong or right "
    "(0.5 m, 5°); where it gives none, no room is right. *Bent*: from that pose on, both sensors being known. Medians are over "
    "rooms."
)
BY_SENSOR = "By sensor, at the usual drift; each pair stands in the lines of both its sensors:"
UNNAMED = "The same where bending does not know the sensors and takes cells for those of an unknown one:"
OFFICE = (
    "The office floor that one may choose by (Halmstad F5: 14 captures by phone and a drawing, scale free); pairs whose best "
    "rigid pose is right. Walls on free floor: share of the walls of both maps that stand on free floor of the other. Key "
    "points: distance of what was marked in both maps as one, median over all."
)
OFFICE_HEADS = (
    "pairs of", "number", "walls on free floor, median: rigid", "bent", "below .12 %: rigid", "bent",
    "key points m: rigid", "bent",
)  # fmt: skip
APART = (
    "Poses as they are proposed, before their fine registration: right ones, and wrong ones (of the same pair, off by more than "
    "1.5 m or 10°; the best of strangers, of other storeys, other wings, other buildings), told apart by the share of walls on "
    "free floor (drawn towards the usual 15 % where there are few walls), and by the log odds of all that is counted under a "
    "pose (fitted to rigid poses). Area under the ROC curve, and right poses above all but so many of the wrong ones."
)
APART_HEADS = ("poses", "told apart by", "maps", "right", "wrong", "area under curve")
WAYS = {"drawn": "walls on free floor", "score": "all that is counted"}
GROWTH = (
    "Synthetic storeys of rooms along corridors, the second bent by waves 25 m long and 0.15 m high; both maps bend. Seconds "
    "of the processor."
)
GROWTH_HEADS = ("rooms", "pieces of both maps", "prepare s", "register s", "bend s")
DRIFT_HEADS = ("sensor", "shift mm/√m", "turn °/√m")


def drift_table() -> list[list[object]]:
    """Sensor, shift and turn over a metre of way."""
    rows: list[list[object]] = []
    for sensor in ("tls", "lidar", "depth", "tablet", "laser2d", "drawing", "unknown"):
        usual = sensor_drift(sensor, fitted=True)
        rows.append([sensor, f"{1000 * usual.shift:.1f}", f"{usual.turn * 57.29578:.2f}"])
    return rows
