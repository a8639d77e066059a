"""Train a learned part: ``python train.py task=plan_segmentation data=plan_scans``; see configs/train.yaml and configs/task/.

python train.py experiment=sage_pointnet data=train_small           the task is embedding where none is named
python train.py -m geometry=engineered,pointnet node=none,gat       a sweep
python train.py search=optuna search.space.rate=[1e-4,1e-2,log]     a search
torchrun --nproc-per-node 2 train.py ...                            several processes, for every network
python -m topomerge.training run.json                               without Hydra, for embedding
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NoReturn

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from topomerge.code_digest import find_other_clone
from topomerge.config import name_by_sweep
from topomerge.errors import InputError
from topomerge.training.search import compose_search, search_settings
from topomerge.training.tasks import compose_settings, convert_settings, prepare_words, train

FLAGS = {f"--{word}": f"{word}=true" for word in ("overfit", "resume", "overwrite")}


def print_progress(text: str) -> None:
    """Report the progress."""
    print(text, file=sys.stderr, flush=True)


def stop() -> NoReturn:
    """End after Ctrl-C."""
    print("train: interrupted; go on with resume=true", file=sys.stderr)
    sys.exit(130)


@hydra.main(version_base="1.3", config_path="pkg://topomerge.configs", config_name="train")
def main(config: DictConfig) -> float:
    """One run; its best score is what a sweep compares."""
    try:
        settings = convert_settings(config)
        job = HydraConfig.get()
        if job.mode == RunMode.MULTIRUN:  # each run of a sweep gets a folder of its own
            settings.runs, settings.name = str(job.sweep.dir), str(job.sweep.subdir) or settings.name
            begun = any((settings.folder / name).exists() for name in ("last", "last.new", "best"))
            settings.resume = settings.resume and begun
        return train(settings, print_progress)[f"val/{settings.watch}"]
    except InputError as error:
        sys.exit(f"train: {error}")
    except KeyboardInterrupt:
        stop()


if __name__ == "__main__":
    if other := find_other_clone(Path(__file__)):
        print_progress(f"train: {other}")
    words = [FLAGS.get(word, word) for word in sys.argv[1:]]
    try:
        ready = prepare_words(words)
        if search := compose_search(words):
            result = search_settings(search, words, print_progress)
            print(f"{result.table.read_text(encoding='utf-8')}\n{result.describe()}")
            sys.exit()
        if not any(word.startswith("-") or word.startswith("hydra") for word in words):
            compose_settings(words)  # a wrong key is one line, where Hydra says ten
        sys.argv[1:] = name_by_sweep(ready)
    except InputError as error:
        sys.exit(f"train: {error}")
    except KeyboardInterrupt:
        stop()
    main()
