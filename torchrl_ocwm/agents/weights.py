"""What an agent has learnt, under names that last: by the part it plays, not by its place in a sequence of modules."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.agents.behaviour import LearntBehaviour


class AgentWeights:
    """Parameters and running statistics of an agent, each once, as a state dict.

    ``model.*`` are the world model's; ``NAME.actor.*``, ``NAME.critic.*``, ``NAME.slow_critic.*``, ``NAME.returns.*``,
    ``NAME.goal.*`` and ``NAME.reward.*`` those of a behaviour. The last two are what goal and reward have of their own.

    Args:
        agent: The agent.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import reacher_task
        >>> weights = AgentWeights(build_agent("dreamer_pcp", reacher_task(), size="debug"))
        >>> sorted({name.rpartition(".")[0].split(".mlp")[0] for name in weights.state_dict() if "actor" in name})
        ['reach.actor']
    """

    def __init__(self, agent: Agent) -> None:
        self.agent = agent

    def state_dict(self) -> dict[str, Tensor]:
        """Its tensors, detached."""
        return {name: tensor.detach() for name, tensor in self._tensors()}

    def load_state_dict(self, state_dict: Mapping[str, Tensor]) -> None:
        """Take the tensors of another agent like it.

        Raises:
            RuntimeError: for tensors that it lacks, has no place for, or has with another shape.
        """
        own = dict(self._tensors())
        if lacking := sorted(own.keys() ^ state_dict.keys()):
            where = "missing" if lacking[0] in own else "unknown"
            raise RuntimeError(f"{where} weights {lacking[0]!r} ({len(lacking)} in all)")
        for name, tensor in own.items():
            if tensor.shape != state_dict[name].shape:
                raise RuntimeError(
                    f"weights {name!r} have shape {tuple(state_dict[name].shape)}, not {tuple(tensor.shape)}"
                )
        with torch.no_grad():
            for name, tensor in own.items():
                tensor.copy_(state_dict[name])

    def _tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Each tensor with its name; what several modules share has that of the first."""
        seen: set[tuple[int, torch.Size]] = set()
        for role, tensors in self._roles():
            for name, tensor in tensors:
                if (place := (tensor.data_ptr(), tensor.shape)) not in seen:
                    seen.add(place)
                    yield f"{role}.{name}", tensor

    def _roles(self) -> Iterator[tuple[str, Iterator[tuple[str, Tensor]]]]:
        yield "model", _of(self.agent.model)
        for name in self.agent.behaviours:
            learnt = self.agent.behaviour(name)
            yield f"{name}.actor", _of(learnt.actor[0].module)
            yield f"{name}.critic", _of_critic(learnt, "value_model_params")
            yield f"{name}.slow_critic", _of_critic(learnt, "target_value_model_params")
            yield f"{name}.returns", _of(learnt.loss.actor_loss.retnorm)
            if learnt.goal is not None:
                yield f"{name}.goal", _of(learnt.goal.position)
                yield f"{name}.goal.image", _of(learnt.goal.image)
                yield f"{name}.goal.frame", _of(learnt.goal.frame)
            yield f"{name}.goal.source", _of(learnt.loss.goal_source)
            yield f"{name}.reward", _of(learnt.reward)
            yield f"{name}.reward.loss", _of(learnt.loss.reward_loss)


def _of(module: nn.Module | None) -> Iterator[tuple[str, Tensor]]:
    if module is not None:
        yield from module.state_dict(keep_vars=True).items()


def _of_critic(learnt: LearntBehaviour, which: str) -> Iterator[tuple[str, Tensor]]:
    """The network's parameters; the other modules of a critic have none."""
    parameters: Any = learnt.loss.value_loss._modules  # as attributes they come with a warning about their updates
    network, trained = (parameters[name]["module", "0", "module"] for name in (which, "value_model_params"))
    for key in trained.keys(True, True):
        if isinstance(trained[key], nn.Parameter):
            yield ".".join(key), network[key]
