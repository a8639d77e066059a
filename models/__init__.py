"""Geometry and node encoders, losses (installed as topomerge.models)."""

if __name__ != "topomerge.models":
    raise ImportError("import topomerge.models, not models: imported from the repository's root, every class would exist twice")
