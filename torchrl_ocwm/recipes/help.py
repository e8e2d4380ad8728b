"""What ``--help`` says of settings, and the tables of the documentation too: all of it is in the settings classes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, fields
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from torchrl_ocwm.envs.registry import ENVIRONMENTS, EnvChoice
from torchrl_ocwm.parts import Part
from torchrl_ocwm.settings import Settings, describe, field_docs, plain_text, to_dict


def help_text(about: str, kind: type, groups: Mapping[str, str]) -> str:
    """What a command does, and its settings.

    Args:
        about: The docstring of its module, whose first paragraph says it.
        kind: Its settings class.
        groups: Those that are chosen by name, each with its default.
    """
    return "\n".join([plain_text(about.split("\n\n")[0]), "", "Settings:", *help_lines(kind, groups=groups), ""])


def help_lines(kind: type, at: str = "", groups: Mapping[str, str] | None = None) -> Iterator[str]:
    """What each setting of a class is, with its default and the values that it can have: one line each.

    Examples:
        >>> from torchrl_ocwm.training.settings import Training
        >>> next(help_lines(Training, "training"))
        'training.updates=10000: Updates of model, actor and critic in all. [whole number, 1 to 1,000,000,000]'
    """
    docs, hints = field_docs(kind), get_type_hints(kind)
    for one in fields(kind):
        name, hint = f"{at}.{one.name}" if at else one.name, hints[one.name]
        if groups and one.name in groups:
            yield f"{name}={groups[one.name]}: {docs.get(one.name, '')} [one of the configuration groups below]"
        elif not is_group(hint):
            required = not at and one.default is one.default_factory is MISSING
            yield _line(kind, one, name, " (required)" if required else "")
        yield from _below(kind, one.name, hint, name)


def _below(kind: type, field: str, hint: Any, at: str) -> Iterator[str]:
    """What can be set within a setting."""
    if is_group(hint):
        yield from help_lines(hint, at)
    elif isinstance(hint, type) and issubclass(hint, Part):
        yield from _of_one(Part.registered[hint.kind], at)
    elif issubclass(kind, EnvChoice) and field == "options":
        yield from _of_one({name: one.options for name, one in ENVIRONMENTS.items()}, at)
    elif get_origin(hint) in (dict, Mapping) and is_group(get_args(hint)[1]):
        yield from help_lines(get_args(hint)[1], f"{at}.NAME")


def _of_one(kinds: Mapping[str, type], at: str) -> Iterator[str]:
    """The settings of parts or environments of which one is chosen, with the names of those that have it."""
    having: dict[str, dict[str, Field]] = {}
    for who, kind in kinds.items():
        for one in fields(kind):
            having.setdefault(one.name, {})[who] = one
    for name, by in having.items():
        first, one = next(iter(by.items()))
        alike = all(other.default == one.default for other in by.values())
        yield _line(kinds[first], one, f"{at}.{name}", f" ({', '.join(by)})" * (len(by) < len(kinds)), alike=alike)


def _line(kind: type, one: Field, name: str, note: str, *, alike: bool = True) -> str:
    default = f"={written_out(one.default)}" if alike and one.default is not MISSING else ""
    hint = get_type_hints(kind)[one.name]
    parts = Part.registered[hint.kind] if isinstance(hint, type) and issubclass(hint, Part) else ()
    choices = ", ".join(map(code, parts)) or values(kind, one)
    return f"{name}{default}{note}: {field_docs(kind).get(one.name, '')} [{choices}]"


def values(kind: type, one: Field) -> str:
    """What a setting of a class can be.

    Examples:
        >>> from torchrl_ocwm.training.settings import Training
        >>> values(Training, fields(Training)[0])
        'whole number, 1 to 1,000,000,000'
    """
    low, above, high = (one.metadata.get(limit) for limit in ("at_least", "above", "at_most"))
    words = in_words(get_type_hints(kind)[one.name])
    if low is not None and high is not None:
        return f"{words}, {low:,} to {high:,}"
    limits = {"at least": low, "above": above, "at most": high}
    return ", ".join([words, *(f"{words} {limit:,}" for words, limit in limits.items() if limit is not None)])


def in_words(hint: Any) -> str:
    """A type, for people.

    Examples:
        >>> in_words(tuple[int, ...] | None)
        'list of whole numbers, `null`'
    """
    words = {int: "whole number", float: "number", bool: "`true`, `false`", str: "text", NoneType: "`null`"}
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return ", ".join(map(code, arguments))
    if origin in (Union, UnionType):
        return ", ".join(map(in_words, arguments))
    if origin is tuple:
        return f"list of {in_words(arguments[0])}{'s' if arguments[0] in words else ''}"
    if origin in (dict, Mapping):
        return "names and what they stand for"
    if isinstance(hint, type) and issubclass(hint, Part):
        return f"name of a part ({hint.kind.replace('_', ' ')})"
    return words.get(hint) or describe(hint)


def is_group(hint: Any) -> bool:
    """Whether a setting is a class of settings, and no part."""
    return isinstance(hint, type) and issubclass(hint, Settings) and not issubclass(hint, Part)


def code(text: Any) -> str:
    """A text as Markdown shows code."""
    return f"`{text}`"


def written_out(value: Any) -> str:
    """A value as it stands on a command line.

    Examples:
        >>> written_out(("cube", 200.0, None))
        '[cube, 200, null]'
    """
    plain = to_dict(value)
    if isinstance(plain, list):
        return f"[{', '.join(map(written_out, plain))}]"
    if isinstance(plain, float):
        return f"{plain:g}"
    return {"None": "null", "True": "true", "False": "false"}.get(str(plain), str(plain))
