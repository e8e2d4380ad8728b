"""The episodes of an agent towards all goals, and what it expected of them."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_ocwm.agents import Policy
from torchrl_ocwm.data import position_reward
from torchrl_ocwm.evaluation import (
    EvaluationEnvs,
    Footage,
    ReconstructionError,
    imagined_distance,
    measure,
    predicted_return,
)

IMAGE_GOALS = ", image goals"  # after the name of a row; without it goals are positions


def goal_kinds(policy: Policy, image_goals: bool) -> list[str]:
    """What goals a policy is evaluated with, by the end of its row's name: images too, or if it takes nothing else."""
    positions = [""] if policy.takes_positions else []
    return positions + [IMAGE_GOALS] * (policy.takes_images and (image_goals or not positions))


def score(
    policy: Policy, envs: EvaluationEnvs, goals: Tensor, seed: int, images: Tensor | None, footage: Footage
) -> dict[str, Tensor]:
    """Scores and errors of an agent for each goal, metrics by name.

    Args:
        policy: The agent.
        envs: Where it plays.
        goals: ``[N, D]``, metres.
        seed: Seeds start states and imagination.
        images: ``[N, 3, H, W]``, the goals as images, for an agent that is to get such.
        footage: Keeps the episodes that are filmed.
    """
    reconstruct = ReconstructionError(policy.agent, object_index=policy.object_index)

    def inspect(step: TensorDictBase) -> dict[str, Tensor | TensorDictBase]:
        footage(step)
        return {**reconstruct(step), "latent": step["latent"].select("state", "belief", "goal", strict=False)}

    episodes = envs.run(policy, goals, images=images, seed=seed, inspect=inspect, progress=True)
    errors = {name: episodes[name].mean(1) for name in ("entity_error", "goal_error") if name in episodes}
    if "object_position" in policy.agent.model.decoded:
        errors["imagined_distance"] = imagined_distance(
            policy.behaviour,
            episodes["latent"][:, 0],
            goals,
            envs.episode_steps,
            object_index=policy.object_index,
            seed=seed,
        )
    if "reward_head" in policy.behaviour.config.reward.needs:  # which learns the rewards of the records
        gamma = policy.agent.size.learning.gamma
        reward = position_reward(episodes["object_position"], episodes["goal_position"], policy.object_index)
        errors["predicted_return"] = predicted_return(policy.behaviour, episodes["latent"][:, 0])
        errors["obtained_return"] = (reward * gamma ** torch.arange(reward.shape[1])).sum(1)
    return {**measure(episodes, object_index=policy.object_index), **errors}
