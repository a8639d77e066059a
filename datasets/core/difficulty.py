"""What makes a building and a session hard, one number each."""

from __future__ import annotations

from dataclasses import dataclass, fields

from topomerge.errors import InputError


@dataclass(frozen=True)
class Difficulty:
    """Shares are 0 to 1; the defaults are an ordinary, tidy building.

    Args:
        lintels: share of doors with a lintel; the others reach the ceiling.
        ceiling_spread: m, standard deviation of the rooms' ceilings about the storey's.
        furniture: density; 0 is an empty building, 1 a tidy one, 2 crammed.
        clutter: boxes, bags and bins on the floor of 10 m2.
        windows: share of the windows that are there.
        glass: share of the walls to corridors that are glazed.
        open, half: shares of the doors that stand open and half open; the others are shut.
        lamps: share of the rooms with lamps hanging below the ceiling.
        beams: share of the rooms with beams.
        columns: share of the large rooms with columns.
        slopes: share of the top storey's rooms with a sloped ceiling.
        curved: share of the plans with a round or slanted part.
        differ: share of the upper storeys with a plan of their own; the others repeat the one below.
        atria: share of buildings of two or more storeys with a hall through two of them.
        moved: share of the movable things that stand elsewhere at the next session; as many again by less than 0.3 m.
        gone: share of the movable things that are gone at the next session.
        doors_moved: share of the doors that stand differently at the next session.
        people: persons a room at the next session.
        ducts: share of the rooms with ducts, trays or rows of panels under the ceiling.
        closets: share of the larger rooms beside a corridor out of which a closet is cut.
        spread: how much rooms of a kind differ in width: share that are half as wide again or more.
        frames: share of the doors with a frame around them and handles, whose leaves stand anywhere in the wall's thickness; the
            leaves of the others lie in the wall's face.
        niches: share of the longer walls with a recess, as deep as what is behind allows.
    """

    lintels: float = 0.9
    ceiling_spread: float = 0.1
    furniture: float = 1.3
    clutter: float = 0.8
    windows: float = 0.9
    glass: float = 0.05
    open: float = 0.6
    half: float = 0.2
    lamps: float = 0.4
    beams: float = 0.2
    columns: float = 0.3
    slopes: float = 0.1
    curved: float = 0.1
    differ: float = 0.3
    atria: float = 0.3
    moved: float = 0.2
    gone: float = 0.1
    doors_moved: float = 0.3
    people: float = 0.2
    ducts: float = 0.25
    closets: float = 0.12
    spread: float = 0.2
    frames: float = 0.0
    niches: float = 0.0

    def __post_init__(self) -> None:
        limits = {"furniture": 3.0, "clutter": 5.0, "people": 5.0}
        for name in (f.name for f in fields(self)):
            value, limit = getattr(self, name), limits.get(name, 1.0)
            if not 0 <= value <= limit:
                raise InputError(f"difficulty {name} must be 0 to {limit:g}, not {value}")
        if self.open + self.half > 1:
            raise InputError(f"difficulty: open {self.open} + half {self.half} must not exceed 1")
