"""Hydra configuration files (installed as topomerge.configs)."""
