"""Drawn floor plans: what is drawn of a storey, and the hands that draw it."""
