"""Optimisers."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch.optim import AdamW, Optimizer
from torchrl.trainers.algorithms import DreamerV3Optimizer

from torchrl_ocwm.parts import Part, register
from torchrl_ocwm.settings import setting


class OptimizerPart(Part, kind="optimizer"):
    """How parameters follow their gradients."""

    @abstractmethod
    def build(self, groups: list[dict[str, Any]]) -> Optimizer:
        """The optimiser of parameter groups, each with its ``lr``."""


@register("dreamer_v3")
@dataclass(frozen=True)
class DreamerV3(OptimizerPart):
    """TorchRL's ``DreamerV3Optimizer``: gradients scaled by their moving RMS and by the norm of their parameter.

    Args:
        warmup: Updates until the learning rates are reached.
    """

    warmup: int = setting(0, at_least=0)

    def build(self, groups: list[dict[str, Any]]) -> DreamerV3Optimizer:
        """TorchRL's optimiser."""
        return DreamerV3Optimizer(groups, warmup_steps=self.warmup)


@register("adam")
@dataclass(frozen=True)
class Adam(OptimizerPart):
    """Adam as the Dreamers before the third have it (paper, hyperparameters of DreamerV2).

    Args:
        max_norm: Largest norm of the gradients of a group.
        eps: Adam's ε.
        decay: Share of itself that a weight loses per update, at the group's learning rate.
    """

    max_norm: float = setting(100.0, above=0)
    eps: float = setting(1e-5, above=0)
    decay: float = setting(1e-6, at_least=0, at_most=1)

    def build(self, groups: list[dict[str, Any]]) -> ClippedAdam:
        """Adam with clipped gradients."""
        return ClippedAdam(groups, max_norm=self.max_norm, eps=self.eps, decay=self.decay)


class ClippedAdam(AdamW):
    """Adam with gradients clipped by their norm, and weights that decay.

    Args:
        groups: Parameter groups, each with its ``lr``; the norm of each is clipped on its own.
        max_norm: Largest norm of the gradients of a group.
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
        decaying = [{**group, "weight_decay": decay / group["lr"] if group["lr"] else 0.0} for group in groups]
        super().__init__(decaying, eps=eps, fused=True)
        self.max_norm = max_norm

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Clip the gradients and update the parameters."""
        for group in self.param_groups:
            torch.nn.utils.clip_grad_norm_(group["params"], self.max_norm)
        return super().step(closure)
