"""Names of the package's face that were renamed are still importable."""

from __future__ import annotations

import pytest

import topomerge


@pytest.mark.parametrize("old", sorted(topomerge._RENAMED))
def test_an_old_name_gives_what_the_new_one_gives(old):
    assert getattr(topomerge, old) is getattr(topomerge, topomerge._RENAMED[old])
    assert old not in topomerge.__all__


def test_a_name_that_never_was_is_refused():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        topomerge.nothing  # noqa: B018
