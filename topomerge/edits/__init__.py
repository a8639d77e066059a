"""Corrections by hand: a journal of edits beside a map, and the map that they make of it."""
