"""Options of the environments that runs are in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchrl_ocwm.envs import find_environment
from torchrl_ocwm.settings import from_dict


def all_options(env: str, options: Mapping[str, Any]) -> Any:
    """The options of an environment as its settings class, which has the defaults of the others."""
    return from_dict(find_environment(env).options, options, "options")


def image_size(env: str, options: Mapping[str, Any]) -> int:
    """Pixels on a side; an environment of a plugin may have another name for it, and then it is 0."""
    return getattr(all_options(env, options), "image_size", 0)
