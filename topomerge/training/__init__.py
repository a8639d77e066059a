"""Training: from a cached set of pairs to an embedder (`python train.py`, or without Hydra `python -m topomerge.training`)."""
