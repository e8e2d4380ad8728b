"""Parts of agents by name: ours, and those of other packages."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, ClassVar, TypeVar

from torchrl_ocwm.errors import MissingPackageError
from torchrl_ocwm.settings import Settings, SettingsError, from_dict

P = TypeVar("P", bound="type[Part]")

#: Entry points of this group name modules that register parts; so does this environment variable, comma-separated.
GROUP, VARIABLE = "torchrl_ocwm", "TORCHRL_OCWM_PLUGINS"


class Part(Settings):
    """A part of an agent: a dataclass with its own settings, which builds itself.

    Each kind of part is a subclass that says how it is built, ``class Reward(Part, kind="reward")``; the parts are
    dataclasses below that, registered with :func:`register`.
    """

    kind: ClassVar[str] = ""
    registered: ClassVar[dict[str, dict[str, type[Part]]]] = {}
    _name: ClassVar[str | None] = None

    def __init_subclass__(cls, *, kind: str | None = None, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls._name = None
        if kind is not None:
            cls.kind = kind
            Part.registered[kind] = {}

    @classmethod
    def name_and_kind(cls) -> tuple[str, str] | None:
        """The registered name and the kind."""
        return None if cls._name is None else (cls._name, cls.kind)

    @classmethod
    def names(cls) -> list[str]:
        """All registered names of this kind, those of plugins too."""
        load_plugins()
        return list(Part.registered[cls.kind])

    @classmethod
    def named(cls, value: Any, at: str = "") -> Part:
        """A part from its name, or from a mapping of its ``name`` and settings.

        Raises:
            SettingsError: for an unknown name, or settings that the part does not have.
        """
        name, settings = (value.get("name"), value) if isinstance(value, Mapping) else (value, {})
        at = at or cls.kind
        if not isinstance(name, str):
            raise SettingsError(f"{at} must be the name of a {cls.kind} or a mapping with its name, got {value!r}")
        if name not in Part.registered[cls.kind]:
            load_plugins()
        if name not in Part.registered[cls.kind]:
            raise SettingsError(f"{at} must be one of {', '.join(cls.names())}, got {name!r}")
        return from_dict(
            Part.registered[cls.kind][name], {key: one for key, one in settings.items() if key != "name"}, at
        )


def register(name: str) -> Callable[[P], P]:
    """Register a part under a name, by which configurations, command lines and checkpoints call it.

    Args:
        name: The name, one per kind of part.

    Raises:
        ValueError: for a name that another class has, and for a class that is no dataclass of a kind of part.

    Examples:
        >>> from dataclasses import dataclass
        >>> class Colour(Part, kind="colour"): ...
        >>> @register("red")
        ... @dataclass(frozen=True)
        ... class Red(Colour):
        ...     depth: float = 1.0
        >>> Colour.named({"name": "red", "depth": 0.5})
        Red(depth=0.5)
    """

    def decorate(part: P) -> P:
        if not part.kind or not is_dataclass(part):
            raise ValueError(f"{part.__name__} must be a dataclass and a subclass of a kind of part, such as Reward")
        if "name" in {one.name for one in fields(part)}:
            raise ValueError(f"{part.__name__} must not have a field 'name': that is what it is registered under")
        known = Part.registered[part.kind]
        there = known.get(name)
        if there is not None and (there.__module__, there.__qualname__) != (part.__module__, part.__qualname__):
            raise ValueError(f"the {part.kind} {name!r} is registered already, by {there.__module__}")
        known[name] = part
        part._name = name
        return part

    return decorate


@cache
def load_plugins() -> None:
    """Import what installed packages and the environment variable ``TORCHRL_OCWM_PLUGINS`` name; once."""
    for point in entry_points(group=GROUP):
        point.load()
    for module in filter(None, map(str.strip, os.environ.get(VARIABLE, "").split(","))):
        try:
            import_module(module)
        except ModuleNotFoundError as error:
            if error.name not in (module, module.split(".")[0]):
                raise
            raise MissingPackageError(
                f"{VARIABLE} names {module!r}, which is not installed and not on PYTHONPATH", name=module
            ) from None


def foreign(settings: Any) -> dict[str, str]:
    """The parts of other packages in settings, as ``"kind name"`` → package.

    Raises:
        SettingsError: for a part that is not registered: nobody could build it again by its name.
    """
    if not isinstance(settings, Settings):
        values = settings.values() if isinstance(settings, Mapping) else ()
        return {name: package for one in values for name, package in foreign(one).items()}
    found = foreign({one.name: getattr(settings, one.name) for one in fields(settings)})  # type: ignore[arg-type]
    if isinstance(settings, Part):
        known, package = settings.name_and_kind(), type(settings).__module__.split(".")[0]
        if known is None:
            raise SettingsError(f"{type(settings).__name__} has no name: put @register('its_name') on the class")
        if package != __name__.split(".")[0]:
            found[f"{known[1]} {known[0]}"] = package
    return found


def absent(parts: Any) -> list[str]:
    """Which of the parts that :func:`foreign` gave, here or elsewhere, are not registered here; in words."""
    load_plugins()
    given = parts.items() if isinstance(parts, Mapping) else ()
    unknown = [
        (*part.split(" ", 1), package)
        for part, package in given
        if part not in {f"{kind} {name}" for kind, names in Part.registered.items() for name in names}
    ]
    return [f"{kind} {name!r} of the package {package!r}" for kind, name, package in unknown]
