"""What docs/results/merging.md says beside its tables."""

from __future__ import annotations

from topomerge.fusion.verify import model

THRESHOLD = float(model()["threshold"])
COMMANDS = (
    "`python -m benchmarks.merging.cached_pairs test jobs=2; python -m benchmarks.merging.register test 1000; python "
    "-m benchmarks.merging.register test_drawings 1000; python -m benchmarks.merging.strangers test 757; python -m "
    "benchmarks.merging.register real 100; python -m benchmarks.merging.strangers real 300; python -m "
    "benchmarks.merging.lookalikes test; python -m benchmarks.merging.results docs/results/merging.md`"
)
ABOUT = (
    "In 0.1 m cells, every sixth with much moved furniture, every eighth with glass walls. Right: within 0.5 m and 5° in "
    "the middle of what both maps saw; of slices and floor plans horizontally, and on the right storey (within 1.4 m in "
    f"height). Believed: probability {THRESHOLD} or more. Intervals are over physical buildings: in brackets 95 % by "
    "bootstrap; of fewer than eight the range of the buildings. Storeys, stacks and wings of one building are one "
    "(`datasets/core/physical.py`). Seconds of processor, median, on a machine with other jobs (speed: docs/benchmarks.md)."
)
MUST_NOT = (
    "Through registration and its verdict, on cells alone; every pair is in. Believed: at a pose that is not right. The "
    "interval is exact (Clopper–Pearson) and over physical buildings: how many have a false merge or more. *Stranger*: two "
    "buildings, and floor plans of another one. *No room in common*: parts of one building that share nothing. *Other "
    "storey*: of one building, of one plan or of its own; also maps of two plans of one school, and the same plan furnished "
    "anew. *Twin wing*: nearly the same plan a second time. *Repeated modules*: rows of equal rooms or modules, parts of "
    "which lie some rooms apart. *Own mirror image*: a part of a building and its reflection. *Other look-alikes*: "
    "corridors of one hotel, rooms of one size. *Nobody can tell*: twin wings of which no room that both maps show differs "
    "by 0.3 m, floor plans of another storey with the same walls where the map was taken, and look-alikes whose walls, "
    "fixtures and furniture agree (`datasets/pairs/lookalike_rule.py`): the right answer is to abstain, and each that was "
    "believed counts as false. The prior of the kinds is an assumption (`PRIOR` in `benchmarks/merging/false_merges.py`); "
    "at it, each kind counts by the mean over its buildings, with Jeffreys' interval."
)
STRANGE = (
    "The maps of the real pairs, each with maps of other places: apartments (Halmstad), offices and corridors (CARMEN, "
    "STRANDS), and four storeys of one building (UTexas: grids and drawings). With Halmstad's maps the scale is free."
)
CALIBRATION = (
    "All pairs, those that must not merge and what nobody can tell apart among them; bins of equal mass. Error: expected "
    "calibration error; in brackets, what a forecast whose probabilities are all true would show by chance with as many "
    "pairs. Most pairs must not merge and are told to be below 0.1, which makes any error small: so it is told without "
    "them, too."
)
REAL_HEADS = (
    "pairs", "number", "physical buildings", "right", "within 0.1 m, 1°", "right and believed", "wrong and believed",
    "scale off by", "s", "not right",
)  # fmt: skip
REAL = (
    "Halmstad's scale is free (`--scale free`); the literature's figure for its maps to layouts is 80.4 % success, its best "
    "alternative 31.9 % (four environments; two of them are here)."
)
CHANGES = (  # key, what, before, why
    (
        "right", "share 80 m²: right %", "98 [95, 100] of 95 pairs",
        "the documented command gives pairs of real schools and flats, too; the pairs told before were 182 of as many buildings, "
        "as it gives without the real plans. A slice on the wrong storey is wrong",
    ),
    ("believed", "the same: right and believed %", "75 [66, 83]", "the same"),
    ("pairs", "must not merge, believed", "22 of 587", "other pairs; look-alikes and real maps are in"),
    (
        "buildings", "buildings with a false merge", "15 of 146: 5.9 to 16.4 %",
        "storeys of one school are one building; two of its plans are another storey and no strangers",
    ),
    ("told", "… that anybody could tell apart", "2 of 558", "no headline any more: what nobody can tell apart counts"),
    ("prior", "at a stated prior of kinds", "–", "how many pairs of a kind a set has is up to who makes it"),
    (
        "calibration", "calibration error", "0.027 over 734, without what nobody can tell apart",
        "every pair is in; bins of equal mass, not of equal width; without the mass near zero, too",
    ),
)  # fmt: skip
LOOKED_AT = (
    "**What was looked at.** Features, models and the threshold were chosen by left-out training pairs, and nothing is fitted "
    "to test or real pairs. But they were looked at: earlier versions were run on the test pairs; poses beyond a map's outer "
    "walls are drawn back since a free scale ran away on real pairs; amounts are weighed as of 200 m² at most since large "
    "floors were refused; floor plans came among the training pairs when Halmstad's had been run (2 of 8 believed then); "
    "a kind of training scan was added after one real failure; simulated ranges were moved towards those of real sensors."
)
