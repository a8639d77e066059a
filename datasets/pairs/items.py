"""Recipes of sets of pairs, and the items that they are drawn into."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from topomerge.datasets.buildings.procedural import PROFILES
from topomerge.datasets.buildings.stack import Stack, count_matching_rooms, iter_stacks
from topomerge.datasets.core.building import Difficulty, Plan
from topomerge.datasets.pairs.atlases import FLAT_KINDS
from topomerge.datasets.pairs.pairs import HARD, PairSettings
from topomerge.datasets.plans import splits
from topomerge.datasets.simulation.sensors import get_sensor
from topomerge.datasets.simulation.signs import READERS

from topomerge.archive import convert_to_plain
from topomerge.code_digest import compute_code_digest, compute_data_digest
from topomerge.embedding import graph
from topomerge.embedding.graph import POINTS_PER_ROOM
from topomerge.errors import InputError
from topomerge.types import Array, PointCloud


def select_points(cloud: PointCloud, rows: Array) -> PointCloud:
    """Select some points of a cloud."""
    some = {n: v[rows] for n in ("points", "colors", "labels", "pose_of", "intensities") if (v := getattr(cloud, n)) is not None}
    return replace(cloud, **some)


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
        walks: maps of each building that is no hard negative: of more than two, all pairs are taken (`build_several_maps`), and
        the
            overlaps are as they come. Their sensors may also be those of `atlases.FLAT_KINDS`.
        drifts: of more than two walks: times the usual drift of a sensor, drawn for each map; empty: the usual one.
        signs: share of the pairs whose maps hold door signs, read well or badly (`simulation.signs.READERS`).
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
    signs: float = 0.0


def check(recipe: Recipe) -> None:
    """Refuse a recipe that nothing can be made of.

    Raises:
        InputError: names the key and what is wrong.
    """
    splits.get_seed_range(recipe.split)
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
    shares = {key: getattr(recipe, key) for key in ("two_storeys", "stacks", "over_stairs", "scale", "signs")}
    shares["hard, in all,"] = sum(recipe.hard.values())
    shares |= {f"overlaps[{i}]": o for i, o in enumerate(recipe.overlaps)} | {"spread": recipe.spread}
    for key, value in shares.items():
        if not 0 <= value <= 1:
            raise InputError(f"{key} must be 0 to 1, not {value}")
    if recipe.pairs < 1 or not recipe.overlaps or len(recipe.rooms) != 2 or not 3 <= recipe.rooms[0] <= recipe.rooms[1]:
        raise InputError("pairs must be 1 or more, overlaps one or more, rooms [fewest, most] with 3 or more each")
    if recipe.drifts and (recipe.walks == 2 or not all(0 <= drift <= MOST_DRIFT for drift in recipe.drifts)):
        raise InputError(f"drifts are of more than two walks, 0 to {MOST_DRIFT:g} each, not {recipe.drifts}")
    if not 2 <= recipe.walks <= len(SIDES) or (recipe.walks > 2 and recipe.maps):
        raise InputError(f"walks must be 2 to {len(SIDES)}, and 2 where maps are kept, not {recipe.walks}")
    if recipe.signs and recipe.walks != 2:
        raise InputError("signs are of pairs of two walks: set walks to 2")
    if not 0.02 <= recipe.voxel_size <= 1 or recipe.points_per_room < 1:
        raise InputError("voxel_size must be 0.02 to 1 m, and points_per_room 1 or more")


def load_library(recipe: Recipe) -> Library:
    """Load the real plans that the recipe draws from: those of its split that are not too small and have no vast room.

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
        requested = None if source in splits.TEST_ONLY else set(splits.list_members(recipe.split, source))
        folder = Path(recipe.folder) / PLACES[source]
        least = LEAST_HOME if source == "home" else LEAST_PLAN
        plans = {n: p for n, p in iter_plans(folder, requested) if not isinstance(p, Refusal) and _is_fitting(p, *least)}
        if not plans:
            raise InputError(f"sources.{source}: no plan of split {recipe.split} in {recipe.folder}")
        out[source] = {name: (plan,) for name, plan in plans.items()}
        stacked = recipe.stacks > 0 or recipe.hard.get("other-storey", 0) > 0
        if stacked and source not in ONE_STOREY:
            stacks = iter_stacks(folder, dict(plans))
            out[source] |= {name: stack.plans for name, stack in stacks if isinstance(stack, Stack)}
    return out


def _is_fitting(plan: Plan, rooms: int, area: float) -> bool:
    areas = [shapely.Polygon(room.polygon).area for room in plan.rooms]
    return len(areas) >= rooms and sum(areas) >= area and max(areas) <= LARGEST_ROOM


