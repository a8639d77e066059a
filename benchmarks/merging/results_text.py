"""What docs/results/merging.md says beside its tables."""

from __future__ import annotations

from topomerge.registration.verify import model

THRESHOLD = float(model()["threshold"])
COMMANDS = (
    "`python -m benchmarks.merging.cached_pairs test jobs=2; python -m benchmarks.merging.register test 1000; python "
    "-m benchmarks.merging.register test_drawings 1000; python -m benchmarks.merging.strangers test 757; python -m "
    "benchmarks.merging.register real 100; python -m benchmarks.merging.strangers real 300; python -m "
    "benchmarks.merging.lookalikes test; python -m benchmarks.merging.results docs/results/merging.md`"
)
ABOUT = (
    "Cells of 0.1 m; every sixth pair with much moved furniture, every eighth with glass walls. Right: within 0.5 m and 5° in "
    "the middle of what both maps saw; for slices and floor plans horizontally, and on the right storey (within 1.4 m in "
    f"height). Believed: probability {THRESHOLD} or more. Intervals are over physical buildings: in brackets 95 % by "
    "bootstrap; with fewer than eight buildings their range. Storeys, stacks and wings of one building count as one "
    "(`datasets/core/physical.py`). Seconds: median of processor time, on a machine with other jobs (speed: docs/benchmarks.md)."
)
MUST_NOT = (
    "All pairs went through registration and its verdict, from cells only, and all are counted. Believed: at a pose that is "
    "not right. The exact interval (Clopper–Pearson) is of the share of physical buildings with a false merge. *Stranger*: two "
    "buildings, or a floor plan of another one. *No room in common*: parts of one building that share nothing. *Other "
    "storey*: of one building, with the same plan or its own; also two plans of one school, and the same plan with other "
    "furniture. *Twin wing*: nearly the same plan a second time. *Repeated modules*: parts of rows of equal rooms or modules, "
    "some rooms apart. *Own mirror image*: a part of a building and its reflection. *Other look-alikes*: corridors of one "
    "hotel, rooms of one size. *Indistinguishable*: pairs that nobody can tell apart, that is twin wings in which no room "
    "that both maps show differs by 0.3 m, floor plans of another storey with the same walls where the map was taken, and "
    "look-alikes whose walls, fixtures and furniture agree (`datasets/pairs/lookalike_rule.py`): it is right to abstain, and "
    "each one believed counts as false. The prior of the kinds is an assumption (`PRIOR` in "
    "`benchmarks/merging/false_merges.py`); for it, each kind counts by the mean over its buildings, with Jeffreys' interval."
)
STRANGE = (
    "The maps of the real pairs, each with maps of other places: apartments (Halmstad), offices and corridors (CARMEN, "
    "STRANDS), and four storeys of one building (UTexas: grids and drawings). The scale of Halmstad's maps is free."
)
CALIBRATION = (
    "All pairs, including those that must not merge and the indistinguishable ones; bins of equal mass. Error: expected "
    "calibration error (ECE); in brackets, the error that perfectly calibrated probabilities would show by chance with as "
    "many pairs. Most pairs must not merge and get a probability below 0.1, which makes any error small; therefore the error "
    "without them is given, too."
)
REAL_HEADS = (
    "pairs", "number", "physical buildings", "right", "within 0.1 m, 1°", "right and believed", "wrong and believed",
    "scale error", "s", "wrong",
)  # fmt: skip
REAL = (
    "Halmstad's scale is free (`--scale free`). The literature reports 80.4 % success for aligning these maps with layouts, and "
    "31.9 % for the best alternative (four environments; two of them are used here)."
)
CHANGES = (  # key, what, before, why
    (
        "right", "pairs that share 80 m²: right %", "98 [95, 100] of 95 pairs",
        "the documented command also gives pairs of real schools and flats; the earlier 182 pairs of as many buildings are those "
        "that it gives without the real plans. A slice on the wrong storey counts as wrong",
    ),
    ("believed", "the same: right and believed %", "75 [66, 83]", "the same"),
    ("pairs", "must not merge, believed", "22 of 587", "other pairs; look-alikes and real maps are included"),
    (
        "buildings", "buildings with a false merge", "15 of 146: 5.9 to 16.4 %",
        "storeys of one school count as one building; two of its plans are other storeys, not strangers",
    ),
    ("told", "… without indistinguishable pairs", "2 of 558", "no longer the headline: indistinguishable pairs count"),
    ("prior", "at a stated prior of kinds", "–", "the number of pairs of each kind depends on who makes the set"),
    (
        "calibration", "calibration error", "0.027 over 734, without indistinguishable pairs",
        "all pairs count; bins of equal mass, not of equal width; also without the mass near zero",
    ),
)  # fmt: skip
LOOKED_AT = (
    "**Use of test data.** Features, models and the threshold were chosen on left-out training pairs, and nothing is fitted "
    "to test or real pairs. But results on them were seen and led to changes: earlier versions were run on the test pairs; "
    "poses beyond a map's outer walls are pulled back, because a free scale diverged on real pairs; areas count as 200 m² at "
    "most, because large floors were refused; floor plans were added to the training pairs after Halmstad's had been run (2 of "
    "8 believed then); a kind of training scan was added after one real failure; simulated ranges were moved towards those of "
    "real sensors."
)
