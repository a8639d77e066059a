"""Buildings, scanners, map pairs and readers of public data (installed as topomerge.datasets)."""

if __name__ != "topomerge.datasets":
    raise ImportError("import topomerge.datasets, not datasets: imported from the repository's root, every class would exist twice")
