"""Registries of parts that can be swapped by name, and added from outside of the package: encoders, losses, optimizers,
schedules, samplers, loggers, sets, tasks.

A registry knows what ships, what packages that are installed announce (entry points of its group, such as ``topomerge.losses``),
and what a module registered that was imported, such as one that ``plugins=[my_package.my_module]`` names:

    @LOSSES.register("cosine")
    def compute_cosine_loss(...): ...

What ships and what is announced is imported when it is asked for.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, TypeVar

from topomerge.errors import InputError

T = TypeVar("T")


class Registry(Mapping[str, Any]):
    """Name -> what is registered.

    Args:
        key: of the settings that names an entry, for messages.
        group: of entry points, behind ``topomerge.``.
        shipped: name -> ``module:object``.
    """

    def __init__(self, key: str, group: str, **shipped: str) -> None:
        self.key, self.group = key, f"topomerge.{group}"
        self._shipped = {name: EntryPoint(name, where, self.group) for name, where in shipped.items()}
        self._registered: dict[str, Any] = {}

    def register(self, name: str) -> Callable[[T], T]:
        """Register a function, class or object under a name.

        Raises:
            InputError: the name is taken.
        """

        def keep(entry: T) -> T:
            before = self._registered.get(name)
            same = before is not None and _locate(before) == _locate(entry)  # its module was imported once more
            if name in self and not same:
                raise InputError(f"{self.key}: {name!r} is registered twice; give yours another name")
            self._registered[name] = entry
            return entry

        return keep

    def check(self, name: str) -> None:
        """Refuse a name that is not registered.

        Raises:
            InputError: lists the names.
        """
        if name not in self:
            raise InputError(f"{self.key}: unknown {name!r}; {', '.join(self)} are possible; plugins=[module] adds more")

    def __getitem__(self, name: str) -> Any:
        """Return what is registered under a name.

        Raises:
            InputError: no such name, or what is announced under it cannot be imported.
        """
        self.check(name)
        if name in self._registered:
            return self._registered[name]
        if name in self._shipped:
            return self._shipped[name].load()
        entry = self._find_announced()[name]
        try:
            return entry.load()
        except Exception as error:  # whatever the code of others raises
            raise InputError(f"{self.key}={name}: {entry.value} cannot be imported ({_shorten(error)})") from error

    def __iter__(self) -> Iterator[str]:
        yield from dict.fromkeys([*self._shipped, *self._registered, *self._find_announced()])

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return name in self._shipped or name in self._registered or name in self._find_announced()

    def _find_announced(self) -> dict[str, EntryPoint]:
        return {entry.name: entry for entry in list_announced(self.group)}


@cache
def list_announced(group: str) -> tuple[EntryPoint, ...]:
    """List the entry points of a group, read once: each look through the installed packages takes 20 ms."""
    return tuple(entry_points(group=group))


def load_plugins(modules: Sequence[str]) -> list[Path]:
    """Import modules that register something, from the working folder, too.

    Returns:
        The folders `configs` beside them, whose YAML files can be named like those of the package.

    Raises:
        InputError: one of them cannot be imported.
    """
    folders = []
    for name in modules:
        sys.path.append(os.getcwd())
        try:
            module = importlib.import_module(name)
        except InputError as error:
            raise InputError(f"plugins={name}: {error}") from error
        except Exception as error:  # whatever the code of others raises
            raise InputError(f"plugins={name}: cannot be imported ({_shorten(error)})") from error
        finally:
            sys.path.pop()
        folder = Path(module.__file__ or "").resolve().parent / "configs"
        if folder.is_dir() and folder not in folders:
            folders.append(folder)
    return folders


def _locate(entry: Any) -> tuple[str, str]:
    """Return the module and the name of a function, a class, or the class of an object."""
    named = entry if hasattr(entry, "__qualname__") else type(entry)
    return named.__module__, named.__qualname__


def _shorten(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:160]


NODES = Registry("node.kind", "nodes", sage="topomerge.models.nodes:build_sage", gat="topomerge.models.nodes:build_gat")
GEOMETRIES = Registry(
    "geometry.parts",
    "geometries",
    pointnet="topomerge.models.geometry:PointNet",
    pointnet_local="topomerge.models.geometry:LocalPointNet",
    voxelcnn="topomerge.models.geometry:VoxelCNN",
)
LOSSES = Registry(
    "loss.kind",
    "losses",
    infonce="topomerge.models.losses:score_info_nce",
    ntxent="topomerge.models.losses:score_nt_xent",
    triplet="topomerge.models.losses:score_triplets",
)
OPTIMIZERS = Registry("optimizer", "optimizers", adamw="torch.optim:AdamW", sgd="torch.optim:SGD")
SCHEDULES = Registry(
    "schedule",
    "schedules",
    cosine="topomerge.training.descent:warmup_cosine",
    constant="topomerge.training.descent:warmup_constant",
)
SAMPLERS = Registry(
    "sampler",
    "samplers",
    shuffle="topomerge.training.samplers:shuffle_pairs",
    buildings="topomerge.training.samplers:balance_buildings",
)
NO_LOGGER = "none"
LOGGERS = Registry(
    "logger",
    "loggers",
    tensorboard="topomerge.training.instruments:build_board_logger",
    csv="topomerge.training.instruments:CsvLogger",
    wandb="topomerge.training.instruments:WandbLogger",
    mlflow="topomerge.training.instruments:MlflowLogger",
)
DATASETS = Registry("data", "datasets", folder="topomerge.datasets.pairs.pairs_file:read_pairs_table")
TASKS = Registry(
    "task",
    "tasks",
    **{
        "plan_segmentation": "topomerge.training.plan_segmentation:PLAN_TASK",
        "grid_segmentation": "topomerge.training.plan_segmentation:GRID_TASK",
        **{
            name: f"topomerge.training.{name}:TASK"
            for name in (
                "drawing_segmentation", "door_classification", "wall_segmentation",
                "passages", "wall_doors", "room_odds", "embedding", "room_matcher", "feature_scale", "match_odds",
                "place_evidence", "match_belief", "merge_belief", "radio_law", "locate_odds",
            )
        },
    },
)  # fmt: skip
