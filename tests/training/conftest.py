"""What several tests of training share."""

from __future__ import annotations

import pytest


@pytest.fixture
def unexported(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of the training alone: an export takes six seconds; without it `best/` keeps the weights of torch."""
    from topomerge.training.embedding import EmbeddingJob

    monkeypatch.setattr(EmbeddingJob, "export_best", lambda self, folder: None)
