"""Steps with a compiled network: the same network, trained, resumed, averaged and exported as without."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from tests.training import tiny
from topomerge.errors import InputError
from topomerge.training import compilation, wall_segmentation
from topomerge.training.compilation import CompiledNetwork, check_compilation
from topomerge.training.loop import ExportedJob
from topomerge.training.settings import Training, check
from topomerge.training.tasks import compose_settings, train

COMPILE = torch.compile
Words = Callable[..., list[str]]


@pytest.fixture
def words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Words:
    """Words of a small training, of which nothing is exported."""
    walls = tiny.wall_files(tmp_path / "walls", 4)
    monkeypatch.setattr(wall_segmentation, "build_walls", lambda *_: (walls, None))
    monkeypatch.setattr(ExportedJob, "export_best", lambda self, folder: None)
    sizes = ("epochs=1", "steps=3", "batch=2", "length=16", "hold_out=2", "widths=[2,2,4,4]", "ema=0.9", "logger=none")
    return lambda *more: ["task=wall_segmentation", f"runs={tmp_path / 'runs'}", f"cache={tmp_path}", *sizes, *more]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Compile with what needs no compiler of C++; whether the network was in training, of each call of what is compiled."""
    called: list[bool] = []

    def build(graph: Any, inputs: Any) -> Any:
        def run(*values: Any) -> Any:
            called.append(torch.is_grad_enabled())
            return graph.forward(*values)

        return run

    monkeypatch.setattr(torch, "compile", partial(COMPILE, backend=build))
    monkeypatch.setattr(compilation.shutil, "which", lambda name: name)
    return called


def quiet(text: str) -> None:
    """Say nothing."""


def read_weights(folder: Path, name: str) -> dict[str, torch.Tensor]:
    """The weights that a run ended with."""
    return load_file(folder / "runs" / name / "last" / "network.safetensors")


def test_steps_are_compiled_and_nothing_else(words: Words, calls: list[bool], tmp_path: Path) -> None:
    train(compose_settings(words("name=plain")), quiet)
    assert not calls
    train(compose_settings(words("name=compiled", "compile=true")), quiet)
    assert calls == [True] * 3  # steps; scores take no gradients
    plain, compiled = (read_weights(tmp_path, name) for name in ("plain", "compiled"))
    assert plain.keys() == compiled.keys() and not any("_orig_mod" in name for name in compiled)
    assert all(torch.allclose(plain[name], compiled[name], atol=1e-5) for name in plain)
    average = load_file(tmp_path / "runs" / "compiled" / "last" / "average.safetensors")
    assert average.keys() <= compiled.keys()


def test_a_compiled_run_goes_on_where_it_stopped(words: Words, calls: list[bool], tmp_path: Path, monkeypatch) -> None:
    train(compose_settings(words("name=whole", "compile=true")), quiet)
    step, seen = wall_segmentation.WallJob.train_step, []

    def cut(self: Any, batch: Any, state: Any) -> dict[str, float]:
        seen.append(1)
        if len(seen) == 2:
            os.kill(os.getpid(), 2)
        return step(self, batch, state)

    monkeypatch.setattr(wall_segmentation.WallJob, "train_step", cut)
    with pytest.raises(KeyboardInterrupt):
        train(compose_settings(words("name=cut", "compile=true")), quiet)
    monkeypatch.setattr(wall_segmentation.WallJob, "train_step", step)
    train(compose_settings(words("name=cut", "compile=true", "resume=true")), quiet)
    whole, resumed = (read_weights(tmp_path, name) for name in ("whole", "cut"))
    assert all(torch.equal(whole[name], resumed[name]) for name in whole)


@pytest.mark.longer
def test_what_was_compiled_is_exported_and_is_a_start(tmp_path: Path, words: Words, calls: list[bool], monkeypatch) -> None:
    monkeypatch.undo()
    walls = sorted((tmp_path / "walls").glob("*.npz"))
    monkeypatch.setattr(wall_segmentation, "build_walls", lambda *_: (walls, None))
    monkeypatch.setattr(torch, "compile", partial(COMPILE, backend="eager"))
    train(compose_settings(words("name=a", "compile=true")), quiet)
    strip = np.random.default_rng(0).random((1, 8, 32, 17)).astype(np.float32)
    first = wall_segmentation.read_network(tmp_path / "runs/a/best/wall_network.onnx")(strips=strip)[0]
    words_of = ("name=b", "compile=true", f"init_from={tmp_path / 'runs/a'}", "rate=1e-12", "ema=0")
    train(compose_settings(words(*words_of)), quiet)
    second = wall_segmentation.read_network(tmp_path / "runs/b/best/wall_network.onnx")(strips=strip)[0]
    assert np.abs(first - second).max() < 0.05
    assert json.loads((tmp_path / "runs/b/config.json").read_text())["compile"] is True


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"devices": 2}, "compile=true is for one process, not devices=2"),
        ({"anomaly": True}, "compile=true hides the operations that anomaly=true names"),
        ({"accelerator": "cuda"}, "compile=true cannot be combined with steps as CUDA graphs; add graphs=false"),
    ],
)
def test_what_it_cannot_be_combined_with_is_one_line(more: dict[str, Any], reason: str) -> None:
    check(Training(compile=True, graphs=False, accelerator="cuda"))
    with pytest.raises(InputError, match=reason):
        check(Training(compile=True, **more))


def test_a_machine_without_a_compiler_is_one_line(words: Words, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(InputError, match=r"needs a compiler of C\+\+, and no-such-compiler is not here"):
        train(compose_settings(words("compile=true")), quiet)
    monkeypatch.setattr(compilation.shutil, "which", lambda name: name)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    with pytest.raises(InputError, match="compile=true is for one process"):
        check_compilation(compose_settings(words("compile=true")))


def test_a_network_that_cannot_be_compiled_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(graph: Any, inputs: Any) -> Any:
        raise OSError("no headers\nof Python")

    monkeypatch.setattr(torch, "compile", partial(COMPILE, backend=fail))
    network = torch.nn.Linear(2, 1)
    compiled = CompiledNetwork(network)
    with (
        pytest.raises(InputError, match="compile=true: this network cannot be compiled here .*no headers of Python"),
        compiled.apply(),
    ):
        network(torch.ones(1, 2))
    with pytest.raises(RuntimeError, match="shapes cannot be multiplied"), CompiledNetwork(network).apply():
        raise RuntimeError("shapes cannot be multiplied")
    assert network(torch.ones(1, 2)).shape == (1, 1)  # as it was
