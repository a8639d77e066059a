"""Evaluation: pairs of maps whose truth is known, predictions on disk, then scores (`python evaluate.py`)."""
