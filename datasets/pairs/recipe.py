"""What a set of pairs is made of: the recipe, and the real plans that it draws from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import shapely
from topomerge.datasets.buildings.procedural import PROFILES
from topomerge.datasets.buildings.stack import Stack, iter_stacks
from topomerge.datasets.core.plan import Plan
from topomerge.datasets.pairs.atlases import FLAT_KINDS
from topomerge.datasets.pairs.degrade import check_change
from topomerge.datasets.pairs.pairs import HARD
from topomerge.datasets.plans import splits
from topomerge.datasets.simulation.sensors import get_sensor

from topomerge.embedding.schema import POINTS_PER_ROOM
from topomerge.errors import InputError

LEAST_PLAN = (5, 45.0)  # rooms, m2 of a real plan: fewer have no two parts, and those of a tiny flat are hardly told apart
LEAST_HOME = (4, 25.0)  # of a home that a robot mapped: there are few, and to learn from them is what they are for
LARGEST_ROOM = 2500.0  # m2; an airport's hall takes minutes to furnish
ONE_STOREY = ("r2v", "ipa", "home")  # sources without sibling storeys
PLACES = {**splits.FOLDERS, "ipa": splits.TEST_ONLY["ipa"][0]}  # source -> folder; IPA's are for the test only
MOST_DRIFT = 10.0  # times the usual one
SIDES = "abcdef"  # names of the maps of a building in a file
Library = Mapping[str, Mapping[str, tuple[Plan, ...]]]  # source -> name -> plans of its storeys, lowest first


@dataclass
class Recipe:
    """A set of pairs. Weights need not sum to 1; they have no defaults, as YAML would add its own to them.

    Args:
        name: of the manifest.
        split: train, validation or test.
        folder: of the real data; may be empty where `sources` is procedural only.
        sources: weight of each: procedural, r2v, campus, mall, rmf, home; for the test also ipa.
        kinds: weight of each kind of procedural building.
        overlaps: shares of rooms in common, drawn alike often.
        sensors: weight of each, drawn for each map by itself.
        rooms: fewest and most rooms a map.
        two_storeys: share of the procedural buildings with two storeys.
        hard: share of the pairs that are hard negatives, of each kind.
        scale: share of the pairs whose second map has an unknown scale.
        spread: how far furniture, doors, glass and so on differ from building to building: 0.5 is half to one and a half times.
        voxel_size: of the extraction, m.
        stacks: share of the real buildings with two storeys, where the source has sibling storeys that fit (`stack`).
        over_stairs: share of the overlapping pairs in buildings of several storeys whose walks lead over stairs.
        maps: keep the extracted maps (`evaluation_pair`), too: for evaluation.
        walks: maps of each building that is no hard negative: of more than two, all pairs are taken (`several_maps`), and the
            overlaps are as they come. Their sensors may also be those of `atlases.FLAT_KINDS`.
        drifts: of more than two walks: times the usual drift of a sensor, drawn for each map; empty: the usual one.
        vary: name of a change (`degrade.CHANGES`) -> values; every pair is made once for each of all these.
    """

    name: str = "set"
    split: str = "train"
    pairs: int = 100
    seed: int = 0
    folder: str = ""
    sources: dict[str, float] = field(default_factory=dict)
    kinds: dict[str, float] = field(default_factory=dict)
    overlaps: list[float] = field(default_factory=lambda: [0.25, 0.5, 0.75])
    sensors: dict[str, float] = field(default_factory=dict)
    rooms: list[int] = field(default_factory=lambda: [6, 15])
    two_storeys: float = 0.0
    hard: dict[str, float] = field(default_factory=dict)
    scale: float = 0.0
    spread: float = 0.5
    voxel_size: float = 0.1
    points_per_room: int = POINTS_PER_ROOM
    stacks: float = 0.0
    over_stairs: float = 0.0
    maps: bool = False
    walks: int = 2
    drifts: list[float] = field(default_factory=list)
    vary: dict[str, list[float]] = field(default_factory=dict)


def check(recipe: Recipe) -> None:
    """Refuse a recipe that nothing can be made of.

    Raises:
        InputError: names the key and what is wrong.
    """
    splits.seeds(recipe.split)
    for sensor in recipe.sensors:
        if sensor not in FLAT_KINDS or recipe.walks == 2:
            get_sensor(sensor)
    possible = {"sources": ("procedural", *PLACES), "kinds": tuple(PROFILES), "hard": HARD}
    for key in ("sources", "kinds", "sensors", "hard"):
        weights: dict[str, float] = getattr(recipe, key)
        for name, weight in weights.items():
            if name not in possible.get(key, (name,)):
                raise InputError(f"{key}: unknown {name!r}; {', '.join(possible[key])} are possible")
            if not 0 <= weight < np.inf:
                raise InputError(f"{key}.{name} must be 0 or more, not {weight}")
        if key != "hard" and sum(weights.values()) <= 0:
            raise InputError(f"{key}: no weight above 0")
    shares = {key: getattr(recipe, key) for key in ("two_storeys", "stacks", "over_stairs", "scale")}
    shares["hard, in all,"] = sum(recipe.hard.values())
    shares |= {f"overlaps[{i}]": o for i, o in enumerate(recipe.overlaps)} | {"spread": recipe.spread}
    for key, value in shares.items():
        if not 0 <= value <= 1:
            raise InputError(f"{key} must be 0 to 1, not {value}")
    for what, values in recipe.vary.items():
        check_change(what, values)
    if recipe.pairs < 1 or not recipe.overlaps or len(recipe.rooms) != 2 or not 3 <= recipe.rooms[0] <= recipe.rooms[1]:
        raise InputError("pairs must be 1 or more, overlaps one or more, rooms [fewest, most] with 3 or more each")
    if recipe.drifts and (recipe.walks == 2 or not all(0 <= drift <= MOST_DRIFT for drift in recipe.drifts)):
        raise InputError(f"drifts are of more than two walks, 0 to {MOST_DRIFT:g} each, not {recipe.drifts}")
    if not 2 <= recipe.walks <= len(SIDES) or (recipe.walks > 2 and (recipe.maps or recipe.vary)):
        raise InputError(f"walks must be 2 to {len(SIDES)}, and 2 where maps are kept or changed, not {recipe.walks}")
    if not 0.02 <= recipe.voxel_size <= 1 or recipe.points_per_room < 1:
        raise InputError("voxel_size must be 0.02 to 1 m, and points_per_room 1 or more")


def library(recipe: Recipe) -> Library:
    """The real plans that the recipe draws from: those of its split that are not too small and have no vast room.

    Raises:
        InputError: no folder of real data, or nothing of a source is in it.
    """
    from topomerge.datasets.plans.floorplans import Refusal, iter_plans

    out: dict[str, dict[str, tuple[Plan, ...]]] = {}
    for source in (s for s, weight in recipe.sources.items() if s != "procedural" and weight > 0):
        if not recipe.folder:
            raise InputError(f"sources.{source} needs the real data: set folder or TOPOMERGE_DATA, or take procedural only")
        if source in splits.TEST_ONLY and recipe.split != "test":
            raise InputError(f"sources.{source}: is for the test only, not for {recipe.split}")
        wanted = None if source in splits.TEST_ONLY else set(splits.members(recipe.split, source))
        folder = Path(recipe.folder) / PLACES[source]
        least = LEAST_HOME if source == "home" else LEAST_PLAN
        plans = {n: p for n, p in iter_plans(folder, wanted) if not isinstance(p, Refusal) and _fits(p, *least)}
        if not plans:
            raise InputError(f"sources.{source}: no plan of split {recipe.split} in {recipe.folder}")
        out[source] = {name: (plan,) for name, plan in plans.items()}
        stacked = recipe.stacks > 0 or recipe.hard.get("other-storey", 0) > 0
        if stacked and source not in ONE_STOREY:
            stacks = iter_stacks(folder, dict(plans))
            out[source] |= {name: stack.plans for name, stack in stacks if isinstance(stack, Stack)}
    return out


def _fits(plan: Plan, rooms: int, area: float) -> bool:
    areas = [shapely.Polygon(room.polygon).area for room in plan.rooms]
    return len(areas) >= rooms and sum(areas) >= area and max(areas) <= LARGEST_ROOM