# Raise it when the same item gives other bytes, by whatever step: simulation, extraction, truth. It is part of the files' names.
PAIR_FORMAT = 15
EXTRACTION = "topomerge.extraction.extract"
MAKER = "topomerge.datasets.pairs.example"  # what makes the files
UNDRAWN = ("niches",)  # of the difficulty: younger than the names of cached pairs, which hold what is drawn
CANDIDATES = 4  # buildings tried for an item: not every one has two parts with the overlap that is wanted
TWINS = 6  # rooms over rooms of the same outline, from which on two real storeys are hard to tell apart


@dataclass(frozen=True)
class Item:
    """Everything that the bytes of one pair depend on.

    Args:
        buildings: candidates, the first that works is taken: seeds of procedural buildings, or names of plans; those of storeys
            that are stacked are joined by " + ".
        plans: digests of those plans; empty for procedural ones.
        other: the building of "other-building", likewise, and its digest.
        difficulty: what differs from the defaults.
        maps: are the extracted maps kept beside the pair?
        more: sensors of further maps of the building, in the same file (`build_several_maps`).
        drifts: of all its maps, times the usual drift; empty: the usual one.
        signs: how the door signs of both maps are read, of `simulation.signs.READERS`; empty: there are none.
    """

    source: str
    kind: str
    buildings: tuple[str, ...]
    plans: tuple[str, ...]
    other: tuple[str, str]
    seed: int
    storeys: int
    overlap: float
    sensors: tuple[str, str]
    rooms: int
    hard: str
    scale: bool
    difficulty: tuple[tuple[str, float], ...]
    voxel_size: float
    points_per_room: int
    over_stairs: bool = False
    maps: bool = False
    more: tuple[str, ...] = ()
    drifts: tuple[float, ...] = ()
    signs: str = ""

    @property
    def pair_settings(self) -> PairSettings:
        """Return the settings for `make_pair`."""
        return PairSettings(self.overlap, self.sensors, self.rooms, self.scale, self.hard or None, self.over_stairs)

    @property
    def name(self) -> str:
        """A hash of the inputs and of what makes the file from them: the name of its files in a cache.

        A set for evaluation (`maps`) takes minutes, and its numbers must be those of the code as it stands: the name has the
        digest of all code and data that make its files. A set for training takes hours, and an edit that changes no bytes must
        not cost them: the name has the versions of the steps (`PAIR_FORMAT`, `graph.GRAPH_FORMAT`), which whoever changes their
        results raises, and the digest of the weights that the extraction reads, which change by training alone.
        """
        values = asdict(self)
        # These came later: at their defaults older names hold.
        later = {"maps": False, "more": (), "drifts": (), "signs": ""}
        values = {key: value for key, value in values.items() if key not in later or value != later[key]}
        maker = compute_code_digest(MAKER) if self.maps else compute_data_digest(EXTRACTION)
        inputs = [PAIR_FORMAT, graph.GRAPH_FORMAT, maker, convert_to_plain(values)]
        return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:24]


