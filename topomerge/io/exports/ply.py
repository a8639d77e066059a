"""The occupied cells as coloured points: the PLY that `extract --ply` and `merge` write."""

from __future__ import annotations

from topomerge.io.rooms_ply import save_rooms_ply as save

__all__ = ["save"]
