"""Build a cached set of extracted pairs: ``python -m topomerge.datasets.pairs.build data=train_small``.

The cache holds `pairs/<hash of the inputs>.npz`, or `.refused` with the reason, a manifest `<name>.jsonl` and its recipe
`<name>.recipe.json`. A build that was killed goes on where it was; the result has the same bytes. Work is shared out by joblib:
over processes of this machine (``jobs=2``), or over a Dask cluster (``cluster=tcp://host:8786``), whose workers must see the
cache under the same path.
Machines that share nothing make a part each (``part=[1,2]`` and ``part=[2,2]``); with the files of all parts in one cache, the
build without a part writes the whole manifest.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from topomerge.datasets.core.builder import BuildReport, build_set, check_sharing, run_script
from topomerge.datasets.pairs.example import make_file
from topomerge.datasets.pairs.items import Recipe, check, draw_items, load_library, select_plans

from topomerge.archive import convert_to_plain, replace_on_success


@dataclass
class Build:
    """Settings of a build; `part` [k, n] makes every n-th pair from the k-th on."""

    data: Recipe = field(default_factory=Recipe)
    cache: str = "cache"
    jobs: int = 1
    cluster: str | None = None
    part: list[int] = field(default_factory=lambda: [1, 1])


def build(settings: Build, log_line: Callable[[str], None] = lambda text: None, every: float = 10.0) -> BuildReport:
    """Make what is missing of a set, then write its manifest.

    Args:
        log_line: gets the progress, a line each `every` seconds.

    Raises:
        InputError: a recipe that nothing can be made of, or a cluster that can't be reached.
    """
    check(settings.data)
    check_sharing(settings)
    folder = Path(settings.cache).resolve() / "pairs"
    log_line("reading plans")
    plans = load_library(settings.data)
    first, step = settings.part
    items = {item.name: item for item in draw_items(settings.data, plans)[first - 1 :: step]}
    order = sorted(items.values(), key=lambda item: -item.rooms)  # the longest first: all workers end at about the same time
    tasks = [(item, list(select_plans(item, plans)), str(folder)) for item in order]
    report = build_set(folder.parent / f"{settings.data.name}.jsonl", tasks, make_file, settings, log_line, every)
    with replace_on_success(folder.parent / f"{settings.data.name}.recipe.json") as temporary:
        temporary.write_text(json.dumps(convert_to_plain(asdict(settings.data)), indent=1) + "\n", encoding="utf-8")
    return report


def main(overrides: list[str] | None = None) -> int:
    """Read the settings with Hydra, build, and print what came of it."""
    overrides = sys.argv[1:] if overrides is None else overrides
    if {"-h", "--help"} & set(overrides):
        print(f"{__doc__}\nKeys: configs/build.yaml and configs/data/*.yaml; for example data.pairs=100 cache=/tmp/cache jobs=2")
        return 0
    return run_script("build", lambda: _build_and_print(overrides))


def _build_and_print(overrides: list[str]) -> None:
    from topomerge.config import compose

    settings = compose("build", Build, overrides)
    report = build(settings, lambda text: print(f"build: {text}", file=sys.stderr, flush=True))
    each = f", {report.seconds / report.made:.2f} s of work each" if report.made else ""
    print(f"{report.manifest}: {report.items} pairs, {report.made} made now{each}, {sum(report.refused.values())} refused")
    for reason, count in report.refused.items():
        print(f"  {count} times: {reason}")


if __name__ == "__main__":
    sys.exit(main())
