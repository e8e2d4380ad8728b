"""What agents learn from, and what to do about recordings that lack it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

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
    ("next", "object_position"): "positions come from masks and a calibrated camera (MaskToPosition), and goals and "
    "rewards from positions (RelabelGoals); agent=lexa_cosine does without them if "
    "agent.world_model.observed=[proprio]",
    ("next", "object_visible"): "object_visible is true where a position is known, and MaskToPosition writes it",
}
#: What there is wherever there are positions.
_FROM_POSITIONS = {("next", "object_visible"), *RelabelGoals.written}


def lacking(agent: Agent, dataset: EpisodeDataset) -> list[NestedKey]:
    """Keys that an agent learns from, and that a dataset neither holds nor gets as it is sampled.

    What comes with positions is left out where these are among them.
    """
    there = {*dataset.records.keys(True, True)}
    if ("next", "object_position") in there:
        there |= {*RelabelGoals.written}
    missing = [key for key in agent.loss.in_keys if key not in there]
    return [key for key in missing if key not in _FROM_POSITIONS or ("next", "object_position") not in missing]


def remedies(keys: Iterable[NestedKey]) -> str:
    """What to do about missing keys, in words.

    Examples:
        >>> remedies([("next", "masks")])
        'masks of each object come from a segmentation of the images, such as ColourMasks'
    """
    return "; ".join(REMEDIES.get(key, f"{_name(key)} has to be recorded") for key in keys)


def ruled_out(dataset: EpisodeDataset, agents: Mapping[str, AgentConfig] = AGENTS) -> str | None:
    """Which agents cannot learn from a dataset, what it lacks for them, and how to get that; ``None`` if all can.

    Examples:
        >>> import tempfile
        >>> from torchrl_ocwm.testing import random_dataset, reacher_task
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ruled_out(random_dataset(folder + "/data", reacher_task(), episodes=1)) is None
        True
    """
    lacks = {name: lacking(_outline(row, dataset), dataset) for name, row in agents.items()}
    missing = list(dict.fromkeys(key for keys in lacks.values() for key in keys))
    if not missing:
        return None
    who = {key: [name for name in agents if key in lacks[name]] for key in missing}
    listed = ", ".join(
        f"{_name(key)} (for {'all agents' if len(names) == len(agents) else ', '.join(names)})"
        for key, names in who.items()
    )
    return f"{dataset.path}: lacks {listed}. {remedies(missing)}"


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else str(key[-1])


def _outline(row: AgentConfig, dataset: EpisodeDataset) -> Agent:
    with torch.device("meta"):  # shapes without memory
        return build_agent(row, dataset.task, "debug")
