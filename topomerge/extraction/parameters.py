"""Parameters of the extraction: those of the default preset and those of the thesis. Lengths are in metres."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from topomerge.errors import InputError


@dataclass(frozen=True, kw_only=True)
class SharedParameters:
    """Parameters of both presets: cells, navigable volume (seeds 2.3), free space. The defaults are ours; docs/adr/0003 says
    why."""

    level: bool = True  # tilted clouds are levelled first
    noise: float = 0.4  # cells with a smaller share of the usual number of neighbours are in nobody's way; 0: all are
    sparse: float = 3.5  # cells are doubled until they have that many neighbours of 26 (median): fewer are no surface; 0: never
    stem_height: float = 0.25  # a step may stand beside the foot
    body_width: float = 0.30
    # Higher than the thesis' body of 0.75 m: table tops under shelves are no floor (docs/adr/0003).
    body_height: float = 1.50  # with the stem 1.75: a grown-up
    dilation: float = 0.25
    bridge: float = 0.30  # half the gap in the floor that is bridged; 0: none
    ceilings: bool = False  # may the upper side of a ceiling be floor?
    largest_only: bool = False  # keep the largest component, or all that are floors
    assume: bool = True  # a floor for slices and for scans of the upper half of rooms
    carve: bool = True  # the space that rays crossed
    range: float = 5.0  # that views see (seeds 2.5: r_visibility), also those that carve

    @property
    def standing_height(self) -> float:
        """m, of somebody who stands on the floor: whatever is lower is no ceiling."""
        return self.stem_height + self.body_height


@dataclass(frozen=True, kw_only=True)
class DefaultParameters(SharedParameters):
    """The default: rooms from the plans of the storeys (docs/adr/0004)."""

    door: float = 0.5  # narrowings of the floor that are doors with this probability part rooms
    slice_door: float = 0.65  # … in slices of a 2D laser: there neither lintels nor tops of furniture are seen
    narrow: float = 0.2  # and with this one areas of a room: its zones (docs/adr/0047)
    walls: bool = True  # doors are looked for on walls, too: shut ones, and where open ones end (docs/adr/0018)


@dataclass(frozen=True, kw_only=True)
class ThesisParameters(SharedParameters):
    """The thesis: rooms from clusters of views (seeds 2.4 to 2.6; values of the finished thesis, docs/method.md).

    Of the shared parameters the thesis knows no levelling, noise or assumed floors; they are off and can be turned on one by one.
    """

    level: bool = False
    noise: float = 0.0
    sparse: float = 0.0
    body_height: float = 0.75
    bridge: float = 0.0
    ceilings: bool = True
    largest_only: bool = True
    assume: bool = False
    carve: bool = False
    view_radius: float = 0.5  # of the local maxima of the distance field (seeds 2.4.1: r)
    view_height: float = 1.6  # of the views above the floor (seeds 2.4.1: h)
    least_similarity: float = 0.3  # of two views; smaller ones are 0
    inflations: tuple[float, ...] = (1.2, 1.35, 1.5, 1.7, 1.9, 2.2, 2.5)  # the one of highest modularity is taken
    propagation_cells: float = 2.0  # radius of the neighbourhood, in cells as in the thesis
    propagation_rounds: int = 10
    least_volume: float = 0.128  # m3, of a room's occupied cells


Parameters = DefaultParameters | ThesisParameters
PRESETS: dict[str, Parameters] = {"default": DefaultParameters(), "thesis": ThesisParameters()}


def resolve_parameters(preset: str | Parameters, overrides: dict[str, Any]) -> Parameters:
    """Return the parameters of a preset, single ones overridden.

    Raises:
        InputError: an unknown preset, or a parameter that it does not have.
    """
    name = preset if isinstance(preset, str) else _get_preset_name(preset)
    if name not in PRESETS:
        raise InputError(f"unknown preset {preset!r}: take one of {', '.join(PRESETS)}")
    parameters = PRESETS[name] if isinstance(preset, str) else preset
    names = {f.name for f in fields(parameters)}
    for key in overrides:
        if key not in names:
            owner = next((other for other, p in PRESETS.items() if key in {f.name for f in fields(p)}), None)
            reason = "unknown parameter" if owner is None else f"parameter of the preset {owner!r}, not of {name!r},"
            raise InputError(f"{reason} {key!r} of the extraction: preset {name!r} has {', '.join(sorted(names))}")
    return replace(parameters, **overrides)


def _get_preset_name(parameters: object) -> str:
    """Return the preset of which an instance is a variant; its type's name where it is none."""
    return next((name for name, p in PRESETS.items() if type(p) is type(parameters)), type(parameters).__name__)
