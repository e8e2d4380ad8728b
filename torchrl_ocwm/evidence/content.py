"""What a run is named by: its settings, without those that have their default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

from torchrl_ocwm.envs import find_environment
from torchrl_ocwm.settings import Settings, from_dict


def essential(content: Any) -> Any:
    """Settings without those that have their default.

    So a setting that is added later, with what was the rule before as its default, changes no name.

    Examples:
        >>> from torchrl_ocwm.training import Training
        >>> essential({"training": Training(seed=3), "env": "reacher"})
        {'training': {'seed': 3}, 'env': 'reacher'}
    """
    if isinstance(content, Mapping):
        return {name: essential(value) for name, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [essential(value) for value in content]
    if not is_dataclass(content):
        return content
    known = content.name_and_kind() if isinstance(content, Settings) else None
    name: dict[str, Any] = {} if known is None else {"name": known[0]}
    values = {one.name: getattr(content, one.name) for one in fields(content) if not _is_default(content, one)}
    return {**name, **{name: essential(value) for name, value in values.items()}}


def _is_default(settings: Any, one: Any) -> bool:
    default = one.default if one.default_factory is MISSING else one.default_factory()
    return bool(getattr(settings, one.name) == default)


def all_options(env: str, options: Mapping[str, Any]) -> Any:
    """The options of an environment as its settings class, which has the defaults of the others."""
    return from_dict(find_environment(env).options, options, "options")


def image_size(env: str, options: Mapping[str, Any]) -> int:
    """Pixels on a side; an environment of a plugin may have another name for it, and then it is 0."""
    return getattr(all_options(env, options), "image_size", 0)
