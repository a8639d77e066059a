"""Settings from YAML files and the words of a command line, by Hydra, as typed dataclasses."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from functools import cache
from typing import Any, TypeVar

from topomerge.errors import InputError
from topomerge.registry import load_plugins

Schema = TypeVar("Schema")
SEARCH_PATH = "hydra.searchpath="
SEARCH = "search"  # key of what is no setting of a run (`training.search`)


def compose(name: str, schema: type[Schema], overrides: Sequence[str] = ()) -> Schema:
    """Return the settings of `configs/<name>.yaml`, overridden by words like ``data=train_small jobs=2 data.pairs=10``.

    Every key must be a field of the dataclass `schema` and every value of its type; a field with a default may be absent.

    Raises:
        InputError: one line with the key's name.
    """
    register(name, schema)
    return convert_to_dataclass(compose_config(name, overrides), schema)


def compose_config(name: str, overrides: Sequence[str] = ()) -> Any:
    """Return what Hydra composes of `configs/<name>.yaml` and words, whose schemas are registered.

    Raises:
        InputError: one line with the key's name.
    """
    try:
        from hydra import compose as hydra_compose
        from hydra import initialize_config_module
        from hydra.errors import HydraException
        from omegaconf.errors import OmegaConfBaseException
    except ImportError as error:
        raise InputError("settings need Hydra: pip install topomerge[learn]") from error
    try:
        with initialize_config_module("topomerge.configs", version_base="1.3"):
            return hydra_compose(name, overrides=find_plugins(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(_shorten_error(error)) from error


def find_plugins(overrides: Sequence[str]) -> list[str]:
    """Import the modules that words like ``plugins=[my_package.my_module]`` name.

    Returns:
        The words, with one more by which Hydra finds the YAML files in folders `configs` beside these modules.

    Raises:
        InputError: one of them cannot be imported.
    """
    named = next((word.partition("=")[2] for word in reversed(overrides) if word.lstrip("+").startswith("plugins=")), "")
    folders = load_plugins([name.strip(" '\"") for name in named.strip("[]").split(",") if name])
    paths = ",".join(f"'file://{folder}'" for folder in folders)
    return [*(w for w in overrides if not w.startswith(SEARCH_PATH)), f"{SEARCH_PATH}[{paths}]"] if folders else list(overrides)


def register(name: str, schema: type[Any], group: str | None = None, package: str = "_global_") -> None:
    """Let `configs/<name>.yaml` begin with `<name>_schema`: then every field of the dataclass is a key with its default, so that
    each can be overridden, and new entries of tables (weights by name) can be set.

    Args:
        group: folder of the file below `configs/`; its keys stand at the top all the same, or in `package`.
    """
    from hydra.core.config_store import ConfigStore

    node = _build_node(schema)  # type: ignore[arg-type]  # of a class, which can be hashed
    ConfigStore.instance().store(f"{name}_schema", node, group=group, package=package if group else None)


@cache
def _build_node(schema: type[Any]) -> Any:
    """Build what Hydra copies of a schema each time that it composes: once, as a sweep composes often."""
    from omegaconf import OmegaConf

    node = OmegaConf.structured(schema)
    _open_tables(node)
    return node


def _open_tables(node: Any) -> None:
    """Let fields of type dict take keys that they do not have yet; Hydra closes everything else."""
    from omegaconf import DictConfig, OmegaConf

    for key in node:
        value = node._get_node(key)
        if isinstance(value, DictConfig) and not value._is_missing() and not value._is_none():
            if OmegaConf.get_type(value) is dict:
                OmegaConf.set_struct(value, False)
            else:
                _open_tables(value)


def convert_to_dataclass(given: Any, schema: type[Schema]) -> Schema:
    """Convert what Hydra composed to a dataclass.

    Raises:
        InputError: one line with the key's name.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        plain: Any = OmegaConf.to_container(given, resolve=True)  # without types: another process has its own copy of the schema
        plain = {key: value for key, value in plain.items() if key != SEARCH}
        merged: Any = OmegaConf.merge(OmegaConf.structured(schema), plain)
        settings: Schema = OmegaConf.to_object(merged)  # type: ignore[assignment]
    except OmegaConfBaseException as error:
        raise InputError(_shorten_error(error)) from error
    return settings


def _shorten_error(error: Exception) -> str:
    """Join the many lines of an error of Hydra or OmegaConf; the innermost reason is the one that names the key's fault."""
    texts = [str(error)]
    if error.__cause__ is not None and str(error.__cause__) not in texts[0]:
        texts.append(str(error.__cause__))
    lines = [line.strip() for text in texts for line in text.splitlines()]
    return "; ".join(line for line in lines if line and not line.startswith("object_type="))


def name_by_sweep(arguments: Sequence[str]) -> list[str]:
    """Return the words of `train.py`; of a sweep with its flag first, as Hydra takes no words on both sides of it, and with one
    more, by which names of runs hold what differs between them only."""
    if not {"-m", "--multirun"} & set(arguments):
        return list(arguments)
    arguments = ["-m", *(word for word in arguments if word not in ("-m", "--multirun"))]
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        overrides = OverridesParser.create().parse_overrides([word for word in arguments if not word.startswith("-")])
    except HydraException as error:
        raise InputError(_shorten_error(error)) from error
    fixed = [one.key_or_group for one in overrides if not one.is_sweep_override() and not one.key_or_group.startswith("hydra")]
    return [*arguments, f"hydra.job.config.override_dirname.exclude_keys=[{','.join(fixed)}]"]


def read_command() -> str:
    """Return the command line that runs, in quotes where a shell needs them; of a sweep that of its one run."""
    hydra = sys.modules.get("hydra.core.hydra_config")
    if hydra is not None and hydra.HydraConfig.initialized():
        return shlex.join(["python", "train.py", *hydra.HydraConfig.get().overrides.task])
    return shlex.join(["python", *sys.orig_argv[1:]])
