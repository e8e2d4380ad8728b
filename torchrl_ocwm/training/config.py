"""Hydra configurations as this library's dataclasses, and errors that list what is valid."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from torchrl.checkpoint import CheckpointError

T = TypeVar("T")
_EXPECTED = (ValueError, ModuleNotFoundError, CheckpointError, FloatingPointError, RuntimeError)


def recipe(folder: Path, name: str) -> Callable[[Callable[[DictConfig], None]], Callable[[], None]]:
    """Make a function the main function of a script that is configured with Hydra.

    Unknown options and keys on the command line, and errors that a user can mend, end the script with one message
    (``HYDRA_FULL_ERROR=1`` shows where they were raised).

    Args:
        folder: Folder of the configurations.
        name: The script's own configuration in it.
    """

    def decorate(function: Callable[[DictConfig], None]) -> Callable[[], None]:
        """The script's main function."""

        def guarded(config: DictConfig) -> None:
            try:
                function(config)
            except _EXPECTED as error:
                if os.environ.get("HYDRA_FULL_ERROR") == "1":
                    raise
                sys.exit(f"{type(error).__name__}: {error}")

        def main() -> None:
            check_overrides(folder, name, sys.argv[1:])
            hydra.main(version_base="1.3", config_path=str(folder.resolve()), config_name=name)(guarded)()

        return main

    return decorate


def check_overrides(folder: Path, name: str, arguments: list[str]) -> None:
    """End the script when an argument names an option or a key that is not there.

    Raises:
        SystemExit: with the valid options or keys.
    """
    if any(argument in ("-m", "--multirun", "-h", "--help") for argument in arguments):
        return
    overrides = [argument for argument in arguments if not argument.startswith(("-", "hydra"))]
    groups = [one for one in overrides if (folder / one.split("=")[0].lstrip("+~")).is_dir()]
    GlobalHydra.instance().clear()
    try:
        with hydra.initialize_config_dir(str(folder.resolve()), version_base="1.3"):
            valid = hydra.compose(name, groups)
            for override in overrides:
                _compose(valid, name, override)
    except HydraException as error:  # unknown options of a group: Hydra's own message lists them
        sys.exit(f"ConfigError: {error}")


def _compose(valid: DictConfig, name: str, override: str) -> None:
    try:
        hydra.compose(name, [override])
    except HydraException as error:
        key: str = override.split("=")[0]
        if "Could not override" not in str(error):
            raise
        parent = key.rpartition(".")[0]
        while parent and not OmegaConf.is_config(OmegaConf.select(valid, parent)):
            parent = parent.rpartition(".")[0]
        node = OmegaConf.select(valid, parent) if parent else valid
        keys = ", ".join(f"{parent}.{one}" if parent else f"{one!s}" for one in map(str, node))
        sys.exit(f"ConfigError: unknown key {key!r}; valid here: {keys}")


def keep_config(config: DictConfig) -> None:
    """Put a configuration in place of what Hydra wrote before the script began, which may know less."""
    hydra_config = HydraConfig.get()
    if hydra_config.output_subdir is not None:
        OmegaConf.save(config, Path(hydra_config.runtime.output_dir) / hydra_config.output_subdir / "config.yaml")


def part_of(config: DictConfig, kind: type[T]) -> T:
    """A dataclass from those keys of a configuration that are its fields."""
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    return to_dataclass(kind, OmegaConf.masked_copy(config, names))


def to_dataclass(kind: type[T], config: DictConfig) -> T:
    """A dataclass from a node of a configuration.

    Raises:
        ValueError: if a key is missing or not a field, or a value is refused.
    """
    values: dict[str, Any] = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    real = [field.name for field in fields(kind) if field.type == "float"]  # type: ignore[arg-type]
    values.update({name: float(values[name]) for name in real if name in values})
    try:
        return kind(**{key: tuple(value) if isinstance(value, list) else value for key, value in values.items()})
    except TypeError as error:
        raise ValueError(f"{kind.__name__}: {error}") from error