def compute_plan_digest(storeys: Sequence[Plan]) -> str:
    """Compute a hash of what plans contain, to a micrometre: the last bits of a reckoned number differ from one machine to the
    next."""
    text = json.dumps([_round_values(convert_to_plain(asdict(plan))) for plan in storeys], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _round_values(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _round_values(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_round_values(v) for v in value]
    return round(value, 6) + 0.0 if isinstance(value, float) else value  # + 0.0: no minus zero


def draw_items(recipe: Recipe, plans: Library) -> list[Item]:
    """Draw the items of a recipe, each from its own number: a longer set begins with the shorter one."""
    shelves = {source: _digest_plans(of) for source, of in plans.items()}
    return [replace(_draw(recipe, shelves, i), maps=recipe.maps) for i in range(recipe.pairs)]


@dataclass(frozen=True)
class _PlanDigests:
    """Digests by name of a source's single storeys, of its stacks, and of its stacks of storeys that are nearly alike."""

    singles: Mapping[str, str]
    stacks: Mapping[str, str]
    twins: Mapping[str, str]


def _digest_plans(plans: Mapping[str, tuple[Plan, ...]]) -> _PlanDigests:
    singles = {name: compute_plan_digest(p) for name, p in sorted(plans.items()) if len(p) == 1}
    stacks = {name: compute_plan_digest(p) for name, p in sorted(plans.items()) if len(p) > 1}
    return _PlanDigests(
        singles, stacks, {name: text for name, text in stacks.items() if count_matching_rooms(*plans[name][:2]) >= TWINS}
    )


def _draw(recipe: Recipe, shelves: Mapping[str, _PlanDigests], i: int) -> Item:
    rng, more = np.random.default_rng([recipe.seed, i]), np.random.default_rng([recipe.seed, i, 1])
    hard = _pick({**recipe.hard, "": max(1 - sum(recipe.hard.values()), 0.0)}, rng)
    overlap = float(recipe.overlaps[int(rng.integers(len(recipe.overlaps)))])
    source = _pick(recipe.sources, rng if hard != "other-storey" else more)
    shelf = shelves.get(source, _PlanDigests({}, {}, {}))
    of = shelf.twins if hard == "other-storey" else shelf.stacks if more.random() < recipe.stacks and not hard else {}
    if hard == "other-storey" and not of:
        source = "procedural"
    kind = _pick(recipe.kinds, rng) if source == "procedural" else ""
    storeys = 2 if hard == "other-storey" or rng.random() < recipe.two_storeys else 1
    if overlap == 0 and not hard:  # one corridor can't be in neither
        hard, storeys = ("", 2) if source == "procedural" or of else ("other-building", 1)
    digest_of = {} if source == "procedural" else of or shelf.singles
    storeys = storeys if source == "procedural" else 2 if of else 1
    walks = np.random.default_rng([recipe.seed, i, 2])
    further = tuple(_pick(recipe.sensors, walks) for _ in range(recipe.walks - 2)) if not hard and overlap > 0 else ()
    drifts = tuple(walks.choice(recipe.drifts, size=recipe.walks).tolist()) if recipe.drifts and further else ()
    reading = np.random.default_rng([recipe.seed, i, 51])
    signs = str(reading.choice(sorted(READERS))) if reading.random() < recipe.signs and hard in ("", "other-storey") else ""
    first, last = splits.get_seed_range(recipe.split)
    names = sorted(digest_of)
    chosen = [names[i] for i in rng.integers(len(names), size=CANDIDATES + 1)] if names else []
    seeds = rng.integers(first, last + 1, size=CANDIDATES + 1).tolist()
    digests = [digest_of[n] for n in chosen] or [""] * (CANDIDATES + 1)
    named = chosen or [str(s) for s in seeds]
    return Item(
        source=source,
        kind=kind,
        buildings=tuple(named[:CANDIDATES]),
        plans=tuple(digests[:CANDIDATES]),
        other=(named[-1], digests[-1]),
        seed=int(rng.integers(2**31)),
        storeys=storeys,
        overlap=overlap,
        sensors=(_pick(recipe.sensors, rng), _pick(recipe.sensors, rng)),
        rooms=int(rng.integers(recipe.rooms[0], recipe.rooms[1] + 1)),
        hard=hard,
        scale=bool(rng.random() < recipe.scale),
        difficulty=_sample_difficulty(recipe.spread, rng),
        voxel_size=recipe.voxel_size,
        points_per_room=recipe.points_per_room,
        more=further,
        drifts=drifts,
        signs=signs,
        over_stairs=bool(more.random() < recipe.over_stairs and not hard and storeys > 1),
    )


def _pick(weights: Mapping[str, float], rng: np.random.Generator) -> str:
    names = sorted(weights)
    share = np.array([weights[n] for n in names], float)
    return names[int(rng.choice(len(names), p=share / share.sum()))]


def _sample_difficulty(spread: float, rng: np.random.Generator) -> tuple[tuple[str, float], ...]:
    """Sample every number of the difficulty about its default."""
    drawn_fields = [f for f in fields(Difficulty) if f.name not in UNDRAWN]
    drawn = {f.name: round(float(f.default * rng.uniform(1 - spread, 1 + spread)), 3) for f in drawn_fields}  # type: ignore[operator]
    drawn = {name: value if name in ("furniture", "clutter", "people") else min(value, 1.0) for name, value in drawn.items()}
    drawn["half"] = min(drawn["half"], round(1 - drawn["open"], 3))
    return tuple(sorted(drawn.items()))


def get_difficulty(item: Item) -> Difficulty:
    """Return the item's difficulty; storeys are alike where that is what makes the item hard."""
    difficulty = Difficulty(**dict(item.difficulty))
    return replace(difficulty, differ=0.0) if item.hard == "other-storey" else difficulty


def select_plans(item: Item, plans: Library) -> Sequence[tuple[Plan, ...]]:
    """Select the storeys of the item's candidates and of its other building; empty for a procedural one."""
    of: Mapping[str, tuple[Plan, ...]] = plans.get(item.source, {})
    return [of[name] for name in (*item.buildings, item.other[0])] if of else []
