"""What an agent believes that it will do: rollouts of the policy in its own world model."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.agents.behaviour import LearntBehaviour
from torchrl_ocwm.data.seeds import episode_seed
from torchrl_ocwm.evaluation.randomness import EpisodeRandomness


@torch.no_grad()
def imagined_rollout(
    agent: Agent | LearntBehaviour, latent: TensorDictBase, steps: int, *, seed: int = 0
) -> TensorDictBase:
    """What an agent imagines from a latent when it acts on its own predictions, without exploration.

    Args:
        agent: The agent, or one of its behaviours if not that which acts is meant.
        latent: ``[N]`` with state, belief and, if the agent is conditioned on one, goal.
        steps: Steps to imagine.
        seed: Seeds what the world model draws, together with the number of the row.

    Returns:
        ``[N, steps]`` with ``latent`` and ``action``; the first latent is the given one.
    """
    latent = latent.select("state", "belief", "goal", strict=False)
    start = TensorDict({"latent": latent}, latent.batch_size)
    actor: Callable[[TensorDictBase], TensorDictBase] = agent.actor
    randomness = EpisodeRandomness([episode_seed("imagine", seed, number) for number in range(len(latent))])
    with set_exploration_type(ExplorationType.DETERMINISTIC), randomness:
        return agent.imagination.rollout(
            steps, actor, auto_reset=False, tensordict=start, break_when_any_done=False
        ).select("latent", "action")


@torch.no_grad()
def imagined_distance(
    agent: Agent | LearntBehaviour,
    latent: TensorDictBase,
    goals: Tensor,
    steps: int,
    *,
    object_index: int = 0,
    seed: int = 0,
) -> Tensor:
    """How far from its goal an agent expects the object to be in the end.

    Where this is small and the real distance large, the policy exploits errors of the world model; where both are
    large, the policy has not learned what the model would let it do.

    Args:
        agent: The agent, or one of its behaviours if not that which acts is meant.
        latent: ``[N]``, as for :func:`imagined_rollout`.
        goals: ``[N, D]`` metres.
        steps: Steps to imagine.
        object_index: Which object.
        seed: As for :func:`imagined_rollout`.

    Returns:
        ``[N]`` metres, of the position that the world model decodes from the last latent.
    """
    last = imagined_rollout(agent, latent, steps + 1, seed=seed)[:, -1].select("latent")
    decoded = agent.model.object_position()(last)["object_units"].unflatten(-1, (-1, agent.model.units.dim))
    return torch.linalg.vector_norm(agent.model.units.to_metres(decoded[:, object_index]) - goals, dim=-1)


@torch.no_grad()
def predicted_return(behaviour: LearntBehaviour, latent: TensorDictBase) -> Tensor:
    """What a behaviour's critic expects, without a rollout: the discounted sum of all rewards from here on.

    Args:
        behaviour: The behaviour.
        latent: ``[N]``, as for :func:`imagined_rollout`.

    Returns:
        ``[N]``, in the unit of the rewards.
    """
    value = behaviour.loss.value_loss
    here = TensorDict({"latent": latent.select("state", "belief", "goal", strict=False)}, latent.batch_size)
    with value.value_model_params.to_module(value.value_model):
        return value.value_model(here)["state_value"].squeeze(-1)
