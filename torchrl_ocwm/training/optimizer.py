"""Optimisers by name, with a learning rate each for model, actor and critic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch.optim import AdamW, Optimizer
from torchrl.trainers.algorithms import DreamerV3Optimizer

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.agents.config import Size


class ClippedAdam(AdamW):
    """Adam as the Dreamers before the third have it: gradients clipped by their norm, weights that decay.

    Args:
        groups: Parameter groups, each with its ``lr``; the norm of each is clipped on its own.
        max_norm: Largest norm of the gradients of a group (paper, hyperparameters of DreamerV2).
        eps: Adam's ε.
        decay: Share of itself that a weight loses per update, at the group's learning rate.

    Examples:
        >>> weight = torch.nn.Parameter(torch.ones(2))
        >>> optimizer = ClippedAdam([{"params": [weight], "lr": 0.1}], max_norm=1.0)
        >>> (300 * weight).sum().backward()
        >>> _ = optimizer.step()
        >>> weight.grad.norm(), weight.detach()
        (tensor(1.0000), tensor([0.9000, 0.9000]))
    """

    def __init__(
        self, groups: list[dict[str, Any]], *, max_norm: float = 100.0, eps: float = 1e-5, decay: float = 1e-6
    ) -> None:
        # A learning rate of 0 keeps a part as it is, so that nothing of it decays.
        decaying = [{**group, "weight_decay": decay / group["lr"] if group["lr"] else 0.0} for group in groups]
        super().__init__(decaying, eps=eps, fused=True)
        self.max_norm = max_norm

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Clip the gradients and update the parameters."""
        for group in self.param_groups:
            torch.nn.utils.clip_grad_norm_(group["params"], self.max_norm)
        return super().step(closure)


def _dreamer_v3(groups: list[dict[str, Any]], size: Size) -> DreamerV3Optimizer:
    return DreamerV3Optimizer(groups, warmup_steps=size.warmup)


def _adam(groups: list[dict[str, Any]], size: Size) -> ClippedAdam:  # noqa: ARG001
    return ClippedAdam(groups)


OPTIMIZERS: dict[str, Callable[[list[dict[str, Any]], Size], Optimizer]] = {
    "dreamer_v3": _dreamer_v3,
    "adam": _adam,
}


def make_optimizer(agent: Agent) -> Optimizer:
    """The optimiser that an agent's size names."""
    loss, size = agent.loss, agent.size
    groups = [
        (loss.model_loss.parameters(), size.model_lr),
        (loss.actor_loss.actor_model.parameters(), size.actor_lr),
        (loss.value_loss.value_model_params.parameters(), size.value_lr),
    ]
    return OPTIMIZERS[size.optimizer]([{"params": list(parameters), "lr": rate} for parameters, rate in groups], size)
