"""topomerge: rooms, doors and storeys out of partial indoor maps, matched and merged across sensors."""

__version__ = "0.1.0"
