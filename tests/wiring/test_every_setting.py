"""Every setting has a test that shows what it does: one that is added without fails here."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib import import_module
from inspect import get_annotations
from pathlib import Path
from pkgutil import walk_packages

from rows import ROWS

import torchrl_ocwm
from torchrl_ocwm.settings import Settings


def kinds(base: type) -> Iterator[type]:
    for kind in base.__subclasses__():
        yield from kinds(kind)
        if is_of_library(kind):
            yield kind


def is_of_library(kind: type) -> bool:
    """Not the class of a doctest, which says that it is of the module that it documents."""
    ours = kind.__module__.startswith("torchrl_ocwm.")
    return ours and getattr(sys.modules[kind.__module__], kind.__name__, None) is kind


def test_every_setting_has_its_row() -> None:
    """Those of the library and of its recipes, each where it is defined."""
    for module in walk_packages(torchrl_ocwm.__path__, "torchrl_ocwm."):
        if module.name != "torchrl_ocwm.recipes.torchrl_configs":  # fills Hydra's store, and holds no settings
            import_module(module.name)
    for file in Path(__file__).parent.glob("test_*.py"):
        import_module(file.stem)
    settings = {
        f"{kind.__name__}.{name}"
        for kind in kinds(Settings)
        for name in get_annotations(kind)
        if name in getattr(kind, "__dataclass_fields__", {})
    }
    assert settings - ROWS == set(), "show in tests/wiring what these settings do"
    assert ROWS - settings == set(), "there are no such settings"
