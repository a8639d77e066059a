"""Parameters of the presets: each has its own, and says so.

Steps that follow one another: their seconds and news of them.
"""

from __future__ import annotations

from dataclasses import asdict, fields

import numpy as np
import pytest

from tests import scenes
from topomerge.errors import InputError
from topomerge.extraction.extract import extract
from topomerge.extraction.parameters import PRESETS, DefaultParameters, SharedParameters, ThesisParameters, resolve_parameters
from topomerge.progress import Stopwatch


def test_each_preset_has_only_what_it_uses() -> None:
    own = [{f.name for f in fields(PRESETS[name])} - {f.name for f in fields(SharedParameters)} for name in ("default", "thesis")]
    assert own[0] == {"door", "slice_door", "narrow", "walls"} and not own[0] & own[1]


@pytest.mark.parametrize(("preset", "key", "owner"), [("thesis", "door", "default"), ("default", "view_radius", "thesis")])
def test_a_parameter_of_the_other_preset_is_refused(preset: str, key: str, owner: str) -> None:
    for chosen in (preset, PRESETS[preset]):
        with pytest.raises(InputError) as error:
            extract(np.zeros((1, 3)), preset=chosen, **{key: 0.3})
        said = str(error.value)
        assert f"preset '{owner}', not of '{preset}', '{key}'" in said and "stem_height" in said and "\n" not in said


def test_unknown_names() -> None:
    with pytest.raises(InputError, match="unknown parameter 'rnge' of the extraction: preset 'thesis' has .*range"):
        resolve_parameters("thesis", {"rnge": 3})
    for preset in ("these", 5, SharedParameters()):
        with pytest.raises(InputError, match="unknown preset .* take one of default, thesis"):
            resolve_parameters(preset, {})  # type: ignore[arg-type]


def test_single_parameters_are_overridden() -> None:
    assert resolve_parameters("default", {"door": 0.7}) == DefaultParameters(door=0.7)
    assert resolve_parameters(ThesisParameters(range=4.0), {"view_radius": 1.0}) == ThesisParameters(range=4.0, view_radius=1.0)


@pytest.mark.parametrize("preset", ["default", "thesis"])
def test_a_map_tells_the_parameters_of_its_preset(preset: str) -> None:
    parameters = extract(scenes.two_rooms().points()[::3], voxel_size=0.15, preset=preset, carve=False).parameters
    beyond = {"voxel_size": 0.15, "preset": preset}
    if preset == "thesis":
        beyond["inflation"] = parameters["inflation"]
        assert parameters["inflation"] in ThesisParameters().inflations
    assert parameters == {**asdict(PRESETS[preset]), "carve": False, **beyond}


def test_each_step_ends_where_the_next_begins() -> None:
    news: list[tuple[float, str]] = []
    watch = Stopwatch(lambda done, text: news.append((done, text)))
    watch.begin("first", 0.0)
    watch.begin("second", 0.5)
    part = watch.build_part_progress(0.5, 0.9)
    assert part is not None
    part(0.5, "within")
    assert list(watch.seconds) == ["first"] and list(watch.end()) == ["first", "second"]
    assert news == [(0.0, "first"), (0.5, "second"), (0.7, "within")]
    assert Stopwatch().build_part_progress(0.0, 1.0) is None and Stopwatch().end() == {}
