"""An atlas in Rerun (extra `rerun`), live or as a file: cells, rooms, doors between them, and the links between maps.

Components stand side by side, as they share no frame. Each change is a step of the timeline `change`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from topomerge.errors import InputError
from topomerge.fusion.atlas.result import AtlasResult
from topomerge.io.rooms_ply import assign_room_colours
from topomerge.types import Sim3, TopometricMap

CELLS_SHOWN = 50_000  # of a component, at most
GAP = 5.0  # m between components
NO_LINK = (120, 120, 120)


class RerunLog:
    """A recording that atlases are logged to.

    Args:
        path: `.rrd` file; None: a viewer is opened, and shows what comes.

    Raises:
        InputError: rerun-sdk is missing, or the file can't be written.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        try:
            import rerun
        except ImportError as error:
            raise InputError("--rerun needs rerun-sdk: pip install 'topomerge[rerun]'") from error
        self._rerun: Any = rerun
        self._stream: Any = rerun.RecordingStream("topomerge")
        self._change = 0
        try:
            if path is None:
                self._stream.spawn()
            else:
                self._stream.save(path)
        except (OSError, RuntimeError, ValueError) as error:
            reason = " ".join(str(error).split())[:120]
            raise InputError(f"{path or 'the viewer of Rerun'}: can't be opened ({reason}); give another file") from error

    def log(self, result: AtlasResult, joined: Mapping[int, TopometricMap]) -> None:
        """Log an atlas as it is now.

        Args:
            joined: component -> its joined map; of a map alone it is that map.
        """
        rr, left = self._rerun, 0.0
        self._stream.set_time("change", sequence=self._change)
        self._stream.log("atlas", rr.Clear(recursive=True))
        for n, members in enumerate(result.components):
            map, pose = joined.get(n), Sim3()
            if map is None:
                map, pose = result.maps[members[0]], result.transforms[members[0]]
            low, high = _compute_bounds(map, pose)
            entity = f"atlas/component_{n}"
            self._stream.log(entity, rr.Transform3D(translation=[left - low[0], -low[1], 0.0]))
            self._log_map(entity, map, pose)
            self._log_links(entity, result, members)
            left += high[0] - low[0] + GAP
        self._stream.flush()
        self._change += 1

    def close(self) -> None:
        """Write what is left."""
        self._stream.flush()
        self._stream.disconnect()

    def _log_map(self, entity: str, map: TopometricMap, pose: Sim3) -> None:
        """Log cells, rooms and the ways between them."""
        rr, step = self._rerun, max(len(map.grid) // CELLS_SHOWN, 1)
        colours = np.vstack([assign_room_colours(map), [NO_LINK]])  # the last one is that of cells without a room
        cells = pose.apply(map.grid.compute_centroids()[::step])
        self._stream.log(f"{entity}/cells", rr.Points3D(cells, colors=colours[map.room[::step]], radii=map.grid.edge / 2))
        if not len(map.rooms):
            return
        lo, hi = map.rooms["lo"], map.rooms["hi"]
        boxes = rr.Boxes3D(
            centers=pose.apply((lo + hi) / 2),
            half_sizes=pose.scale * (hi - lo) / 2,
            rotation_axis_angles=[rr.RotationAxisAngle(axis=[0, 0, 1], radians=pose.yaw)] * len(lo),
            colors=colours[:-1],
            labels=[f"room {i}: {area:.0f} m²" for i, area in enumerate(map.rooms["area"])],
        )
        self._stream.log(f"{entity}/rooms", boxes)
        middles = map.rooms["centroid"]
        connections = [pose.apply(np.array([middles[e["rooms"][0]], e["centre"], middles[e["rooms"][1]]])) for e in map.edges]
        self._stream.log(f"{entity}/graph", rr.LineStrips3D(connections, radii=0.03))

    def _log_links(self, entity: str, result: AtlasResult, members: tuple[int, ...]) -> None:
        """Log where each map of a component begins, and the links between maps."""
        rr = self._rerun
        places = {k: np.array(result.transforms[k].translation) for k in members}
        names = [result.names[k] for k in members]
        self._stream.log(f"{entity}/maps", rr.Points3D(list(places.values()), labels=names, radii=0.2))
        links = [link for link in result.links if link.maps[0] in places]
        if links:
            strips = [np.array([places[k] for k in link.maps]) for link in links]
            labels = [f"{link.probability:.2f}" for link in links]
            self._stream.log(f"{entity}/links", rr.LineStrips3D(strips, labels=labels, radii=0.05))


def _compute_bounds(map: TopometricMap, pose: Sim3) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest place (3,) of a map under a pose, m."""
    cells = pose.apply(map.grid.compute_centroids())
    return cells.min(axis=0), cells.max(axis=0)
