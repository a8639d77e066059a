"""Networks by ONNX Runtime against torch, eager: the weights that ship, one thread each.

Run from the root: ``python -m benchmarks.speed.networks``. Lines: `name ours peer ratio`, see `bench.print_line`; loading is not
timed.
"""

from __future__ import annotations

import numpy as np
from topomerge.models.convolutional import PlaceLogOdds, PlaceNetwork, PlanProbabilities, PlanUNet, WallNetwork, WallProbabilities
from topomerge.models.export import read_weights, run_with_torch

from benchmarks.speed.bench import print_line, time_best
from topomerge.extraction.elevations.elevation import WALL_NETWORK_FILE, WALL_SIGNATURE
from topomerge.extraction.plans.plan_network import PLAN_NETWORK_FILE, PLAN_SIGNATURE
from topomerge.networks.network import load_shipped_network
from topomerge.registration.places import PLACE_NETWORK_FILE, PLACE_SIGNATURE

AGREE = 1e-5
MODULES = {
    PLAN_NETWORK_FILE: (PLAN_SIGNATURE, lambda widths: PlanProbabilities(PlanUNet(widths))),
    WALL_NETWORK_FILE: (WALL_SIGNATURE, lambda widths: WallProbabilities(WallNetwork(widths))),
    PLACE_NETWORK_FILE: (PLACE_SIGNATURE, lambda widths: PlaceLogOdds(PlaceNetwork(widths))),
}


def main(sides: tuple[int, ...] = (256, 512, 1024), strip: int = 800, squares: int = 20) -> None:
    """Verify, then time a look at a plan of so many columns a side, a strip of so many elements, and so many squares at once.

    Raises:
        SystemExit: the two differ.
    """
    import torch

    torch.set_num_threads(1)
    shapes = [(f"plan_network_{side}", PLAN_NETWORK_FILE, (1, 11, side, side)) for side in sides]
    shapes += [
        ("wall_network", WALL_NETWORK_FILE, (1, strip, 32, 17)),
        ("place_network", PLACE_NETWORK_FILE, (squares, 16, 16, 22)),
    ]
    for name, file, shape in shapes:
        signature, make = MODULES[file]
        network = load_shipped_network(file, signature)
        module = make(network.card["settings"]["widths"])
        module.load_state_dict(read_weights(network.path), strict=False)
        peer, (argument,) = run_with_torch(module, signature), signature.inputs
        feeds = {argument: np.random.default_rng(0).random(shape, np.float32)}
        if np.abs(network(**feeds)[0] - peer(**feeds)[0]).max() > AGREE:
            raise SystemExit("the two differ")
        print_line(name, time_best(lambda: network(**feeds)), time_best(lambda: peer(**feeds)))  # noqa: B023


if __name__ == "__main__":
    main()
