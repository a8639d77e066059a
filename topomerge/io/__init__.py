"""Points, maps and exports: everything that reads or writes files."""

from topomerge.io.points import read_chunks, read_points

__all__ = ["read_chunks", "read_points"]
