"""What agents learn from, and what to do about recordings that lack it."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict.utils import NestedKey

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.agents.build import build_agent
from torchrl_ocwm.agents.config import AgentConfig
from torchrl_ocwm.agents.presets import AGENTS
from torchrl_ocwm.data import EpisodeDataset, RelabelGoals

#: How to get what recordings may lack.
REMEDIES: dict[NestedKey, str] = {
    ("next", "masks"): "masks of each object come from a segmentation of the images, such as ColourMasks",
    ("next", "object_position"): "positions come from masks and a calibrated camera (MaskToPosition), or do without "
    "them: agent=lexa_cosine with agent.world_model.observed=[proprio]",
    ("next", "object_visible"): "object_visible is true where a position is known, and MaskToPosition writes it",
    ("next", "reward"): "rewards are written for any goal where there are positions (RelabelGoals)",
    ("next", "goal_position"): "goals are drawn where there are positions (RelabelGoals)",
}


def lacking(agent: Agent, dataset: EpisodeDataset) -> list[NestedKey]:
    """Keys that an agent learns from, and that a dataset neither holds nor gets as it is sampled."""
    there = {*dataset.records.keys(True, True)}
    if ("next", "object_position") in there:
        there |= {*RelabelGoals.written}
    return [key for key in agent.loss.in_keys if key not in there]


def remedies(keys: list[NestedKey]) -> str:
    """What to do about missing keys, in words.

    Examples:
        >>> remedies([("next", "reward")])
        'rewards are written for any goal where there are positions (RelabelGoals)'
    """
    return "; ".join(REMEDIES.get(key, f"{key} has to be recorded") for key in keys)


def ruled_out(dataset: EpisodeDataset, agents: Mapping[str, AgentConfig] = AGENTS) -> str | None:
    """Which agents cannot learn from a dataset, what it lacks for them, and how to get that; ``None`` if all can.

    Examples:
        >>> import tempfile
        >>> from torchrl_ocwm.testing import random_dataset, reacher_task
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ruled_out(random_dataset(folder + "/data", reacher_task(), episodes=1)) is None
        True
    """
    lacks = {name: keys for name, row in agents.items() if (keys := lacking(_outline(row, dataset), dataset))}
    if not lacks:
        return None
    missing = list(dict.fromkeys(key for keys in lacks.values() for key in keys))
    by_key = [f"{'.'.join(key)} ({', '.join(name for name in lacks if key in lacks[name])})" for key in missing]
    return f"{dataset.path}: lacks what some agents learn from: {', '.join(by_key)}. {remedies(missing)}"


def _outline(row: AgentConfig, dataset: EpisodeDataset) -> Agent:
    with torch.device("meta"):  # shapes without memory
        return build_agent(row, dataset.task, "debug")
