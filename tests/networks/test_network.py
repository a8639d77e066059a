"""Networks at run time: they give what torch gives, files are trusted only as far as they can be, nothing is printed."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from topomerge.archive import find_weights_file
from topomerge.errors import InputError
from topomerge.extraction.elevations.elevation import WALL_SIGNATURE, compute_place_probabilities
from topomerge.extraction.plans.plan_network import GRID_NETWORK_FILE, PLAN_NETWORK_FILE, PLAN_SIGNATURE
from topomerge.networks.network import WEIGHTS_PACKAGE, Signature, Tensor, load_network, load_shipped_network, read_card
from topomerge.registration.places import PLACE_SIGNATURE
from topomerge.registry import TASKS
from topomerge.types import Array

SHIPPED = {
    PLAN_NETWORK_FILE: (PLAN_SIGNATURE, [(1, 11, 16, 16), (2, 11, 80, 144)]),
    GRID_NETWORK_FILE: (PLAN_SIGNATURE, [(1, 11, 48, 16)]),
    "wall_network.onnx": (WALL_SIGNATURE, [(1, 2, 32, 17), (3, 46, 32, 17)]),
    "place_network.onnx": (PLACE_SIGNATURE, [(1, 16, 16, 22), (7, 16, 16, 22)]),
}


def file_of(name: str) -> Path:
    return find_weights_file(WEIGHTS_PACKAGE, name)


def copied(name: str, folder: Path) -> Path:
    """A network that ships, and its card, elsewhere."""
    for path in (file_of(name), file_of(name).with_name(f"{Path(name).stem}.card.json")):
        shutil.copy(path, folder / path.name)
    return folder / name


def with_digest(path: Path) -> Path:
    """Its card names the file as it is: whoever means harm can do that."""
    card = path.with_name(f"{path.stem}.card.json")
    values = json.loads(card.read_text())
    card.write_text(json.dumps({**values, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}))
    return path


def random(*shape: int) -> Array:
    return np.random.default_rng(sum(shape)).random(shape).astype(np.float32)


def module_of(name: str):
    """The module of torch that a network was exported from, without its weights."""
    from topomerge.models.convolutional import (
        PlaceLogOdds,
        PlaceNetwork,
        PlanProbabilities,
        PlanUNet,
        WallNetwork,
        WallProbabilities,
    )

    widths = read_card(file_of(name))["settings"]["widths"]
    made = {"plan_network": (PlanUNet, PlanProbabilities), "grid_network": (PlanUNet, PlanProbabilities)}
    made |= {"wall_network": (WallNetwork, WallProbabilities), "place_network": (PlaceNetwork, PlaceLogOdds)}
    network, wrapped = made[Path(name).stem]
    return wrapped(network(widths))


@pytest.mark.parametrize("name", SHIPPED)
def test_what_ships_is_as_its_module_of_torch(name: str) -> None:
    pytest.importorskip("onnx")
    from topomerge.models.export import read_weights, run_with_torch

    signature, shapes = SHIPPED[name]
    module = module_of(name)
    left_out = module.load_state_dict(read_weights(file_of(name)), strict=False)
    assert not left_out.unexpected_keys and all(key.endswith("num_batches_tracked") for key in left_out.missing_keys)
    network, peer = load_shipped_network(name, signature), run_with_torch(module, signature)
    (argument,) = signature.inputs
    for shape in shapes:
        (ours,), (theirs,) = (run(**{argument: random(*shape)}) for run in (network, peer))
        assert ours.shape == theirs.shape and ours.dtype == np.float32 and np.abs(ours - theirs).max() < 1e-5
        assert np.array_equal(ours, network(**{argument: random(*shape)})[0])


@pytest.mark.longer
def test_a_network_that_was_trained_is_exported_as_it_is_and_always_to_the_same_bytes(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    from topomerge.models.convolutional import WallNetwork, WallProbabilities
    from topomerge.models.export import export_network, run_with_torch

    torch.manual_seed(0)
    net = WallNetwork([4, 6, 8, 8])
    net.train()
    net(torch.rand(4, 17, 12, 32))  # gives the normalisation something to know
    module, digests = WallProbabilities(net), set()
    for k in range(2):
        path = tmp_path / f"{k}.onnx"
        export_network(module, WALL_SIGNATURE, [torch.rand(2, 8, 32, 17)], path)
        digests.add(hashlib.sha256(path.read_bytes()).hexdigest())
        assert str(Path(__file__).parents[2]).encode() not in path.read_bytes()
    assert len(digests) == 1
    (tmp_path / "0.card.json").write_text(json.dumps({"sha256": digests.pop()}))
    strips = random(3, 46, 32, 17)
    (theirs,) = run_with_torch(module, WALL_SIGNATURE)(strips=strips)
    assert np.abs(load_network(tmp_path / "0.onnx", WALL_SIGNATURE)(strips=strips)[0] - theirs).max() < 1e-5
    with torch.no_grad():
        net.out.bias.fill_(np.nan)
    with pytest.raises(InputError, match=r"no finite numbers; training diverged"):
        export_network(module, WALL_SIGNATURE, [torch.rand(2, 8, 32, 17)], tmp_path / "nan.onnx")
    assert not (tmp_path / "nan.onnx").exists()


@pytest.mark.longer
def test_what_is_exported_normalises_enlarges_and_turns_nothing(tmp_path: Path) -> None:
    """The processor runs convolutions alone (docs/adr/0044); the function and the names of the weights stay."""
    torch, onnx = pytest.importorskip("torch"), pytest.importorskip("onnx")
    from topomerge.models.convolutional import PlanProbabilities, PlanUNet
    from topomerge.models.export import export_network, read_weights, run_with_torch

    torch.manual_seed(0)
    net = PlanUNet([4, 6, 6, 8, 6, 5, 4, 3])
    net.train()
    net(torch.rand(4, 11, 32, 48))  # gives the normalisation something to know
    module, path = PlanProbabilities(net), tmp_path / "plan.onnx"
    export_network(module, PLAN_SIGNATURE, [torch.rand(2, 11, 64, 48)], path)
    kinds = [node.op_type for node in onnx.load(path).graph.node]
    assert not {"BatchNormalization", "Resize", "Softmax"} & set(kinds) and kinds.count("DepthToSpace") == 4
    kept, state = read_weights(path), module.state_dict()
    assert len(kept) == 12 * 5 + 2 and all(torch.equal(value, state[name]) for name, value in kept.items())
    (tmp_path / "plan.card.json").write_text(json.dumps({"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}))
    network, peer = load_network(path, PLAN_SIGNATURE), run_with_torch(module, PLAN_SIGNATURE)
    for shape in ((1, 11, 16, 16), (2, 11, 80, 144)):
        (ours,), (theirs,) = (run(evidence=random(*shape)) for run in (network, peer))
        assert ours.shape == theirs.shape and np.abs(ours - theirs).max() < 1e-5


@pytest.mark.parametrize("name", SHIPPED)
def test_a_card_tells_what_the_network_does(name: str) -> None:
    card, (signature, _) = read_card(file_of(name)), SHIPPED[name]
    assert {key: card[key] for key in ("what", "inputs", "outputs")} == signature.describe()
    assert TASKS[card["task"]].file == card["file"] == name and f"task={card['task']}" in card["command"]
    assert card["sha256"] == hashlib.sha256(file_of(name).read_bytes()).hexdigest() and card["data"]["split"] == "train"


def test_strips_of_no_length_have_no_places() -> None:
    assert compute_place_probabilities(np.zeros((0, 32, 17))).shape == (0, 7)
    assert compute_place_probabilities(np.zeros((2, 0, 32, 17))).shape == (2, 0, 7)
    assert np.array_equal(
        compute_place_probabilities(random(46, 32, 17)), compute_place_probabilities(random(46, 32, 17)[None])[0]
    )


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda p: p.write_bytes(p.read_bytes()[:-200]), "cut off, damaged, or not the network that its card is about"),
        (lambda p: with_digest((p.write_bytes(p.read_bytes()[:-200]), p)[1]), "is no network that can be run"),
        (lambda p: with_digest((p.write_bytes(b""), p)[1]), "is no network that can be run"),
        (lambda p: with_digest((p.write_text("weights"), p)[1]), "is no network that can be run"),
        (lambda p: p.unlink(), "No such file"),
        (lambda p: p.with_name("place_network.card.json").unlink(), r"card\.json: .*copy a network together with its card"),
        (lambda p: p.with_name("place_network.card.json").write_text("{"), r"card\.json: damaged or cut off"),
        (lambda p: p.with_name("place_network.card.json").write_text("[]"), r"card\.json: is no card"),
    ],
)
def test_damaged_files_are_refused_in_one_line(spoil, message: str, tmp_path: Path, capfd) -> None:
    path = copied("place_network.onnx", tmp_path)
    spoil(path)
    with pytest.raises(InputError, match=rf"^[^\n]*{message}[^\n]*$"):
        load_network(path, PLACE_SIGNATURE)
    assert capfd.readouterr() == ("", "")


def test_networks_with_other_inputs_or_outputs_are_refused(tmp_path: Path) -> None:
    path, planes = copied("place_network.onnx", tmp_path), PLACE_SIGNATURE.inputs["planes"]
    for tensor in (
        replace(planes, shape=("squares", 16, 16, 23)),
        replace(planes, shape=("squares", 16)),
        replace(planes, dtype="uint8"),
    ):
        with pytest.raises(InputError, match=r"is of other inputs: planes is .* not .*; export it again"):
            load_network(path, Signature("", {"planes": tensor}, PLACE_SIGNATURE.outputs))
    with pytest.raises(InputError, match=r"other inputs: more is none"):
        load_network(path, Signature("", {"planes": planes, "more": planes}, PLACE_SIGNATURE.outputs))
    with pytest.raises(InputError, match=r"other outputs: log_odds is tensor\(float\) .*, not none"):
        load_network(path, Signature("", PLACE_SIGNATURE.inputs, {"odds": Tensor(("squares",), "")}))


def test_inputs_that_the_graph_can_not_take_are_an_error_of_one_line_and_nothing_is_printed(capfd) -> None:
    network = load_shipped_network(PLAN_NETWORK_FILE, PLAN_SIGNATURE)
    with pytest.raises(InputError, match=r"^[^\n]*plan_network\.onnx: can't be run[^\n]*$"):
        network(evidence=random(1, 11, 24, 17))
    assert capfd.readouterr() == ("", "")


@pytest.mark.longer
def test_importing_the_library_does_not_import_the_runtime() -> None:
    code = (
        "import sys, topomerge, topomerge.extraction.extract, topomerge.fusion.pipeline, topomerge.matching.match\n"
        "print([m for m in ('onnxruntime', 'onnx', 'torch') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]" and not done.stderr
