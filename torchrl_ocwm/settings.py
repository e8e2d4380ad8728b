"""Settings: dataclasses whose values are checked when they are made, whoever makes them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, field, fields, is_dataclass
from functools import cache
from inspect import cleandoc
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from torchrl_ocwm.errors import UserError

T = TypeVar("T")


class SettingsError(UserError, ValueError):
    """A setting has a value that it cannot have; the message names the setting, the value and what it can have."""


def setting(
    default: Any = MISSING,
    *,
    at_least: float | None = None,
    above: float | None = None,
    at_most: float | None = None,
    **notes: Any,
) -> Any:
    """A field of a settings class, with the range of its values; of each of them, if it holds several.

    Args:
        default: Its value unless another is given; none: it has to be given.
        at_least: Its smallest value.
        above: What it has to be larger than.
        at_most: Its largest value.
        notes: What else is to be known of it, for whoever reads the field's metadata.
    """
    limits = {"at_least": at_least, "above": above, "at_most": at_most}
    known = {name: limit for name, limit in limits.items() if limit is not None}
    return field(default=default, metadata={**known, **notes})


class Settings:
    """Base of frozen dataclasses whose values are checked against their types and ranges when they are made.

    A subclass is a ``@dataclass(frozen=True)``; its docstring says what each field is, under ``Args:``. What the types
    cannot say, it checks in :meth:`validate`.

    Raises:
        SettingsError: for a value of another type, outside its range, or that :meth:`validate` refuses.

    Examples:
        >>> from dataclasses import dataclass
        >>> @dataclass(frozen=True)
        ... class Colour(Settings):
        ...     red: float = setting(0.5, at_least=0, at_most=1)
        >>> Colour(red=1)
        Colour(red=1.0)
        >>> Colour(red=2)
        Traceback (most recent call last):
        torchrl_ocwm.settings.SettingsError: red must be at most 1, got 2.0
    """

    def __post_init__(self) -> None:
        for one in fields(self):  # type: ignore[arg-type]
            value = read(_hints(type(self))[one.name], getattr(self, one.name), one.name)
            _check_range(one, value)
            object.__setattr__(self, one.name, value)
        self.validate()

    def validate(self) -> None:
        """Check what types and ranges cannot say; raises :class:`SettingsError`."""

    @classmethod
    def name_and_kind(cls) -> tuple[str, str] | None:
        """The name under which the class is registered, and the kind of part that it is, if it is one."""
        return None


def read(hint: Any, value: Any, at: str) -> Any:
    """A value as the type of a setting, from a mapping, a file or a command line.

    Whole numbers are taken for real ones and lists for tuples; nothing else is converted.

    Args:
        hint: The type: a number, ``bool``, ``str``, ``Literal``, ``None`` or a union, a tuple or dictionary of them, or
            a settings class, given as itself or as a mapping of its fields.
        value: The value.
        at: The setting's name, for the message.

    Raises:
        SettingsError: if it is of another type.

    Examples:
        >>> read(tuple[float, ...], [1, 2.5], "sizes")
        (1.0, 2.5)
        >>> read(Literal["a", "b"], "c", "letter")
        Traceback (most recent call last):
        torchrl_ocwm.settings.SettingsError: letter must be one of 'a', 'b', got 'c'
    """
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if origin in (Union, UnionType):
        return _read_union(arguments, value, at)
    if origin is tuple:
        return _read_tuple(hint, value, at)
    if origin in (dict, Mapping):
        return _read_dict(hint, value, at)
    if is_dataclass(hint) or (isinstance(hint, type) and issubclass(hint, Settings)):
        return _read_settings(hint, value, at)
    if origin is Literal:
        fits = value in arguments and type(value) in {type(choice) for choice in arguments}
    elif hint is float:
        fits = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        value = float(value) if fits else value
    elif hint is int:
        fits = isinstance(value, int) and not isinstance(value, bool)
    else:
        fits = isinstance(value, NoneType if hint is None else hint)
    if not fits:
        raise SettingsError(f"{at} must be {describe(hint)}, got {value!r}")
    return value


def from_dict(kind: type[T], values: Any, at: str = "") -> T:
    """Settings from a mapping of their fields; what it lacks has its default.

    Args:
        kind: The settings class.
        values: The mapping, as :func:`to_dict` gives it or a file holds it.
        at: Where the mapping is from, put before the names of fields in messages.

    Raises:
        SettingsError: for a field that there is not, that is missing, or that has a value that it cannot have.
    """
    where = f"{at}." if at else ""
    if not isinstance(values, Mapping):
        raise SettingsError(f"{at or kind.__name__} must be a mapping of settings, got {values!r}")
    known: dict[str, Field] = {one.name: one for one in fields(kind)}  # type: ignore[arg-type]
    odd = [name for name in values if name not in known]
    if odd:
        raise SettingsError(f"{where}{odd[0]} is no setting; there are {', '.join(known) or 'none'}")
    hints = _hints(kind)
    given = {name: read(hints[name], value, where + name) for name, value in values.items()}
    lacking = [
        name for name, one in known.items() if one.default is one.default_factory is MISSING and name not in given
    ]
    if lacking:
        raise SettingsError(f"{where}{lacking[0]} is missing")
    try:
        return kind(**given)
    except SettingsError as error:
        raise SettingsError(f"{where}{error}") from None


def to_dict(settings: Any, *, defaults: bool = True) -> Any:
    """Settings as a mapping that fits in JSON and YAML; a registered part has its name in it.

    Args:
        settings: Of any kind, or mappings and lists of them.
        defaults: Whether those that have their default are in it.

    Examples:
        >>> from torchrl_ocwm.agents import AGENTS
        >>> to_dict(AGENTS["dreamer_pcp"])["behaviours"]["reach"]["reward"]
        {'name': 'position_distance', 'unit': 'metre'}
    """
    if isinstance(settings, Mapping):
        return {name: to_dict(value, defaults=defaults) for name, value in settings.items()}
    if isinstance(settings, (list, tuple)):
        return [to_dict(value, defaults=defaults) for value in settings]
    if not is_dataclass(settings):
        return settings
    known = settings.name_and_kind() if isinstance(settings, Settings) else None
    name: dict[str, Any] = {} if known is None else {"name": known[0]}
    given = [one for one in fields(settings) if defaults or not _is_default(settings, one)]
    return {**name, **{one.name: to_dict(getattr(settings, one.name), defaults=defaults) for one in given}}


def _is_default(settings: Any, one: Field) -> bool:
    default = one.default if one.default_factory is MISSING else one.default_factory()
    return bool(getattr(settings, one.name) == default)


def flat(values: Mapping[str, Any], at: str = "") -> dict[str, Any]:
    """A nested mapping with dotted names.

    Examples:
        >>> flat({"a": {"b": 1, "c": [2]}})
        {'a.b': 1, 'a.c': [2]}
    """
    leaves: dict[str, Any] = {}
    for name, value in values.items():
        leaves.update(flat(value, f"{at}{name}.") if isinstance(value, Mapping) else {at + name: value})
    return leaves


def differences(one: Any, other: Any, of_one: str, of_other: str) -> str:
    """What differs between two settings, or mappings of settings, by dotted names and in words.

    Examples:
        >>> from torchrl_ocwm.envs import Workspace
        >>> differences(Workspace((0.0,), (1.0,)), Workspace((0.0,), (2.0,)), "there", "here")
        'high: [1.0] there, [2.0] here'
    """
    left, right = flat(to_dict(one)), flat(to_dict(other))
    names = [name for name in dict.fromkeys([*right, *left]) if left.get(name) != right.get(name)]
    return "; ".join(f"{name}: {left.get(name)} {of_one}, {right.get(name)} {of_other}" for name in names)


def change(settings: T, changes: Mapping[str, Any]) -> T:
    """A copy of settings with some of them changed, by dotted names.

    Args:
        settings: The settings.
        changes: Name → value; a part may be given by its name.

    Raises:
        SettingsError: for a setting that there is not, or a value that it cannot have.

    Examples:
        >>> from torchrl_ocwm.agents import AGENTS
        >>> change(AGENTS["dreamer"], {"world_model.lambda_goal_position": 200}).world_model.lambda_goal_position
        200.0
    """
    values = to_dict(settings)
    for name, value in changes.items():
        *path, last = name.split(".")
        place = values
        for step in path:
            place = place.get(step)
            if not isinstance(place, dict):
                raise SettingsError(f"{name} is no setting")
        place[last] = to_dict(value)
    return from_dict(type(settings), values)


def describe(hint: Any) -> str:
    """A type in words.

    Examples:
        >>> describe(int | None), describe(tuple[float, ...])
        ('a whole number or null', 'a list, each a number')
    """
    origin, arguments = get_origin(hint), get_args(hint)
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", NoneType: "null"}
    if origin is Literal:
        return "one of " + ", ".join(map(repr, arguments))
    if origin in (Union, UnionType):
        return " or ".join(describe(one) for one in arguments)
    if origin is tuple:
        return f"a list, each {describe(arguments[0])}"
    return words.get(hint) or str(getattr(hint, "__name__", hint))


@cache
def field_docs(kind: Any) -> dict[str, str]:
    """What the docstrings of a settings class and its bases say of each field, each on one line.

    Examples:
        >>> from torchrl_ocwm.agents import Learning
        >>> field_docs(Learning)["batch_size"]
        'Sequences per update.'
    """
    docs: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        section = cleandoc(base.__dict__.get("__doc__") or "").partition("Args:\n")[2]
        section = re.split(r"\n\S", section, maxsplit=1)[0]
        entries = re.findall(r"^    (\w+): (.*(?:\n {5,}.*)*)", section, re.MULTILINE)
        docs.update({name: plain_text(text) for name, text in entries})
    return docs


def plain_text(docstring: str) -> str:
    r"""Some of a docstring on one line, as Markdown has it and a terminal shows it.

    Examples:
        >>> plain_text("Draws ``n`` goals\n    (:class:`~torchrl_ocwm.modules.UniformGoals`).")
        'Draws `n` goals (`UniformGoals`).'
    """
    text = re.sub(r":\w+:`(?:~[\w.]*\.)?([^`]*)`", r"`\1`", docstring)
    return " ".join(text.split()).replace("``", "`")


_hints: Callable[[Any], dict[str, Any]] = cache(get_type_hints)


def _read_union(choices: tuple[Any, ...], value: Any, at: str) -> Any:
    if value is None and NoneType in choices:
        return None
    others = [choice for choice in choices if choice is not NoneType]
    if len(others) == 1:
        try:
            return read(others[0], value, at)
        except SettingsError as error:
            if " must be " + describe(others[0]) in str(error) and NoneType in choices:
                raise SettingsError(f"{at} must be {describe(others[0])} or null, got {value!r}") from None
            raise
    for choice in others:
        try:
            return read(choice, value, at)
        except SettingsError:
            continue
    raise SettingsError(f"{at} must be {' or '.join(map(describe, choices))}, got {value!r}")


def _read_tuple(hint: Any, value: Any, at: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise SettingsError(f"{at} must be {describe(hint)}, got {value!r}")
    arguments = get_args(hint)
    if arguments[-1] is not Ellipsis:
        if len(value) != len(arguments):
            raise SettingsError(f"{at} must have {len(arguments)} values, got {value!r}")
        return tuple(read(one, item, at) for one, item in zip(arguments, value, strict=True))
    return tuple(read(arguments[0], item, at) for item in value)


def _read_dict(hint: Any, value: Any, at: str) -> dict[str, Any]:
    if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
        raise SettingsError(f"{at} must be a mapping of names, got {value!r}")
    return {name: read(get_args(hint)[1], one, f"{at}.{name}") for name, one in value.items()}


def _read_settings(hint: Any, value: Any, at: str) -> Any:
    if isinstance(value, hint):
        return value
    named = getattr(hint, "named", None)
    return named(value, at) if named is not None else from_dict(hint, value, at)


def _check_range(one: Field, value: Any) -> None:
    limits = one.metadata
    for item in value if isinstance(value, tuple) else (value,):
        if item is None:
            continue
        if "at_least" in limits and item < limits["at_least"]:
            raise SettingsError(f"{one.name} must be at least {limits['at_least']}, got {item}")
        if "above" in limits and item <= limits["above"]:
            raise SettingsError(f"{one.name} must be above {limits['above']}, got {item}")
        if "at_most" in limits and item > limits["at_most"]:
            raise SettingsError(f"{one.name} must be at most {limits['at_most']}, got {item}")
