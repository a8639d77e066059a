"""Which real building a map is of: what is independent, and what intervals are drawn over.

Names of one building differ by storey (``hotel/L1``, ``Sabadell2``), by furniture (``lab_a_scan_furnitures``), by session
(``tsc-2015``), by stack (``L1 + L2``) and by owner: IPA's Freiburg101 is the building of the CARMEN log freiburg-101.
"""

from __future__ import annotations

import re

# What a name says of its storey, in words.
LEVEL_WORDS = {
    "basement": -1.0,
    "lower": 0.0,
    "ground": 0.0,
    "main": 1.0,
    "first": 1.0,
    "upper": 2.0,
    "second": 2.0,
    "third": 3.0,
}
ALIASES = {"romainrolland": "romainroland"}  # misspelt by the owner
STRANGERS = ("scuolasconosciuta",)  # "unknown school": the three are different ones
HOMES = ("1c", "l10su")  # robots of which every map is of one home, on another day
SESSIONS = ("tsc", "g4s", "umic", "movecare", "uma")  # of one place, named by date or version behind it
OF_ONE_PLACE = {"octomap": "freiburg/78", "ipad": "delft", "libpointmatcher": "libpointmatcher", "gdc": "utexas/gdc"}


def physical_building(source: str, name: str) -> str:
    """The real (or made) building of a map; of a pair of two buildings, ``a + b``, that of a.

    Storeys, stacks of storeys, wings, sessions and sensors of one building are one; a procedural building is its kind and seed.

    Args:
        source: procedural, r2v, campus, rmf, mall, utexas, ipa, halmstad, carmen, strands ... as of `plans.splits`.
        name: of the building, its plan or its map, as the source's reader gives it.
    """
    name = name.split(" + ")[0]
    source = source.removesuffix("-plan")
    if source == "own":  # its name is what its owner calls it
        return f"own/{name}"
    if source in OF_ONE_PLACE:
        return OF_ONE_PLACE[source]
    if source == "procedural":  # kind-seed-storeys; kinds may have hyphens
        return f"procedural/{re.sub(r'(?<=[0-9])-.*$', '', name)}"
    if source == "r2v":  # the plans of one property
        return f"r2v/{name.rpartition('/')[0] or name}"
    if source == "home":
        return f"home/{next((h for h in HOMES if name.startswith(h)), name)}"
    if source == "halmstad":
        return f"halmstad/{re.split(r'[_/-]', name)[0]}"
    last = name.rpartition("/")[2].lower()
    if source == "utexas":
        return f"utexas/{next((b for b in ('ahg', 'ase') if last.startswith(b)), 'gdc')}"
    place = re.sub(r"(_scan|_furnitures|_trashbins|_gt_segmentation|-corrected)+$", "", last)
    if freiburg := re.match(r"freiburg-?0*(\d+)", place):
        return f"freiburg/{freiburg[1]}"
    if source == "strands":
        return f"strands/{next((s for s in SESSIONS if last.startswith(s)), last)}"
    if source in ("campus", "rmf", "mall"):
        above = name.rpartition("/")[0]
        base, _ = named_storey(name.rpartition("/")[2])
        return f"{source}/" + "/".join(part for part in (above, last if base in STRANGERS else base) if part)
    return f"{source}/{re.sub('-(first|middle|last)-(first|middle|last)$', '', place)}"


def named_storey(name: str) -> tuple[str, float]:
    """What a plan's name says of its building and of its storey: ("sabadell", 2) of Sabadell2."""
    word = re.fullmatch(rf"(.*?)[ _-]*({'|'.join(LEVEL_WORDS)})(?:[ _-]*floor)?", name, re.IGNORECASE)
    if word:
        return word[1].lower(), LEVEL_WORDS[word[2].lower()]
    number = re.fullmatch(r"(.*?)[ _-]*([PFBL]?)(\d)(v\d|[ns]?e?)", name)
    if not number:
        return name, 0.0
    base, level = number[1].lower(), float(number[3])
    return ALIASES.get(base, base), (-level if number[2] == "B" else level) + (0.5 if number[4] else 0.0)
