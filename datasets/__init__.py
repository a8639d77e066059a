"""Buildings, scanners, map pairs and readers of public data (installed as topomerge.datasets)."""

if __name__ != "topomerge.datasets":
    raise ImportError("import topomerge.datasets, not datasets: every class would exist twice")
