"""Settings of the tasks of `train.py` but `embedding` (`training.settings`), as Hydra composes them: configs/task/<task>.yaml."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from topomerge.datasets.pairs.grid_pairs import GridRecipe
from topomerge.datasets.pairs.lookalikes import LookalikeRecipe
from topomerge.datasets.pairs.plan_examples import PlanRecipe
from topomerge.datasets.pairs.recipe import Recipe

LOOKALIKES_TAKEN = ("none", "judged", "fitted")


@dataclass
class TaskSettings:
    """What every task has.

    Args:
        task: which of the learned parts.
        name: of the run; its folder is `runs`/`name`.
        cache: folder of the data, which is made where it is missing, by so many processes (`jobs`), or those of a Dask cluster.
        part: [k, n]: make every n-th item of the data from the k-th on, for machines that share nothing.
        resume: go on where the run of this name stopped.
        export: where the best weights go at the end: `package`, or a folder; empty: they stay in the run's.
    """

    task: str = ""
    name: str = "run"
    runs: str = "runs"
    cache: str = "cache"
    seed: int = 0
    jobs: int = 1
    cluster: str | None = None
    part: list[int] = field(default_factory=lambda: [1, 1])
    resume: bool = False
    tensorboard: bool = True
    export: str = ""

    @property
    def folder(self) -> Path:
        """Where the run is written."""
        return Path(self.runs) / self.name


@dataclass
class NetworkTask(TaskSettings):
    """What tasks that train a network have besides.

    Args:
        epochs: at most; rate: of learning; decay: of weights; batch: examples a step.
        patience: epochs without a better validation after which it ends; 0: never.
        hold_out: every n-th scan is watched and trains nothing.
        watch: what is best: a score of validation.
    """

    epochs: int = 10
    batch: int = 8
    rate: float = 2e-3
    decay: float = 1e-3
    patience: int = 0
    hold_out: int = 8
    watch: str = ""


@dataclass
class PlanLoss:
    """Weights in the cross-entropy.

    Args:
        classes: of the five classes (`plan_network.CLASSES`).
        unseen: of columns of which nothing is known.
    """

    classes: list[float] = field(default_factory=lambda: [1.0, 2.0, 4.0, 6.0, 1.0])
    unseen: float = 0.05


@dataclass
class PlanAugment:
    """What is taken away from crops while training, now and then.

    Args:
        upper: share of crops without ceiling or without floor.
        columns: share of crops that lose single columns; lost: share of these, drawn between 0 and this.
    """

    upper: float = 0.2
    columns: float = 0.3
    lost: float = 0.3


@dataclass
class PlanSegmentation(NetworkTask):
    """Args:
    steps: of an epoch; warmup: steps in which the rate rises.
    crop: columns of a side, a multiple of 16.
    widths: channels of the levels a to d down, and e to h up again.
    """

    task: str = "plan_segmentation"
    name: str = "plan_segmentation"
    data: PlanRecipe = field(default_factory=PlanRecipe)
    heldout: PlanRecipe = field(default_factory=PlanRecipe)
    epochs: int = 27
    steps: int = 500
    warmup: int = 100
    crop: int = 128
    widths: list[int] = field(default_factory=lambda: [16, 32, 40, 40, 40, 32, 16, 12])
    loss: PlanLoss = field(default_factory=PlanLoss)
    augment: PlanAugment = field(default_factory=PlanAugment)
    watch: str = "mean_f1"


@dataclass
class PlaceAugment:
    """What is done to squares while training, beside turning and mirroring.

    Args:
        upper: share of the squares of which nothing is seen above a body.
        noise: standard deviation of the factor that each plane of a square is multiplied by.
    """

    upper: float = 0.15
    noise: float = 0.1


@dataclass
class PlaceEvidence(NetworkTask):
    """Args:
    steps: of an epoch; warmup: steps in which the rate rises.
    hypotheses, inspected: of a pair, as of `MergeBelief`: the places are those of its hypotheses.
    lookalikes: do those of `alike` that somebody can tell apart train, too?
    half: 1 or 2: train on one half of the buildings only (`belief_hypotheses.half_of`); 0: on all.
    widths: channels of the convolutions; dropout: of what they give.
    """

    task: str = "place_evidence"
    name: str = "place_evidence"
    data: GridRecipe = field(default_factory=GridRecipe)
    heldout: GridRecipe = field(default_factory=GridRecipe)
    hypotheses: int = 25
    inspected: int = 3
    epochs: int = 12
    steps: int = 300
    warmup: int = 100
    batch: int = 64
    decay: float = 1e-2
    half: int = 0
    lookalikes: bool = True
    alike: LookalikeRecipe = field(default_factory=LookalikeRecipe)
    widths: list[int] = field(default_factory=lambda: [24, 32, 48])
    dropout: float = 0.2
    augment: PlaceAugment = field(default_factory=PlaceAugment)
    watch: str = "auc"


@dataclass
class DoorClassification(NetworkTask):
    """Args:
    hidden: units of each network; networks: that are averaged.
    noise: standard deviations that features jitter by while training.
    """

    task: str = "door_classification"
    name: str = "door_classification"
    data: PlanRecipe = field(default_factory=PlanRecipe)
    heldout: PlanRecipe = field(default_factory=PlanRecipe)
    epochs: int = 60
    batch: int = 256
    rate: float = 5e-3
    decay: float = 3e-2
    hidden: int = 16
    networks: int = 5
    noise: float = 0.1
    watch: str = "auc"


@dataclass
class MergeBelief(TaskSettings):
    """Args:
    hypotheses: of a pair; inspected: how many of them are looked at more closely.
    pose_strength, winner_strength, kinds_strength: of the models; the smaller, the simpler.
    missed: weight of a pair whose right hypothesis is taken away.
    strict: weight of a wrong hypothesis where a slice or a drawing hides what tells storeys apart: rather refused than wrong.
    folds: of buildings, for the scores.
    floor: weight of a pair of the development floor; 0: it is not fitted to.
    risk: false merges in a thousand pairs, drawn by the stated priors, that the threshold allows.
    refit: all, or closely (the models that rank rigid poses stay as they are).
    halves: runs of `place_evidence` on one half of the buildings each (half=1, half=2); a pair is judged by the network
        that did not see its building. Empty: by the one that ships.
    lookalikes: none, judged (left-out models are tried on them) or fitted (they train, too; `belief_lookalikes`).
    alike, alike_heldout: the look-alikes to fit to and to judge on; alike_weight: of one of them.
    """

    task: str = "merge_belief"
    name: str = "merge_belief"
    data: GridRecipe = field(default_factory=GridRecipe)
    heldout: GridRecipe = field(default_factory=GridRecipe)
    hypotheses: int = 25
    inspected: int = 3
    pose_strength: float = 1.0
    winner_strength: float = 0.3
    kinds_strength: float = 0.03
    missed: float = 0.2
    strict: float = 1.25
    folds: int = 8
    floor: float = 0.5
    risk: float = 30.0
    refit: str = "all"
    halves: list[str] = field(default_factory=list)
    lookalikes: str = "none"
    alike_weight: float = 0.25
    alike: LookalikeRecipe = field(default_factory=LookalikeRecipe)
    alike_heldout: LookalikeRecipe = field(default_factory=LookalikeRecipe)
    watch: str = "right_believed"


@dataclass
class RoomMatching(NetworkTask):
    """Args:
    data: name of a set of pairs (`cache`/<name>.jsonl) or a manifest, and validation the one that is watched, as of `embedding`.
    views: of each map that are changed, beside the one that is as it is.
    width: numbers of a room within the network; layers: of attention.
    wrong_turn: weight of pairs at a wrong turn; turn: of telling it from the right one.
    steps: of an epoch; warmup: those in which the rate rises.
    """

    task: str = "room_matcher"
    name: str = "room_matcher"
    data: Recipe = field(default_factory=Recipe)
    heldout: Recipe = field(default_factory=Recipe)
    validation: str = "val_small"
    views: int = 5
    width: int = 96
    layers: int = 3
    dropout: float = 0.1
    wrong_turn: float = 0.15
    turn: float = 0.3
    epochs: int = 10
    batch: int = 16
    warmup: int = 50
    rate: float = 1e-3
    steps: int = 50
    watch: str = "f1"


@dataclass
class MatchOdds(TaskSettings):
    """Args:
    pull: to 0, of all weights but the constant.
    folds: of buildings, for the scores.
    """

    task: str = "match_odds"
    name: str = "match_odds"
    data: Recipe = field(default_factory=Recipe)
    heldout: Recipe = field(default_factory=Recipe)
    pull: float = 0.05
    folds: int = 5
    watch: str = "match_accuracy"


@dataclass
class RoomOdds(TaskSettings):
    """Args:
    pull: to 0, of all weights but the constant.
    folds: of scans, for the scores.
    """

    task: str = "room_odds"
    name: str = "room_odds"
    data: PlanRecipe = field(default_factory=PlanRecipe)
    heldout: PlanRecipe = field(default_factory=PlanRecipe)
    pull: float = 1.0
    folds: int = 8
    watch: str = "entered_auc"


@dataclass
class FeatureScale(TaskSettings):
    """Args:
    shrink: share of the features' own variances in the covariance of the differences: few rooms give a noisy one.
    """

    task: str = "feature_scale"
    name: str = "feature_scale"
    data: Recipe = field(default_factory=Recipe)
    heldout: Recipe = field(default_factory=Recipe)
    shrink: float = 0.1
    watch: str = "recall@1"
