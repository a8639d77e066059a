"""Train an embedder: ``python train.py experiment=sage_pointnet data=train_small``; sweeps with -m, see configs/train.yaml.

Several processes: ``torchrun --nproc-per-node 2 train.py ...``. Without Hydra: ``python -m topomerge.training run.json``.
"""

from __future__ import annotations

import sys

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from topomerge.config import typed
from topomerge.errors import InputError
from topomerge.training.fit import fit
from topomerge.training.settings import Training, composed, known, with_recipe

known()
FLAGS = {"--overfit": "overfit=true", "--resume": "resume=true"}


def settings_of(config: DictConfig) -> Training:
    """The typed settings of one job; that of a sweep gets a folder of its own."""
    settings = composed(typed(config, with_recipe()))
    job = HydraConfig.get()
    if job.mode == RunMode.MULTIRUN:
        settings.runs, settings.name = str(job.sweep.dir), str(job.sweep.subdir)
    return settings


@hydra.main(version_base="1.3", config_path="pkg://topomerge.configs", config_name="train")
def main(config: DictConfig) -> float:
    """One run; its best score is what a sweep compares."""
    try:
        settings = settings_of(config)
        return fit(settings)[f"val/{settings.watch}"]
    except InputError as error:
        sys.exit(f"train: {error}")
    except KeyboardInterrupt:
        print("train: interrupted; go on with resume=true", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    sys.argv[1:] = [FLAGS.get(word, word) for word in sys.argv[1:]]
    main()
