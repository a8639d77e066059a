"""Settings of the tasks that learn from scans whose plans or walls are looked at: configs/task/<task>.yaml."""

from __future__ import annotations

from dataclasses import dataclass, field

from topomerge.datasets.drawings.shapes import DrawingRecipe
from topomerge.datasets.pairs.plan_examples import PlanRecipe
from topomerge.errors import InputError
from topomerge.extraction.elevations.elevation import WALL_CLASSES
from topomerge.training.settings import NetworkTask, RasterTask, TaskSettings


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
    """Augmentation of crops while training: what is taken away, now and then.

    Args:
        upper: share of crops without ceiling or without floor.
        columns: share of crops that lose single columns; lost: share of these, drawn between 0 and this.
        grid_noise: share of crops with the noise of robots' grids (`training.plan_segmentation.add_grid_noise`).
    """

    grid_noise: float = 0.0
    upper: float = 0.2
    columns: float = 0.3
    lost: float = 0.3


@dataclass
class PlanSegmentation(RasterTask):
    """Settings of the task that trains the network of plans of storeys.

    Args:
        steps: of an epoch; warmup: steps in which the rate rises.
        crop: columns of a side, a multiple of 16.
        widths: channels of the levels a to d down, and e to h up again.
    """

    task: str = "plan_segmentation"
    name: str = "plan_segmentation"
    data: PlanRecipe = field(default_factory=PlanRecipe)
    heldout: PlanRecipe = field(default_factory=PlanRecipe)
    epochs: int = 32
    batch: int = 32
    steps: int = 400
    warmup: int = 300
    crop: int = 128
    widths: list[int] = field(default_factory=lambda: [32, 64, 96, 96, 96, 64, 32, 16])
    loss: PlanLoss = field(default_factory=PlanLoss)
    augment: PlanAugment = field(default_factory=PlanAugment)
    watch: str = "mean_f1"

    def check(self) -> None:
        """Refuse what makes no sense."""
        super().check()
        if self.crop < 16 or self.crop % 16:
            raise InputError(f"crop must be a multiple of 16, not {self.crop}")
        if len(self.widths) != 8 or min(self.widths) < 1:
            raise InputError(f"widths must be 8 numbers of channels, not {self.widths}")
        if len(self.loss.classes) != 5 or min(self.loss.classes) <= 0:
            raise InputError(f"loss.classes must be 5 weights above 0, not {self.loss.classes}")


@dataclass
class GridSegmentation(PlanSegmentation):
    """The same for robots' grids and drawings; fewer steps, as longer training learns how scans are simulated (docs/adr/0005).

    Args:
        homes: maps of vacuum robots (Valetudo's JSON), or folders of them, whose own rooms are learned from, too.
        home_share: of the crops that are of these homes.
    """

    task: str = "grid_segmentation"
    name: str = "grid_segmentation"
    epochs: int = 6
    warmup: int = 200
    rate: float = 3e-3
    augment: PlanAugment = field(default_factory=lambda: PlanAugment(upper=0.0, columns=0.0, grid_noise=0.15))
    homes: list[str] = field(default_factory=list)
    home_share: float = 0.4

    def check(self) -> None:
        """Refuse what makes no sense."""
        super().check()
        if not 0 < self.home_share < 1:
            raise InputError(f"home_share must be above 0 and below 1, not {self.home_share}")


@dataclass
class DrawingSegmentation(RasterTask):
    """Settings of the task that trains the network of drawn plans.

    Args:
        data, watched: plans that are drawn to learn from and to watch; heldout: to judge.
        steps: of an epoch; warmup: steps in which the rate rises.
        crop: px of a side of a page, a multiple of 32.
        pages: that are at hand at a time; fresh: of them that are drawn anew in each step.
        widths: channels of the page's own pixels and of the five levels below.
        classes: weights of `networks.drawing.DRAWING_CLASSES` in the cross-entropy; dice: of the Dice loss beside it.
    """

    task: str = "drawing_segmentation"
    name: str = "drawing_segmentation"
    data: DrawingRecipe = field(default_factory=DrawingRecipe)
    watched: DrawingRecipe = field(default_factory=lambda: DrawingRecipe("drawings_watched", "validation", 40))
    heldout: DrawingRecipe = field(default_factory=lambda: DrawingRecipe("drawings_heldout", "test", 40))
    epochs: int = 10
    batch: int = 8
    steps: int = 300
    warmup: int = 150
    crop: int = 256
    pages: int = 512
    fresh: int = 2
    watched_pages: int = 96
    rate: float = 3e-3
    widths: list[int] = field(default_factory=lambda: [8, 24, 40, 64, 96, 128])
    classes: list[float] = field(default_factory=lambda: [1.0, 1.0, 2.0, 3.0, 3.0, 1.0, 2.0, 1.0])
    dice: float = 0.5
    ema: float = 0.999
    watch: str = "mean_iou"

    def check(self) -> None:
        """Refuse what makes no sense."""
        super().check()
        if self.crop < 64 or self.crop % 32:
            raise InputError(f"crop must be a multiple of 32 from 64 on, not {self.crop}")
        if len(self.widths) != 6 or min(self.widths) < 1:
            raise InputError(f"widths must be 6 numbers of channels, not {self.widths}")
        if len(self.classes) != 8 or min(self.classes) <= 0:
            raise InputError(f"classes must be 8 weights above 0, not {self.classes}")
        if min(self.pages, self.fresh, self.watched_pages) < 1:
            raise InputError(
                f"pages, fresh and watched_pages must be 1 or more, not {self.pages}, {self.fresh}, {self.watched_pages}"
            )


