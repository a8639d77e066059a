"""The items that a recipe is drawn into, one a pair: everything that the bytes of a cached pair depend on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from topomerge.datasets.buildings.stack import alike
from topomerge.datasets.core.difficulty import Difficulty
from topomerge.datasets.core.plan import Plan
from topomerge.datasets.pairs.degrade import UNCHANGED, apart_in_time
from topomerge.datasets.pairs.pairs import PairSettings
from topomerge.datasets.pairs.recipe import Library, Recipe
from topomerge.datasets.plans import splits

from topomerge.code_digest import code_digest, data_digest
from topomerge.embedding import graph
from topomerge.io.listing import plain

# Raise it when the same item gives other bytes, by whatever step: simulation, extraction, truth. It is part of the files' names.
PAIR_FORMAT = 14
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
        change: what is done to the clouds before they are extracted, and how much (`degrade`).
        more: sensors of further maps of the building, in the same file (`several_maps`).
        drifts: of all its maps, times the usual drift; empty: the usual one.
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
    change: tuple[str, float] = UNCHANGED
    more: tuple[str, ...] = ()
    drifts: tuple[float, ...] = ()

    @property
    def pair_settings(self) -> PairSettings:
        """What `make_pair` is asked for."""
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
        later = {"maps": False, "change": UNCHANGED, "more": (), "drifts": ()}
        values = {key: value for key, value in values.items() if key not in later or value != later[key]}
        maker = code_digest(MAKER) if self.maps else data_digest(EXTRACTION)
        inputs = [PAIR_FORMAT, graph.GRAPH_FORMAT, maker, plain(values)]
        return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:24]


def digest(storeys: Sequence[Plan]) -> str:
    """Hash of what plans contain, to a micrometre: the last bits of a reckoned number differ from one machine to the next."""
    text = json.dumps([_rounded(plain(asdict(plan))) for plan in storeys], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    return round(value, 6) + 0.0 if isinstance(value, float) else value  # + 0.0: no minus zero


def draw_items(recipe: Recipe, plans: Library) -> list[Item]:
    """The items of a recipe, each from its own number: a longer set begins with the shorter one."""
    shelves = {source: _shelf(of) for source, of in plans.items()}
    items = [replace(_draw(recipe, shelves, i), maps=recipe.maps) for i in range(recipe.pairs)]
    changes = [(what, float(value)) for what, values in sorted(recipe.vary.items()) for value in values]
    return [replace(item, change=change) for item in items for change in changes or [UNCHANGED]]


@dataclass(frozen=True)
class _Shelf:
    """Digests by name of a source's single storeys, of its stacks, and of its stacks of storeys that are nearly alike."""

    singles: Mapping[str, str]
    stacks: Mapping[str, str]
    twins: Mapping[str, str]


def _shelf(plans: Mapping[str, tuple[Plan, ...]]) -> _Shelf:
    singles = {name: digest(p) for name, p in sorted(plans.items()) if len(p) == 1}
    stacks = {name: digest(p) for name, p in sorted(plans.items()) if len(p) > 1}
    return _Shelf(singles, stacks, {name: text for name, text in stacks.items() if alike(*plans[name][:2]) >= TWINS})


def _draw(recipe: Recipe, shelves: Mapping[str, _Shelf], i: int) -> Item:
    rng, more = np.random.default_rng([recipe.seed, i]), np.random.default_rng([recipe.seed, i, 1])
    hard = _pick({**recipe.hard, "": max(1 - sum(recipe.hard.values()), 0.0)}, rng)
    overlap = float(recipe.overlaps[int(rng.integers(len(recipe.overlaps)))])
    source = _pick(recipe.sources, rng if hard != "other-storey" else more)
    shelf = shelves.get(source, _Shelf({}, {}, {}))
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
    first, last = splits.seeds(recipe.split)
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
        difficulty=_difficulty(recipe.spread, rng),
        voxel_size=recipe.voxel_size,
        points_per_room=recipe.points_per_room,
        more=further,
        drifts=drifts,
        over_stairs=bool(more.random() < recipe.over_stairs and not hard and storeys > 1),
    )


def _pick(weights: Mapping[str, float], rng: np.random.Generator) -> str:
    names = sorted(weights)
    share = np.array([weights[n] for n in names], float)
    return names[int(rng.choice(len(names), p=share / share.sum()))]


def _difficulty(spread: float, rng: np.random.Generator) -> tuple[tuple[str, float], ...]:
    """Every number of the difficulty about its default."""
    drawn_fields = [f for f in fields(Difficulty) if f.name not in UNDRAWN]
    drawn = {f.name: round(float(f.default * rng.uniform(1 - spread, 1 + spread)), 3) for f in drawn_fields}  # type: ignore[operator]
    drawn = {name: value if name in ("furniture", "clutter", "people") else min(value, 1.0) for name, value in drawn.items()}
    drawn["half"] = min(drawn["half"], round(1 - drawn["open"], 3))
    return tuple(sorted(drawn.items()))


def difficulty_of(item: Item) -> Difficulty:
    """The item's difficulty; storeys are alike where that is what makes the item hard."""
    difficulty = apart_in_time(Difficulty(**dict(item.difficulty)), item.change)
    return replace(difficulty, differ=0.0) if item.hard == "other-storey" else difficulty


def plans_of(item: Item, plans: Library) -> Sequence[tuple[Plan, ...]]:
    """The storeys of the item's candidates and of its other building; empty for a procedural one."""
    of: Mapping[str, tuple[Plan, ...]] = plans.get(item.source, {})
    return [of[name] for name in (*item.buildings, item.other[0])] if of else []
