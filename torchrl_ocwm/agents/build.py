"""Agents and sizes by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.agents.config import AgentConfig, Size
from torchrl_ocwm.agents.presets import AGENTS, SIZES
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.parts import load_plugins
from torchrl_ocwm.settings import SettingsError

T = TypeVar("T")


def build_agent(agent: str | AgentConfig, task: Task, size: str | Size = "cpu") -> Agent:
    """Build an agent for a task.

    Args:
        agent: A name of :data:`AGENTS` or a row of choices of your own.
        task: What the agent is for (:func:`~torchrl_ocwm.envs.make_task`, or the one that a dataset carries).
        size: A name of :data:`SIZES` or a size of your own.

    Raises:
        SettingsError: for an unknown name, with those that there are, or for choices that do not fit together.

    Examples:
        >>> from torchrl_ocwm.testing import reacher_task
        >>> agent = build_agent("dreamer_pcp", reacher_task(), size="debug")
        >>> agent.config.behaviours["reach"].reward
        PositionDistance(unit='metre')
    """
    return Agent(task, _by_name(agent, AGENTS, "agent"), _by_name(size, SIZES, "size"))


def _by_name(choice: str | T, choices: Mapping[str, T], what: str) -> T:
    if not isinstance(choice, str):
        return choice
    if choice not in choices:
        load_plugins()
    if choice not in choices:
        raise SettingsError(f"unknown {what} {choice!r}; there are {', '.join(choices)}")
    return choices[choice]
