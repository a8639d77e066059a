"""One office building mapped in three years by robots of the STRANDS project (published with ROSE2, Luperto et al.).

The maps' relation is not published. It was measured: walls correlated over all turns in steps of 3° and then 0.5° on rasters of
0.5 and 0.25 m, refined by `sources.fit_walls`, and looked at as overlay. The map of 2017 goes on from that of 2016 in the same
frame, so these two agree to the pixel where nothing has moved; 2015 was mapped on its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import combinations
from pathlib import Path

import numpy as np
from topomerge.datasets.pairs.flat_maps import FlatMap, build_flat_pair, read_flat
from topomerge.datasets.pairs.pairs import Pair

from topomerge.types import Sim3

SESSIONS = {
    "2015": "strands_morse/tsc/maps/tsc.yaml",
    "2016": "strands_maps/strands_maps/tsc_y3/maps/tsc20160523.yaml",
    "2017": "strands_maps/strands_maps/tsc_y4/maps/tsc_1701.yaml",
}
INTO_2016 = {  # session -> 2016; the fit of 2015 to 2017 differs from that to 2016 by 0.02° and 2 cm
    "2015": Sim3(np.radians(-70.438), (-2.454, -18.402, 0.0)),
    "2016": Sim3(),
    "2017": Sim3(),
}


def iter_pairs(folder: Path) -> Iterator[tuple[str, Callable[[], Pair]]]:
    """Yield the name and maker of each of the three pairs."""
    read = cache(lambda session: read_flat(folder / SESSIONS[session]))
    for number, (a, b) in enumerate(combinations(SESSIONS, 2)):
        yield f"tsc-{a}-{b}", partial(_load_pair, read, a, b, number)


def _load_pair(read: Callable[[str], FlatMap], a: str, b: str, seed: int) -> Pair:
    truth = INTO_2016[a].inverse() @ INTO_2016[b]
    return build_flat_pair(f"tsc-{a}-{b}", read(a), read(b), truth, ("laser2d", "laser2d"), "strands", "tsc", seed)