@dataclass
class WallAugment:
    """Augmentation of stretches of walls while training, beside mirroring.

    Args:
        shift: elements by which a face is moved nearer or farther, at most.
        sparse: share of stretches that lose elements; lost: share of these, drawn between 0 and this.
        hidden: share of stretches of which some is not seen up to some height.
        walk: share of stretches without the floor that one can walk on; rays: and without what is known of rays.
    """

    shift: int = 2
    sparse: float = 0.4
    lost: float = 0.7
    hidden: float = 0.3
    walk: float = 0.15
    rays: float = 0.4


@dataclass
class WallSegmentation(RasterTask):
    """Settings of the task that trains the networks of walls.

    Args:
        steps: of an epoch; warmup: steps in which the rate rises.
        length: places of a stretch, even; at_holes: share of the stretches about the side of a door or window.
        classes: weights of the classes in the cross-entropy.
        widths: of `models.convolutional.WallNetwork`.
        unseen: weight of places where nothing was seen.
    """

    task: str = "wall_segmentation"
    name: str = "wall_segmentation"
    data: PlanRecipe = field(default_factory=PlanRecipe)
    heldout: PlanRecipe = field(default_factory=PlanRecipe)
    epochs: int = 12
    batch: int = 32
    steps: int = 400
    warmup: int = 100
    length: int = 96
    at_holes: float = 0.5
    classes: list[float] = field(default_factory=lambda: [1.0, 1.5, 3.0, 1.5, 2.0, 2.5, 1.0])
    widths: list[int] = field(default_factory=lambda: [24, 32, 96, 64])
    unseen: float = 0.05
    augment: WallAugment = field(default_factory=WallAugment)
    watch: str = "f1_doors"

    def check(self) -> None:
        """Refuse what makes no sense."""
        super().check()
        if len(self.widths) != 4 or min(self.widths) < 1:
            raise InputError(f"widths must be 4 numbers of channels, not {self.widths}")
        if self.length < 8 or self.length % 2:
            raise InputError(f"length must be an even number of places, 8 or more, not {self.length}")
        if len(self.classes) != len(WALL_CLASSES) or min(self.classes) <= 0:
            raise InputError(f"classes must be {len(WALL_CLASSES)} weights above 0, not {self.classes}")


@dataclass
class WallDoors(TaskSettings):
    """Settings of the task that fits how much plans and walls say of a door.

    Args:
        data, frameless, flat: scans that show walls, those of doors without frames, and slices and grid maps.
        heldout, heldout_frameless, heldout_flat: likewise, of other buildings.
        l2: to 0, of all weights but the constants.
        folds: of scans, for the scores.
    """

    task: str = "wall_doors"
    name: str = "wall_doors"
    data: PlanRecipe = field(default_factory=PlanRecipe)
    frameless: PlanRecipe = field(default_factory=PlanRecipe)
    flat: PlanRecipe = field(default_factory=PlanRecipe)
    heldout: PlanRecipe = field(default_factory=PlanRecipe)
    heldout_frameless: PlanRecipe = field(default_factory=PlanRecipe)
    heldout_flat: PlanRecipe = field(default_factory=PlanRecipe)
    l2: float = 1.0
    folds: int = 5
    watch: str = "precision"


@dataclass
class Passages(TaskSettings):
    """Settings of the task that fits how much all evidence says of a door between two segments.

    Args:
        data: scans; heldout: of other buildings.
        l2: of the weights to what the plan alone says.
        folds: of scans, for the scores.
    """

    task: str = "passages"
    name: str = "passages"
    data: PlanRecipe = field(default_factory=PlanRecipe)
    heldout: PlanRecipe = field(default_factory=PlanRecipe)
    l2: float = 3.0
    folds: int = 5
    watch: str = "log_loss"


@dataclass
class DoorClassification(NetworkTask):
    """Settings of the task that trains what tells whether a narrowing of the floor is a door.

    Args:
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
class RoomOdds(TaskSettings):
    """Settings of the task that fits whether a room is one, whole, entered, and outside.

    Args:
        data: scans; open, closed: scans of buildings with their surroundings and ordinary ones, for what lies outside; grids:
            robots' grids of buildings with their surroundings; heldout, heldout_open, heldout_grids: likewise, of other
            buildings.
        fit: which of `scans`, `open` and `grids` to fit; the weights of the others stay those in use.
        l2: to 0, of all weights but the constant.
        folds: of scans, for the scores.
    """

    task: str = "room_odds"
    name: str = "room_odds"
    data: PlanRecipe = field(default_factory=PlanRecipe)
    open: PlanRecipe = field(default_factory=PlanRecipe)
    closed: PlanRecipe = field(default_factory=PlanRecipe)
    grids: PlanRecipe = field(default_factory=PlanRecipe)
    heldout: PlanRecipe = field(default_factory=PlanRecipe)
    heldout_open: PlanRecipe = field(default_factory=PlanRecipe)
    heldout_grids: PlanRecipe = field(default_factory=PlanRecipe)
    fit: list[str] = field(default_factory=lambda: ["scans", "open", "grids"])
    l2: float = 1.0
    folds: int = 8
    watch: str = "entered_auc"
