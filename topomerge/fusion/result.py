"""What a merge gives: whether two maps belong together, where, which rooms are the same, and the joined map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from topomerge.fusion.atlas.contradictions import contradiction_to_json
from topomerge.fusion.bend.deformation import Deformation
from topomerge.fusion.bend.placement import Placement, bend_to_json, placements, with_bends
from topomerge.fusion.evidence.places import Places
from topomerge.fusion.registration import Registration
from topomerge.io.listing import plain
from topomerge.matching.listing import map_to_entry
from topomerge.types import Array, Sim3, TopometricMap, between_files
from topomerge.writers import WRITERS

if TYPE_CHECKING:
    from topomerge.fusion.atlas.result import AtlasResult

MERGE_FORMAT = 1
MERGE_STEPS = ("read", "extract", "embed", "match", "fuse")


@dataclass(frozen=True)
class RoomMatch:
    """A room of one map that is a room of another.

    Args:
        maps: which maps, by their place in the list that was merged.
        rooms: one room of each.
        probability: that they are one (of the merge, times `odds.match_probability`).
    """

    maps: tuple[int, int]
    rooms: tuple[int, int]
    probability: float


@dataclass(frozen=True, eq=False)
class MergeResult:
    """What `merge` gives.

    Args:
        status: "merged" or "abstained".
        probability: that the best transform is right, calibrated on simulated pairs.
        reason: in words.
        transforms: k -> T_0k, which maps points of map k into the frame of map 0; empty where nothing is believed. Of files that
            were tilted see `file_transforms`.
        matches: rooms that are one under the transforms.
        seconds: of ``embed``, ``match`` and ``fuse`` (registration, fusing, extracting rooms again); ``read`` and ``extract``
            are 0 where the maps were made before.
        map: the joined map with the provenance of its cells (bit k: map k saw it), or None.
        maps: what was merged.
        registration: the evidence, of two maps.
        atlas: the evidence, of more than two.
        warnings: what the user should know.
        descriptor: of the rooms, by which they were matched where walls were not believed.
        bends: k -> how map k is bent in its own frame, before its transform is applied; rigid ones are left out.
        points: k -> name of the file beside merge.json that holds the points of map k, of those that `merge --points` wrote.
    """

    status: str
    probability: float
    reason: str
    transforms: Mapping[int, Sim3] = field(default_factory=dict)
    matches: tuple[RoomMatch, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    map: TopometricMap | None = None
    maps: tuple[TopometricMap, ...] = ()
    registration: Registration | None = None
    atlas: AtlasResult | None = None
    warnings: tuple[str, ...] = ()
    descriptor: str = ""
    bends: Mapping[int, Deformation] = field(default_factory=dict)
    points: Mapping[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.status not in ("merged", "abstained"):
            raise ValueError(f"status must be merged or abstained, not {self.status!r}")
        if self.map is not None:  # whoever has only the joined map can bend what it was joined of, too
            object.__setattr__(self, "map", with_bends(self.map, list(self.placements.values())))

    @property
    def merged(self) -> bool:
        """Is the merge to be trusted?"""
        return self.status == "merged"

    @property
    def placements(self) -> dict[int, Placement]:
        """k -> where the points of map k lie in the joined frame, of every map that is part of it; none where nothing is."""
        return {p.map: p for p in placements(self.maps, self.transforms, self.bends)} if self.transforms else {}

    @property
    def file_transforms(self) -> dict[int, Array]:
        """k -> (4, 4) float64 that takes points of the file of map k into the frame of that of map 0: as `transforms` do, unless
        a cloud was tilted and has been levelled."""
        into = self.maps[0].levelling if self.transforms else np.eye(4)
        return {k: between_files(pose, self.maps[k].levelling, into) for k, pose in self.transforms.items()}

    def save(self, folder: str | Path) -> None:
        """Write merge.json and report.html, and where there is a joined map merged.ply and map.tmap; all of them or none.

        Files of an earlier merge are replaced, or removed where this one has none; others in the folder are left alone.

        Raises:
            InputError: the folder can't be made or written.
        """
        WRITERS["merge"](self, folder)


def merge_to_json(result: MergeResult) -> dict[str, Any]:
    """`merge.json` as plain values: see docs/outputs.md. Numbers are not rounded: national grids need all digits."""
    registration = result.registration
    rmse = registration.features.get("rmse", float("nan")) if registration else float("nan")
    residuals = result.atlas.residuals if result.atlas else {1: rmse}
    matrices = result.file_transforms
    transforms = {str(k): transform_to_json(pose, residuals[k], matrices[k]) for k, pose in result.transforms.items()}
    listing = {
        "format": MERGE_FORMAT,
        "status": result.status,
        "probability": min(max(float(result.probability), 0.0), 1.0),
        "reason": result.reason,
        "descriptor": result.descriptor,
        "maps": [map_to_entry(m) for m in result.maps],
        "transforms": transforms,
        "bend": {str(k): bend_to_json(result.maps[k], p) for k, p in result.placements.items() if p.bend is not None},
        "matches": [{"maps": m.maps, "rooms": m.rooms, "probability": round(m.probability, 4)} for m in result.matches],
        "seconds": {step: round(float(result.seconds.get(step, 0.0)), 4) for step in MERGE_STEPS},
        "points": {str(k): name for k, name in sorted(result.points.items())},
        "alternatives": {name: round(p, 6) for name, p in registration.posterior.items()} if registration else {},
        "places": places_to_json(registration.places) if registration and registration.places else [],
        "contradictions": [contradiction_to_json(c) for c in result.atlas.contradictions] if result.atlas else [],
    }
    plain_listing: dict[str, Any] = plain(listing)
    return plain_listing


def places_to_json(places: Places) -> list[dict[str, Any]]:
    """What each place says as plain values: where its middle is in the frame of the first map, m, how much floor both maps saw of
    it, m2, and the log odds that it is one place and no look-alike."""
    c = places.crops
    each = zip(c.middle.tolist(), c.area.tolist(), places.log_odds.tolist(), strict=True)
    return [{"at": [round(v, 2) for v in at], "m2": round(m2, 1), "log_odds": round(odds, 2)} for at, m2, odds in each]


def transform_to_json(pose: Sim3, rmse: float, matrix: Array, into: int = 0) -> dict[str, Any]:
    """A pose in the frame of another map as plain values.

    Args:
        rmse: of its surfaces, or of its measurements, m; nan where there are none.
        matrix: (4, 4), the pose between the files of both maps (`between_files`).
        into: the other map.
    """
    return {
        "into": into,
        "matrix": matrix.tolist(),
        "scale": pose.scale,
        "yaw_deg": pose.yaw * 57.29577951308232,
        "rmse_m": rmse if rmse == rmse else None,  # nan: slices have no planes to measure it by
    }
