"""Object-centric, goal-conditioned world models for robotic object positioning, as components for TorchRL."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_ocwm.agents import build_agent, load_agent, save_agent
    from torchrl_ocwm.envs import make_env, make_task

__version__ = "0.2.0"
__all__ = ["build_agent", "load_agent", "make_env", "make_task", "save_agent"]

_HOMES = {
    "build_agent": "agents",
    "load_agent": "agents",
    "save_agent": "agents",
    "make_env": "envs",
    "make_task": "envs",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"torchrl_ocwm.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
