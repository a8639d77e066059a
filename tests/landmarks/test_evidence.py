"""What landmarks say of a pose: by hand where there is one sign, by properties where there are many."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.scenes_map import building
from topomerge.landmarks.evidence import MOST_FAR, RATES, SEEN_CELLS, LandmarkEvidence, LandmarkScorer, score_landmarks
from topomerge.landmarks.likelihood import ALTERNATIVES, KINDS, NEAR, READERS, RENEWED, SIDE_BY_SIDE
from topomerge.landmarks.sightings import MOST_SIGHTINGS, build_sightings
from topomerge.registration.posterior import POSTERIOR
from topomerge.types import Landmarks, Sim3, build_landmarks, join_landmarks, move_landmarks

HALL = building(pairs=3)
UNIFORM = dict.fromkeys(ALTERNATIVES, 1 / len(ALTERNATIVES))


def places(count, spread=2.0):
    """(count, 3) on a grid over the map, `spread` m apart."""
    low, high = HALL.grid.bounds
    across = max(int((high - low)[0] // spread), 1)
    k = np.arange(count)
    return low + np.column_stack([k % across * spread, k // across * spread, np.full(count, 1.0)])


def with_signs(texts, at=None, kind="text", **columns):
    at = places(len(texts)) if at is None else np.asarray(at, float)
    return replace(HALL, landmarks=build_landmarks(kind, texts, "test", at, **columns))


def score(first, second, pose=None, **columns):
    return score_landmarks(with_signs(first, **columns), with_signs(second, **columns), pose or Sim3())


def lead(evidence):
    """Log odds of this place against each other one."""
    return {name: -ratio for name, ratio in evidence.compute_likelihoods().items() if name != "here"}


NUMBERS = ["2.113", "2.114", "2.115", "2.116", "2.117", "2.118"]


def test_alternatives_are_those_of_the_posterior():
    assert ALTERNATIVES == POSTERIOR


def test_one_sign_each_by_hand():
    evidence = score(["2.113"], ["2.113"])
    stays = (1 - KINDS["text"].changed) * (1 - SIDE_BY_SIDE[0])
    times = stays * KINDS["text"].most + 1 - stays  # 600 times rarer than by chance, whoever reads: capped
    here = np.log((1 - RENEWED) * times + RENEWED / 2)
    repeats = KINDS["text"].repeats["storey"]
    storey = np.log(1 - repeats + repeats * times)
    assert evidence.factors["text"]["here"] == pytest.approx(here)
    assert evidence.factors["text"]["storey"] == pytest.approx(storey)
    assert evidence.list_sentences() == ["sign 2.113 agrees; nothing contradicts"]


def test_another_number_at_the_place_contradicts_by_hand():
    evidence = score(["2.113"], ["4.850"])
    stays = (1 - KINDS["text"].changed) * (1 - SIDE_BY_SIDE[0])
    misread = sum(w * 600 * (1 - 2 * e) ** 0 * (2 * e * 0.7 * 0.4 / 15) ** 4 for e, w in READERS)
    assert evidence.factors["text"]["here"] == pytest.approx(
        np.log((1 - RENEWED) * (1 - stays + stays * misread) + RENEWED / 2 * (1 - NEAR["wing"])), abs=1e-6
    )
    assert evidence.factors["text"]["here"] < np.log(0.1) and min(lead(evidence).values()) < -1.5
    assert evidence.list_sentences() == ["signs contradict: 2.113 against 4.850"]


@pytest.mark.parametrize(
    ("one", "other", "sentences"),
    [
        ("Salida", "Salid", ["sign cut off: Salid may be Salida"]),
        ("Ausgang", "Notausgang", ["sign cut off: Ausgang may be Notausgang"]),
        ("2.113", "2.1", ["sign cut off: 2.1 may be 2.113"]),
        ("2.113", "2.11", []),
        ("Bahnhofstr", "Bahnhof", ["sign Bahnhofstr agrees; nothing contradicts"]),
        ("Salida", "Sali", ["sign cut off: Sali may be Salida"]),
        ("Salida", "Sa", ["signs contradict: Salida against Sa"]),
        ("Salida", "Salud", ["signs contradict: Salida against Salud"]),
        ("Notausgang", "Notausga7g", []),
        ("Notausgang", "Haupteingang", ["signs contradict: Notausgang against Haupteingang"]),
        ("2.113.004", "2.113.005", ["signs contradict: 2.113.004 against 2.113.005"]),
    ],
)
def test_a_text_that_lost_an_end_contradicts_nothing(one, other, sentences):
    assert score([one], [other]).list_sentences() == sentences


def test_an_exit_sign_says_little_and_one_on_every_door_nothing():
    common, rare = lead(score(["EXIT"], ["EXIT"])), lead(score(["2.113"], ["2.113"]))
    assert max(common.values()) < 1.0 and min(rare.values()) > 3.0
    everywhere = score(["101"] * 40, ["101"] * 40)
    assert max(abs(v) for v in lead(everywhere).values()) < 2.0


def test_each_agreeing_sign_adds_up_to_the_odds_of_repeated_numbers():
    leads = [lead(score(NUMBERS[:n], NUMBERS[:n])) for n in range(1, 7)]
    for name in ALTERNATIVES[1:]:
        of = [each[name] for each in leads]
        assert all(np.diff(of) > -1e-9), name
        assert of[-1] < -np.log(KINDS["text"].repeats[name]) + 0.01 < of[-1] + 1.0, name


@pytest.mark.parametrize(("change", "worst"), [("3.1", "storey"), ("2.3", "wing")])
def test_numbers_of_another_storey_or_wing_speak_for_it(change, worst):
    evidence = score(NUMBERS, [n.replace("2.1", change) for n in NUMBERS])
    assert lead(evidence)[worst] < -4.0
    assert evidence.apply(UNIFORM)["here"] < 0.01


def test_numbers_that_count_on_are_another_part_of_the_row():
    assert score(NUMBERS, ["2.119", "2.120", "2.121", "2.122", "2.123", "2.124"]).apply(UNIFORM)["here"] < 0.01


def test_a_changed_sign_does_not_undo_the_others():
    changed = lead(score(NUMBERS, [*NUMBERS[:4], "4.870", "2.118"]))
    assert min(changed.values()) > 2.5


def test_of_a_room_with_two_doors_the_sign_of_the_same_door_is_compared():
    """Both doors bear one number and face opposite ways, the readings of either nearer to those of the other one."""
    doors, others = places(1)[0] + [[0, 0, 0], [0.8, 0, 0]], places(8)[2:]
    headings = np.array([0.0, np.pi, *[0.0] * 6])
    first, second = (np.concatenate([doors + shift, others]) for shift in ([[0, 0, 0]] * 2, [[0.5, 0, 0], [-0.5, 0, 0]]))
    a, b = (with_signs(["2.200", "2.200", *NUMBERS], at, number=headings) for at in (first, second))
    assert [len(build_sightings(m, ("text",))) for m in (a, b)] == [8, 8]
    evidence = score_landmarks(a, b, Sim3())
    assert not [w for w in evidence.witnesses if w.verdict == "contradicts"]
    alone = score_landmarks(*(with_signs(NUMBERS, others, number=headings[2:]) for _ in range(2)), Sim3())
    assert evidence.support > alone.support - 0.5


def test_swapped_signs_do_not_undo_the_others():
    assert min(lead(score(NUMBERS * 1, [NUMBERS[1], NUMBERS[0], *NUMBERS[2:]])).values()) > 2.0


def test_one_spoofed_sign_does_not_carry_what_others_contradict():
    evidence = score(NUMBERS, [NUMBERS[0], "5.301", "5.302", "5.303", "5.304", "5.305"])
    assert evidence.apply({**dict.fromkeys(ALTERNATIVES, 0.05), "here": 0.7})["here"] < 0.2
    alone = score(NUMBERS[:1], NUMBERS[:1])
    assert alone.apply({**dict.fromkeys(ALTERNATIVES, 0.0), "here": 0.01, "wing": 0.99})["here"] < 0.5


def test_bad_readers_still_agree():
    read = ["2.1l3", "2.174", "Z.115", "2.116", "2.l77", "2.118"]
    assert min(lead(score(NUMBERS, read)).values()) > 2.5


def test_a_rare_string_far_away_speaks_for_another_pose():
    at = places(6, 3.0)
    a, b = with_signs(NUMBERS, at), with_signs(NUMBERS, at + (20.0, 0, 0))
    evidence = score_landmarks(a, b, Sim3())
    assert lead(evidence)["elsewhere"] <= -MOST_FAR and lead(evidence)["storey"] > 0  # they begin alike
    assert {w.verdict for w in evidence.witnesses} == {"elsewhere"}
    assert min(lead(score_landmarks(a, b, Sim3(translation=(-20.0, 0, 0)))).values()) > 3.0


def test_numbers_that_only_one_map_read_tell_the_storey_by_how_they_begin():
    at = places(12)
    odd = [f"2.1{k}" for k in range(20, 26)]
    for texts, sign in (
        (["2.231", "2.Z33", "3.235", "2.237", "2.239", "2.241"], 1),
        (["4.231", "4.233", "4.235", "4237", "A.239", "4.241"], -1),
    ):
        a, b = with_signs(odd, at[:6]), with_signs(texts, at[6:])
        leads = lead(score_landmarks(a, b, Sim3()))
        assert sign * leads["storey"] > 1.5 and abs(leads["half"]) < 1.0, leads
    far = with_signs(odd, at[:6] + (0, 0, 4.0))
    assert lead(score_landmarks(far, with_signs(["4.231"] * 3, at[6:9]), Sim3()))["storey"] == 0  # of two storeys: nothing


def test_tags_nearly_settle_it():
    tags = ["tag36h11:12", "tag36h11:97"]
    assert min(lead(score(tags, tags, kind="tag")).values()) > 3.8
    assert lead(score(tags, ["tag36h11:13", "tag36h11:98"], kind="tag"))["wing"] < -3.0
    turned = score_landmarks(with_signs(tags, kind="tag", number=0.0), with_signs(tags, kind="tag", number=3.0), Sim3())
    assert min(lead(turned).values()) < 0.0


def test_a_tag_that_the_other_map_lacks_speaks_for_another_place_by_hand():
    first, second = places(4, 3.0)[:2], places(4, 3.0)[2:]
    a, b = with_signs(["tag:1", "tag:2"], first, "tag"), with_signs(["tag:8", "tag:9"], second, "tag")
    leads = lead(score_landmarks(a, b, Sim3()))
    one, other = RATES[:, None], RATES[None]
    alone = (one + other) / (one + other - one * other)  # of a tag that one map has: by chance both would be alike likely
    by_hand = np.log(np.mean(((1 - one) * alone) ** 2 * ((1 - other) * alone) ** 2))
    assert leads["wing"] == pytest.approx(by_hand, rel=0.3) and leads["storey"] == pytest.approx(
        leads["wing"]
    )  # as far as both saw
    assert leads["wing"] < -1.0
    far = score_landmarks(a, with_signs(["tag:8", "tag:9"], second, "tag"), Sim3(translation=(300.0, 0, 0)))
    assert not far.factors  # nobody saw these places
    assert not score_landmarks(a, HALL, Sim3()).factors  # a map whose camera reads no tags says nothing
    found = score_landmarks(with_signs(["tag:1", "tag:2", "tag:3"], places(4, 3.0)[:3], "tag"), a, Sim3())
    assert min(lead(found).values()) > 2.5  # one of three is missing


def test_many_tags_are_bounded_work():
    rng = np.random.default_rng(0)
    at = rng.uniform(*HALL.grid.bounds, (2000, 3))
    many = with_signs([f"tag:{k}" for k in range(2000)], at, "tag")
    other = with_signs([f"tag:{k}" for k in range(5000, 7000)], at[::-1], "tag")
    assert LandmarkScorer(many, other).around["tag"][0].shape == (MOST_SIGHTINGS, SEEN_CELLS, 3)
    assert score_landmarks(many, other, Sim3()).compute_likelihoods()["wing"] > 3.0


def test_names_and_objects_say_little():
    for kind, value in (("name", "kitchen"), ("object", "chair")):
        same, other = score([value], [value], kind=kind), score([value], ["sofa"], kind=kind)
        assert 0 < lead(same)["outside"] < 2.5 and -2.1 < lead(other)["outside"] <= 0, kind


def test_a_name_with_a_number_is_read_as_a_sign():
    a, b = with_signs(["2.113"]), with_signs(["2.113"], kind="name", sigma=1.0)
    assert list(score_landmarks(a, b, Sim3()).factors) == ["text"]


def test_without_a_position_the_room_tells():
    room = 1
    b = replace(HALL, landmarks=build_landmarks("text", ["2.113"], "by hand", room=room))
    a = with_signs(["2.113"], [HALL.rooms["centroid"][room] + (0.5, 0, 1.0)])
    assert lead(score_landmarks(a, b, Sim3()))["outside"] > 2.0
    assert lead(score_landmarks(a, b, Sim3(translation=(60.0, 0, 0))))["elsewhere"] < -1.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e300])
def test_positions_that_are_none_say_nothing(bad):
    assert not score(NUMBERS, NUMBERS, at=np.full((6, 3), bad)).factors


def test_kinds_that_one_map_lacks_say_nothing():
    assert not score_landmarks(with_signs(NUMBERS), HALL, Sim3()).factors
    assert not score_landmarks(with_signs(NUMBERS), with_signs(["tag:1"], kind="tag"), Sim3()).factors
    assert LandmarkEvidence().apply(UNIFORM) == pytest.approx(UNIFORM)


@pytest.mark.parametrize("count", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_many_landmarks_are_bounded_work(count):
    rng = np.random.default_rng(0)
    table = np.zeros(count, build_landmarks("text", ["x"], "t").table.dtype)
    many = build_landmarks("text", [f"{k}" for k in range(1000)], "hostile")
    table["value"], table["position"] = rng.integers(1000, size=count), rng.uniform(0, 20, (count, 3))
    table["room"] = table["storey"] = table["group"] = -1
    table["confidence"] = 1.0
    hostile = replace(HALL, landmarks=Landmarks(table, many.values, many.sources))
    assert len(build_sightings(hostile, ("text",))) <= MOST_SIGHTINGS
    assert np.isfinite(list(score_landmarks(hostile, hostile, Sim3()).factors["text"].values())).all()


def test_another_pose_that_signs_speak_for_as_much_is_a_rival():
    good, none = score(NUMBERS, NUMBERS), LandmarkEvidence()
    even = {**dict.fromkeys(ALTERNATIVES, 0.0), "here": 0.5, "elsewhere": 0.5}
    assert good.apply(even, [(1.0, none)])["here"] > 0.95
    assert good.apply(even, [(1.0, good)])["here"] == pytest.approx(2 / 3, abs=0.01)  # half of elsewhere is that pose
    assert good.apply(even, [(0.001, good), (0.999, none)])["here"] > 0.95


TEXTS = st.lists(st.sampled_from([*NUMBERS, "3.113", "EXIT", "WC", "101", "Z.1l3", "Dr. Meier", ""]), min_size=1, max_size=6)


@settings(max_examples=12, deadline=None)
@given(TEXTS, TEXTS, st.floats(-3, 3), st.floats(-5, 5), st.sampled_from(["text", "name", "tag", "object"]))
@example(["2.116", "2.118", "2.118", "2.118"], ["2.117", "2.117"], 2.0, 1.0, "text")  # one counts on, one back
def test_the_maps_may_be_given_in_any_order(first, second, yaw, shift, kind):
    pose = Sim3(yaw, (shift, 1.0, 0.0))
    a = with_signs(first, kind=kind)
    b = with_signs(second, pose.inverse().apply(places(len(second)) + (0.4, 0.1, 0)), kind=kind)
    one, other = score_landmarks(a, b, pose), score_landmarks(b, a, pose.inverse())
    assert one.factors.keys() == other.factors.keys()
    for k, factor in one.factors.items():
        assert factor == pytest.approx(other.factors[k], abs=1e-6)
    assert sorted(w.inverse().values for w in one.witnesses) == sorted(w.values for w in other.witnesses)


@settings(max_examples=8, deadline=None)
@given(TEXTS, TEXTS, st.floats(-3, 3), st.floats(-500, 500))
def test_the_common_frame_does_not_matter(first, second, yaw, shift):
    a, b = with_signs(first, number=0.5), with_signs(second, number=0.7)
    move = Sim3(yaw, (shift, -shift, 3.0))
    moved = [replace(m, grid=m.grid, landmarks=move_landmarks(m.landmarks, move)) for m in (a, b)]
    before, after = score_landmarks(a, b, Sim3()), score_landmarks(moved[0], b, move)
    factor = before.factors.get("text", {}), after.factors.get("text", {})
    for name in ("here", "storey", "half", "wing"):  # what a map could have seen is asked of its cells, which stay here
        assert factor[0].get(name, 0) == pytest.approx(factor[1].get(name, 0), abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "factor", "sentences"),
    [
        ("radio", {"here": 3.0}, ["radio speaks for the same place"]),
        ("pressure", {"storey": 2.0}, ["air pressure speaks for another storey with the same plan"]),
        ("tag", {"building": 1.5}, ["tags speak as a whole for another building"]),
        ("radio", {"here": 1.0}, []),
        ("radio", {"here": 3.0, "wing": 2.5}, []),
    ],
)
def test_kinds_without_single_witnesses_are_told_in_words(kind, factor, sentences):
    evidence = LandmarkEvidence({kind: dict.fromkeys(ALTERNATIVES, 0.0) | factor})
    assert evidence.list_sentences() == evidence.serialise()["sentences"] == sentences


def test_what_radio_denies_is_not_told_as_uncontradicted():
    signs = score(["2.113"], ["2.113"])
    factors = dict(signs.factors) | {"radio": dict.fromkeys(ALTERNATIVES, 0.0) | {"storey": 4.0}}
    told = replace(signs, factors=factors).list_sentences()
    assert told == ["sign 2.113 agrees", "radio speaks for another storey with the same plan"]


def test_joined_kinds_are_one_factor_each():
    both = replace(
        HALL,
        landmarks=join_landmarks([with_signs(NUMBERS).landmarks, with_signs(["tag:1"], kind="tag").landmarks]),
    )
    evidence = score_landmarks(both, both, Sim3())
    assert list(evidence.factors) == ["text", "tag"]
    assert evidence.support == pytest.approx(sum(f["here"] - f["outside"] for f in evidence.factors.values()))
    listed = evidence.serialise()
    assert listed["sentences"] == ["signs 2.113, 2.114, 2.115 and 3 more agree", "tag tag:1 agrees; nothing contradicts"]
    against = replace(evidence.witnesses[0], verdict="contradicts")
    doubted = replace(evidence, witnesses=(*evidence.witnesses, against)).list_sentences()
    assert doubted[0].endswith("signs contradict: 2.113 against 2.113") and "nothing contradicts" not in " ".join(doubted)
    assert set(listed["factors"]["tag"]) == set(ALTERNATIVES) and listed["witnesses"][0]["values"] == ["2.113", "2.113"]
