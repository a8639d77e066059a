"""Why a merge is believed, or not, in words and in numbers that a reader can weigh."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from topomerge.matching.poses import PoseHypothesis
from topomerge.registration.pipeline import Registration
from topomerge.registration.posterior import POSTERIOR, WORDS, evidence_limit, in_words

Row = tuple[str, str, str]  # evidence, value, meaning


def why(registration: Registration, threshold: float, force: bool = False) -> str:
    """One sentence: the verdict, what speaks for it and what against."""
    if registration.transform is None:
        return f"not merged: {registration.reason}"
    believed = registration.probability >= threshold
    f = registration.features
    sign = "reaches" if believed else "is below"
    words = [f"{'merged' if believed else 'not merged'}: probability {chance(registration.probability)} {sign} {threshold:.2f}"]
    words.append(f"{f['walls']:.0f} m2 of walls agree, {f['free']:.0f} m2 of free floor seen by both")
    words.append(f"{100 * f['conflict_share']:.1f} % of the walls stand on free floor of the other map")
    if not believed:
        if evidence_limit(f) < 1:
            words.append("the maps share too little area for a verdict")
        elif registration.posterior and (beside := in_words(registration.posterior, threshold)):
            words.append(beside)
    if force and not believed:
        words.append("joined anyway (--force)")
    return "; ".join(words)


def chance(probability: float) -> str:
    """A probability as text that never says that something is certain."""
    return "over 0.99" if probability > 0.99 else "below 0.01" if probability < 0.01 else f"{probability:.2f}"


def evidence_rows(registration: Registration) -> list[Row]:
    """What the best hypothesis was judged by: (evidence, value, meaning)."""
    if registration.transform is None:
        return []
    f = registration.features
    conflicts = f"{_percent(f['conflict_share'])} of the walls compared, {_percent(f['worst_conflict'])} in the worse map"
    furniture = f"{_percent(f['met'])} of it matches furniture of the other map; expected by chance: {_percent(f['chance'])}"
    rows = [
        ("matching walls", f"{f['walls']:.1f} m²", f"{_percent(f['ratio'])} of the walls both could have seen; evidence for"),
        ("shared free floor", f"{f['free']:.0f} m²", "seen empty by both maps; evidence for"),
        ("walls on free floor", f"{f['conflict']:.1f} m²", f"{conflicts}; evidence against"),
        ("walls back to back", _percent(f["opposed"]), "of the matching walls face opposite ways, as between neighbouring rooms"),
        ("furniture", f"{f['clutter']:.1f} m²", furniture),
        ("floors", f"{f['level']:.2f} m", "largest step between floors or ceilings that should coincide"),
    ]
    if f.get("ceiling_area", 0) > 0:
        words = f"difference over {f['ceiling_area']:.0f} m²; storeys with the same plan often differ here"
        rows.append(("ceilings", f"{f['ceilings']:.2f} m", words))
    rows += _winner_rows(f)
    if np.isfinite(f.get("rmse", np.nan)):
        rows.append(("surfaces", f"{100 * f['rmse']:.1f} cm", "RMS distance of matching surfaces"))
    if registration.places is not None and len(registration.places):
        odds = registration.places.log_odds
        words = f"{(odds > 0).sum()} look like the same place, {(odds <= 0).sum()} more like another one; coloured on the plan"
        rows.append(("places compared", f"{len(odds)}", words))
    if len(registration.alternatives) > 1:
        times = np.exp(min(f["margin"], 15.0))
        words = f"{times:,.0f} times as probable" if times >= 1.5 else "about as probable"
        rows.append(("lead over the next pose", words, "the best hypothesis against the next one, each judged alone"))
    return rows


def posterior_rows(registration: Registration) -> list[tuple[str, str]]:
    """What the place may be, in words, with its probability; most probable first."""
    each = registration.posterior
    names = sorted((n for n in POSTERIOR if each.get(n, 0.0) > 0), key=lambda n: -each[n])
    return [(WORDS[n], chance(each[n])) for n in names]


def _winner_rows(f: Mapping[str, float]) -> list[Row]:
    """What only the best hypothesis was asked (`winner_features`); joined maps of older versions do not have it."""
    if "moved_walls" not in f:
        return []
    rows = [
        ("walls in one direction", _percent(f["worst_ratio"]), "of the walls match along the worse of the two main directions"),
        ("squares of 3 m", f"{f['squares']:.0f}", f"with matching walls; {_percent(f['bad_squares'])} of all match poorly"),
        ("local misfit", _percent(f["moved_walls"]), "more walls match if squares of 6 m are moved separately"),
    ]
    if f["tall_conflict"] > 0:
        rows.append(("high walls on free floor", f"{f['tall_conflict']:.1f} m²", "higher than furniture; evidence against"))
    if f["hanging"] >= 1:
        words = f"of {f['hanging']:.0f} pieces of lamps, beams and ducts match; storeys do not share theirs"
        rows.append(("under the ceiling", f"{f['hanging_met']:.0f}", words))
    return rows


def hypothesis_row(rank: int, other: PoseHypothesis, best: PoseHypothesis, middle: Mapping[str, float] | np.ndarray) -> list[str]:
    """A hypothesis as text: rank, turn, distance from the best one, odds against it, walls, conflict."""
    at = np.asarray(middle, float)[None]
    away = float(np.linalg.norm(other.transform.apply(at) - best.transform.apply(at)))
    turn = (np.degrees(other.transform.yaw) + 180) % 360 - 180
    odds = np.exp(np.clip(other.score - best.score, -15, 15))
    f = other.features
    share = f"{100 * f['conflict_share']:.1f} %"
    return [str(rank), f"{turn:.1f}", f"{away:.1f}", f"{odds:.2g}", f"{f['walls']:.1f}", f"{f['free']:.0f}", share]


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
