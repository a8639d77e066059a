"""Steps that follow one another: their seconds and news of them."""

from __future__ import annotations

from topomerge.extraction.stopwatch import Stopwatch


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
