"""The network that looks at plans: our convolutions against torch's, with the same weights and one thread.

Run from the root: ``python -m benchmarks.speed.plan_network``. Lines: `name ours peer ratio`, see `bench.line`; compiling is not
timed.
"""

from __future__ import annotations

import numpy as np
from topomerge.models.plan_unet import PlanUNet, exported_weights

from benchmarks.speed.bench import best, line
from topomerge.extraction.plans.plan_network import EVIDENCE_CHANNELS, forward

NETWORK_WIDTHS = (32, 64, 96, 96, 96, 64, 32, 16)  # of configs/task/plan_segmentation.yaml
AGREE = 1e-4  # of scores


def main(sides: tuple[int, ...] = (256, 512, 1024)) -> None:
    """Verify, then time one look at a plan of so many columns a side.

    Raises:
        SystemExit: the two differ.
    """
    import torch

    torch.manual_seed(0)
    torch.set_num_threads(1)
    network = PlanUNet(NETWORK_WIDTHS).eval()
    weights = exported_weights(network)
    for side in sides:
        x = np.random.default_rng(0).random((EVIDENCE_CHANNELS, side, side)).astype(np.float32)
        image = torch.from_numpy(x[None])
        with torch.inference_mode():
            if np.abs(forward(x, weights) - network(image)[0].numpy()).max() > AGREE:
                raise SystemExit("the two differ")
            line(f"plan_network_{side}", best(lambda: forward(x, weights)), best(lambda: network(image)))  # noqa: B023


if __name__ == "__main__":
    main()
