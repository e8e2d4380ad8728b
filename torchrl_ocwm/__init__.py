"""Object-centric, goal-conditioned world models for robotic object positioning, as components for TorchRL."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchrl_ocwm.lazy import lazily

if TYPE_CHECKING:
    from torchrl_ocwm.agents import build_agent, load_agent, save_agent
    from torchrl_ocwm.envs import make_env, make_task

__version__ = "0.2.0"
__all__ = ["build_agent", "load_agent", "make_env", "make_task", "save_agent"]

__getattr__ = lazily(
    __name__,
    {
        "build_agent": "agents",
        "load_agent": "agents",
        "save_agent": "agents",
        "make_env": "envs",
        "make_task": "envs",
    },
)
