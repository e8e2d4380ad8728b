"""A world model with a wider belief, and an optimiser."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from torchrl_ocwm.agents import Architecture, Flat, OptimizerPart, register
from torchrl_ocwm.envs import Task
from torchrl_ocwm.modules import FlatWorldModel
from torchrl_ocwm.settings import setting


@register("wide")
@dataclass(frozen=True)
class Wide(Flat):
    """A flat world model with a wider belief.

    Args:
        times: How many times wider.
    """

    times: int = setting(2, at_least=1)

    def build(self, task: Task, architecture: Architecture, needs: Mapping[str, Any]) -> FlatWorldModel:
        """The flat one, of another architecture."""
        return super().build(task, replace(architecture, belief=self.times * architecture.belief), needs)


@register("sgd")
@dataclass(frozen=True)
class SGD(OptimizerPart):
    """Plain gradient descent.

    Args:
        momentum: Share of the step before.
    """

    momentum: float = setting(0.0, at_least=0, at_most=1)

    def build(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        """PyTorch's own."""
        return torch.optim.SGD(groups, momentum=self.momentum)
