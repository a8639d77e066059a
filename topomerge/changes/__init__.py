"""Changes between two maps of one place, and between a building model and a scan of it."""
