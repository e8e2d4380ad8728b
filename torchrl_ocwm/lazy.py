"""Names of a package whose modules are imported when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazily(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package whose names live in modules that need more than the package does.

    Args:
        package: Name of the package.
        homes: The module in it where each name lives.

    Raises:
        AttributeError: for any other name.

    Examples:
        >>> find = lazily("torchrl_ocwm", {"Workspace": "envs"})
        >>> find("Workspace").__module__
        'torchrl_ocwm.envs.workspace'
    """

    def find(name: str) -> Any:
        if name in homes:
            return getattr(import_module(f"{package}.{homes[name]}"), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return find
