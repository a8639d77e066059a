"""Trained networks at run time: their files (`.onnx`, each with a card), and ONNX Runtime, which runs them (docs/adr/0025)."""
