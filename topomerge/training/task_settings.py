"""Settings of the tasks that learn from pairs of maps, but `embedding` (`training.settings`): configs/task/<task>.yaml."""

from __future__ import annotations

from dataclasses import dataclass, field

from topomerge.datasets.pairs.grid_pairs import GridRecipe
from topomerge.datasets.pairs.items import Recipe
from topomerge.datasets.pairs.lookalikes import LookalikeRecipe
from topomerge.datasets.pairs.own_pairs import check_own_path
from topomerge.errors import InputError
from topomerge.training.settings import NetworkTask, RasterTask, TaskSettings

LOOKALIKES_TAKEN = ("none", "judged", "fitted")


@dataclass
class PlaceAugment:
    """Augmentation of squares while training, beside turning and mirroring.

    Args:
        upper: share of the squares of which nothing is seen above a body.
        noise: standard deviation of the factor that each plane of a square is multiplied by.
    """

    upper: float = 0.15
    noise: float = 0.1


@dataclass
class PlaceEvidence(RasterTask):
    """Settings of the task that trains the network which tells whether two squares show one place.

    Args:
        steps: of an epoch; warmup: steps in which the rate rises.
        hypotheses, inspected: of a pair, as of `MergeBelief`: the places are those of its hypotheses.
        lookalikes: do those of `alike` that somebody can tell apart train, too?
        half: 1 or 2: train on one half of the buildings only (`belief_hypotheses.assign_half`); 0: on all.
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

    def check(self) -> None:
        """Refuse what makes no sense."""
        super().check()
        if self.half not in (0, 1, 2):
            raise InputError(f"half must be 0, 1 or 2, not {self.half}")


@dataclass
class MergeBelief(TaskSettings):
    """Settings of the task that fits the models by which hypotheses are ranked and accepted.

    Args:
        hypotheses: of a pair; inspected: how many of them are looked at more closely.
        pose_strength, winner_strength, kinds_strength, plan_strength: of the models; the smaller, the simpler.
        missed: weight of a pair whose right hypothesis is taken away.
        plan_strict: weight of a place of the same plan, beside its prior: rather refused than wrong.
        strict: weight of a wrong hypothesis where a slice or a drawing hides what tells storeys apart: rather refused than wrong.
        folds: of buildings, for the scores.
        floor: weight of a pair of the development floor; 0: it is not fitted to.
        risk: false merges in a thousand pairs, drawn by the stated priors, that the threshold allows.
        refit: all; closely (the models that rank rigid poses stay as they are); or plan (only the one of places of one plan is
            made anew, and the risks are measured).
        halves: runs of `place_evidence` on one half of the buildings each (half=1, half=2); a pair is judged by the network that
            did not see its building. Empty: by the one that ships.
        lookalikes: none, judged (left-out models are tried on them) or fitted (they train, too; `build_lookalike_rows`).
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
    plan_strength: float = 1.0
    plan_strict: float = 2.0
    missed: float = 0.2
    strict: float = 1.25
    folds: int = 8
    floor: float = 0.5
    risk: float = 25.0
    refit: str = "all"
    halves: list[str] = field(default_factory=list)
    lookalikes: str = "none"
    alike_weight: float = 0.25
    alike: LookalikeRecipe = field(default_factory=LookalikeRecipe)
    alike_heldout: LookalikeRecipe = field(default_factory=LookalikeRecipe)
    watch: str = "right_believed"

    def check(self) -> None:
        """Refuse what makes no sense."""
        super().check()
        for key in ("pose_strength", "winner_strength", "kinds_strength"):
            if not getattr(self, key) > 0:
                raise InputError(f"{key} must be above 0, not {getattr(self, key)}")
        if not 0 < self.risk <= 1000:
            raise InputError(f"risk must be above 0 and at most 1000, not {self.risk}")
        if not 0 <= self.floor <= 10:
            raise InputError(f"floor must be 0 to 10, not {self.floor}")
        if self.lookalikes not in LOOKALIKES_TAKEN:
            raise InputError(f"lookalikes must be {', '.join(LOOKALIKES_TAKEN)}, not {self.lookalikes!r}")
        if self.refit not in ("all", "closely", "plan"):
            raise InputError(f"refit must be all, closely or plan, not {self.refit!r}")
        if len(self.halves) not in (0, 2):
            raise InputError(f"halves must name two runs, not {self.halves}")


