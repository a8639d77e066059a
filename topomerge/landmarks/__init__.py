"""Testimony beyond walls: what signs, tags, radio, pressure, objects and names say of a pose."""
