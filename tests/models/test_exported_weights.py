"""A network starts from the weights of an exported one, and from no other's."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from topomerge.models.convolutional import DrawingProbabilities, DrawingUNet
from topomerge.models.export import export_network, load_exported_weights

from topomerge.archive import find_weights_file
from topomerge.errors import InputError
from topomerge.networks.drawing import DRAWING_FILE, DRAWING_SIGNATURE, load_drawing_network
from topomerge.networks.network import WEIGHTS_PACKAGE
from topomerge.training.drawing_segmentation import compute_dice_loss
from topomerge.training.loop import Exported
from topomerge.training.scan_settings import DrawingSegmentation
from topomerge.training.starts import start_from_exported
from topomerge.training.tasks import find_start, train

WIDTHS = [2, 2]  # an export of all levels takes seconds


def build(seed: int, widths: list[int] = WIDTHS) -> DrawingProbabilities:
    torch.manual_seed(seed)
    network = DrawingUNet(widths)
    for layer in network.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(layer.running_mean)
            torch.nn.init.uniform_(layer.running_var)
    return DrawingProbabilities(network).eval()


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of `build(1)`."""
    path = tmp_path_factory.mktemp("exported") / "one.onnx"
    export_network(build(1), DRAWING_SIGNATURE, [torch.rand(2, 3, 96, 64)], path)
    return path


@pytest.mark.longer
def test_weights_of_a_file_are_those_that_were_exported(exported: Path) -> None:
    first, second = build(1), build(2)
    picture = torch.rand(2, 3, 96, 64)
    assert not torch.allclose(first(picture), second(picture))
    load_exported_weights(second, exported)
    assert torch.equal(first(picture), second(picture))
    with pytest.raises(InputError, match="is another network than these settings make"):
        load_exported_weights(build(3, [2, 4]), exported)


@pytest.mark.parametrize("content", [b"not onnx", b"", None])
def test_what_is_no_network_is_told_in_one_line(content: bytes | None, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "one.onnx").write_bytes(content)
    with pytest.raises(InputError) as raised:
        load_exported_weights(build(1), tmp_path / "one.onnx")
    assert "\n" not in str(raised.value) and "one.onnx" in str(raised.value)


def test_dice_loss_of_what_is_right_is_none_and_absent_classes_do_not_count() -> None:
    truth = torch.tensor([[[0, 0], [0, 2]]])
    right = 50.0 * torch.nn.functional.one_hot(truth, 4).permute(0, 3, 1, 2)
    assert float(compute_dice_loss(right, truth)) == pytest.approx(0.0, abs=1e-6)
    missed = 50.0 * torch.nn.functional.one_hot(torch.zeros_like(truth), 4).permute(0, 3, 1, 2)
    assert float(compute_dice_loss(missed, truth)) == pytest.approx(1 - (2 * 3 / 7 + 0) / 2, abs=1e-6)


@dataclass
class Job:
    network: DrawingProbabilities
    origin: dict[str, str]

    def exported(self) -> Exported:
        return Exported(self.network, DRAWING_SIGNATURE, [])


@pytest.mark.longer
def test_a_training_starts_from_a_file_and_tells_which(exported: Path) -> None:
    first, job = build(1), Job(build(2), {"set": "drawings"})
    settings = DrawingSegmentation(init_from=str(exported))
    start_from_exported(job, settings)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), job.network.parameters(), strict=True))
    assert job.origin["set"] == "drawings" and len(job.origin["init_from"]) == 64
    with pytest.raises(InputError, match="init_from is for networks that are exported"):
        start_from_exported(object(), settings)


def test_a_run_is_a_start_and_what_is_none_is_told_before_data_is_made(tmp_path: Path) -> None:
    (tmp_path / "run" / "best").mkdir(parents=True)
    shutil.copy(find_weights_file(WEIGHTS_PACKAGE, DRAWING_FILE), tmp_path / "run" / "best" / "drawing_network.onnx")
    assert find_start("drawing_segmentation", str(tmp_path / "run")) == tmp_path / "run" / "best" / "drawing_network.onnx"
    settings = DrawingSegmentation(init_from=str(tmp_path), runs=str(tmp_path))
    with pytest.raises(InputError, match=r"^init_from=.*: holds no drawing_network.onnx; name a run of task=drawing_segm"):
        train(settings, print)


def test_the_network_that_ships_is_a_start() -> None:
    job = Job(build(1, DrawingSegmentation().widths), {})
    start_from_exported(job, DrawingSegmentation(init_from="pretrained"))
    picture = np.random.default_rng(0).random((1, 3, 64, 96), np.float32)
    (expected,) = load_drawing_network()(picture=picture)
    np.testing.assert_allclose(job.network(torch.tensor(picture)).detach().numpy(), expected, atol=1e-4)