@dataclass
class RoomMatching(NetworkTask):
    """Settings of the task that trains the network which matches rooms.

    Args:
        data: name of a set of pairs (`cache`/<name>.jsonl) or a manifest, and validation the one that is watched, as of
            `embedding`.
        path: of ``data=folder``, as of `embedding`; ``evaluate.py task=room_matcher`` judges by the pairs of its test.
        embedder: whose rows it reads: `pretrained`, a run or a file.
        views: of each map that are changed, beside the one that is as it is.
        width: numbers of a room within the network; layers: of attention.
        without: parts that are left out (`models.room_matcher.MATCHER_PARTS`): votes, ways, facts, within, across.
        wrong_turn: weight of pairs at a wrong turn; turn: of telling it from the right one.
        steps: of an epoch; warmup: those in which the rate rises.
    """

    task: str = "room_matcher"
    name: str = "room_matcher"
    data: Recipe = field(default_factory=Recipe)
    heldout: Recipe = field(default_factory=Recipe)
    validation: str = "val_small"
    path: str = ""
    embedder: str = "pretrained"
    views: int = 5
    width: int = 96
    layers: int = 3
    without: list[str] = field(default_factory=list)
    dropout: float = 0.1
    wrong_turn: float = 0.15
    turn: float = 0.3
    epochs: int = 10
    batch: int = 16
    warmup: int = 50
    rate: float = 1e-3
    steps: int = 50
    watch: str = "f1"

    def check(self) -> None:
        """Refuse what makes no sense."""
        super().check()
        check_own_path(self.data.name, self.path)


@dataclass
class MatchOdds(TaskSettings):
    """Settings of the task that fits how likely a hypothesis is right.

    Args:
        l2: to 0, of all weights but the constant.
        folds: of buildings, for the scores.
    """

    task: str = "match_odds"
    name: str = "match_odds"
    data: Recipe = field(default_factory=Recipe)
    heldout: Recipe = field(default_factory=Recipe)
    l2: float = 0.05
    folds: int = 5
    watch: str = "match_accuracy"


@dataclass
class MatchBelief(TaskSettings):
    """Settings of the task that fits how likely matched rooms are one.

    Args:
        l2: of all weights but the constant, to what matching says.
        folds: of buildings, for the scores.
    """

    task: str = "match_belief"
    name: str = "match_belief"
    data: Recipe = field(default_factory=Recipe)
    heldout: Recipe = field(default_factory=Recipe)
    l2: float = 0.5
    folds: int = 8
    watch: str = "attention_all_after_accuracy"


@dataclass
class FeatureScale(TaskSettings):
    """Settings of the task that measures by what the engineered features are scaled.

    Args:
        shrink: share of the features' own variances in the covariance of the differences: few rooms give a noisy one.
    """

    task: str = "feature_scale"
    name: str = "feature_scale"
    data: Recipe = field(default_factory=Recipe)
    heldout: Recipe = field(default_factory=Recipe)
    shrink: float = 0.1
    watch: str = "recall@1"


@dataclass
class RadioLawFit(TaskSettings):
    """It has no settings of its own: its data is a folder of real readings, which TOPOMERGE_DATA names."""

    task: str = "radio_law"
    name: str = "radio_law"
    watch: str = "log_loss"


@dataclass
class LocateOdds(TaskSettings):
    """Settings of `locate_odds`.

    Args:
        split: of the buildings.
        maps: of the atlas.
    """

    task: str = "locate_odds"
    name: str = "locate_odds"
    watch: str = "log_loss"
    split: str = "validation"
    maps: int = 24
