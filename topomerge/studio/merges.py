"""Two maps over each other: what a merge says of itself, decisions about it, and maps that are placed by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.edits.journal import append_edits, build_edit, find_journal, read_journal, select_effective
from topomerge.errors import InputError
from topomerge.fusion.pipeline import format_probability
from topomerge.registration.pipeline import register
from topomerge.studio.folder import StudioFolder, read_listing
from topomerge.studio.maps import OpenMap, OpenMaps
from topomerge.studio.plans import lift_places
from topomerge.types import Array, Deformation, Sim3, TopometricMap, convert_pose_to_maps
from topomerge.viz.merge_plan import CUT_HEIGHT, deform_path

MOST_PAIRS = 200  # of rooms that are one
MOST_SHOWN = 20  # lines of one kind of evidence
VERDICTS = {"accept": "accept_merge", "reject": "reject_merge"}
DECISIONS = {
    "accept_merge": "accepted",
    "reject_merge": "rejected",
    "place_map": "placed by hand",
    "match_rooms": "rooms matched",
}


def find_sources(folder: StudioFolder, path: Path, listing: Mapping[str, Any]) -> list[Path | None]:
    """Find the maps that were merged: in the folder, under the name that merge.json has; None where there is none.

    Args:
        folder: of the studio.
        path: of the merge.
        listing: its merge.json.
    """
    found = []
    for one in listing.get("maps", []):
        name = Path(str(one.get("source", "")) if isinstance(one, dict) else "").name
        stem = Path(name).stem
        places = [place / n for place in (folder.root, path.parent, path) for n in (name, f"{stem}.tmap", f"{name}.tmap")]
        maps = (p for p in places if p.suffix == ".tmap" and p.is_file() and p.resolve().is_relative_to(folder.root))
        found.append(next(maps, None))
    return found


def describe_merge(folder: StudioFolder, maps: OpenMaps, path: Path) -> dict[str, Any]:
    """Describe a merge to the page: verdict, evidence, where its maps lie, rigid and bent, and what was decided.

    Args:
        folder: of the studio.
        maps: that are open.
        path: the folder of the merge.
    """
    listing = read_listing(path / "merge.json")
    sources = find_sources(folder, path, listing)
    opened = [None if source is None else maps.load(source) for source in sources]
    transforms = listing.get("transforms") or {}
    described = []
    for k, (source, held) in enumerate(zip(sources, opened, strict=True)):
        about = listing["maps"][k]
        name = Path(str(about.get("source", ""))).name
        entry = {"name": name, "rooms": about.get("rooms"), "path": None if source is None else folder.name(source)}
        entry["matrix"] = _find_matrix(transforms, k, held, opened[0])
        entry["bent"] = _draw_bent((listing.get("bend") or {}).get(str(k)), held)
        described.append(entry)
    probability = listing.get("probability")
    facts = [
        ("Probability", format_probability(float(probability)) if isinstance(probability, int | float) else "–"),
        ("Matched rooms", str(len(listing.get("matches") or []))),
        ("Maps in it", f"{len(transforms) + 1 if transforms else 0} of {len(described)}"),
        *[(f"Turned by, {described[int(k)]['name']}", f"{t['yaw_deg']:.1f}°") for k, t in sorted(transforms.items())],
        *[
            (f"Residual, {described[int(k)]['name']}", f"{100 * t['rmse_m']:.1f} cm")
            for k, t in transforms.items()
            if t["rmse_m"]
        ],
    ]
    landmarks = (listing.get("evidence") or {}).get("landmarks") or {}
    return {
        "status": str(listing.get("status", "damaged")),
        "reason": str(listing.get("reason", "")),
        "facts": facts,
        "maps": described,
        "proposed": bool(transforms),
        "alternatives": sorted((listing.get("alternatives") or {}).items(), key=lambda one: -one[1]),
        "landmarks": [str(one.get("words", one)) for one in (landmarks.get("witnesses") or [])[:MOST_SHOWN]],
        "contradictions": [str(one.get("words", one)) for one in (listing.get("contradictions") or [])[:MOST_SHOWN]],
        "settle": [str(one.get("words", one)) for one in (listing.get("settle") or [])[:MOST_SHOWN]],
        "decisions": _list_decisions(path),
        "report": folder.name(path / "report.html") if (path / "report.html").is_file() else None,
        "joined": folder.name(path / "map.tmap") if (path / "map.tmap").is_file() else None,
    }


def _format_residual(rmse: float | None) -> str:
    return "not measured" if rmse is None else f"{100 * rmse:.1f} cm"


def _find_matrix(transforms: Mapping[str, Any], k: int, held: OpenMap | None, first: OpenMap | None) -> list[Any] | None:
    """T_0k between the maps; None where map k has no place."""
    if held is None or first is None or (k and str(k) not in transforms):
        return None
    matrix = np.array(transforms[str(k)]["matrix"], float) if k else np.eye(4)
    listed: list[Any] = convert_pose_to_maps(matrix, held.base.levelling, first.base.levelling).tolist() if k else matrix.tolist()
    return listed


def _draw_bent(bend: Any, held: OpenMap | None) -> list[str] | None:
    """The walls of each storey as they are bent; None of a map that is rigid."""
    if bend is None or held is None or held.drawn is None:
        return None
    deformation = Deformation.from_json(bend)
    floors = held.base.storeys["floor"]
    return [
        deform_path(walls, held.drawn.sheet, deformation, (float(floors[s]) if len(floors) else 0.0) + CUT_HEIGHT)[1]
        for s, walls in enumerate(held.list_walls())
    ]


def _list_decisions(path: Path) -> list[str]:
    edits = select_effective(read_journal(find_journal(path)).edits)
    return [" · ".join(w for w in (DECISIONS.get(e.op, e.op), e.by, e.time[:16].replace("T", " ")) if w) for e in edits]


def decide(folder: StudioFolder, path: Path, wish: Mapping[str, Any]) -> tuple[str, ...]:
    """Write what somebody decided into the journal of a merge.

    Args:
        folder: of the studio.
        path: of the merge.
        wish: `verdict`: "accept" or "reject", and `by`.

    Returns:
        Words of the command that merges anew.

    Raises:
        InputError: there is nothing to decide.
    """
    listing = read_listing(path / "merge.json")
    sources, verdict, by = find_sources(folder, path, listing), wish.get("verdict"), str(wish.get("by", ""))[:64]
    if verdict not in VERDICTS or len(sources) != 2 or None in sources:
        raise InputError(f"{path.name}: only a merge of two maps of the folder can be accepted or rejected")
    values: dict[str, Any] = {"maps": [0, 1]}
    if verdict == "accept":
        transforms = listing.get("transforms") or {}
        if "1" not in transforms:
            raise InputError(f"{path.name}: has no pose that could be accepted; match the maps by hand")
        values["matrix"] = transforms["1"]["matrix"]
    append_edits(find_journal(path), [build_edit(VERDICTS[verdict], by, **values)])
    names = [folder.format_word(source) for source in sources if source is not None]
    return ("merge", *names, "-o", folder.format_word(path))


def place_pair(maps: OpenMaps, paths: Sequence[Path], wish: Mapping[str, Any]) -> dict[str, Any]:
    """Place the second map on the first: by pairs of places that are one, or by a pose; then refine it by the walls.

    Args:
        maps: that are open.
        paths: of the two maps.
        wish: `pairs`: [{at: [[x, y], [x, y]], storeys: [s, t]}], two or more; or `matrix`: T_ab.

    Returns:
        `matrix` (T_ab) and `words`: what speaks for it.

    Raises:
        InputError: not two maps, too few pairs, or no matrix.
    """
    if len(paths) != 2 or any(path.suffix.lower() != ".tmap" for path in paths):
        raise InputError("two maps are placed at a time; choose two")
    a, b = (maps.load(path).map for path in paths)
    if "matrix" in wish:
        pose = _parse_pose(wish["matrix"])
    else:
        sides = _parse_pairs(wish.get("pairs"))
        pose = fit_level_pose(*(_lift_side(m, side) for m, side in zip((a, b), sides, strict=True)))
    found = register(a, b, proposed=[pose], searched=False)
    placed = found.transform or pose
    shift = float(np.linalg.norm(placed.apply(b.grid.bounds[0][None]) - pose.apply(b.grid.bounds[0][None])))
    words = [found.reason, f"Probability {format_probability(found.probability)}", f"Refined by {shift:.2f} m."]
    return {"matrix": placed.matrix.tolist(), "words": words, "probability": found.probability}


def _lift_side(map: TopometricMap, side: Array) -> Array:
    """(n, 3) m of places x, y and storey."""
    return np.concatenate([lift_places(map, place[None, :2], int(place[2])) for place in side])


def _parse_pose(listed: Any) -> Sim3:
    try:
        return Sim3.from_matrix(np.array(listed, float))
    except (ValueError, TypeError) as error:
        raise InputError(f"the pose is none ({error})") from error


def _parse_pairs(listed: Any) -> tuple[Array, Array]:
    """(n, 3) x, y and storey of the places in the one and in the other map."""
    try:
        sides = np.array([[[*place, storey] for place, storey in zip(p["at"], p["storeys"], strict=True)] for p in listed], float)
    except (TypeError, KeyError, ValueError) as error:
        raise InputError("pairs of places are wanted: at and storeys of each") from error
    if sides.ndim != 3 or sides.shape[1:] != (2, 3) or not 2 <= len(sides) <= MOST_PAIRS or not np.isfinite(sides).all():
        raise InputError(f"two to {MOST_PAIRS} pairs of places are wanted")
    return sides[:, 0], sides[:, 1]


def fit_level_pose(ours: Array, theirs: Array) -> Sim3:
    """Fit the level pose that takes places (n, 3) of one map to those of another with least squares (Umeyama 1991)."""
    middle, other = ours.mean(axis=0), theirs.mean(axis=0)
    p, q = (theirs - other)[:, :2], (ours - middle)[:, :2]
    yaw = float(np.arctan2((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum(), (p * q).sum()))
    turned = Sim3(yaw).apply(other[None])[0]
    return Sim3(yaw, tuple((middle - turned).tolist()))
