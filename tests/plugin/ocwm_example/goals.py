"""A goal source that has a state."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential

from torchrl_ocwm.agents import GoalEncoding, GoalSource, register
from torchrl_ocwm.settings import setting


class RememberedPlaces(TensorDictModuleBase):
    """Goals from a list of places in workspace units."""

    places: torch.Tensor

    def __init__(self, number: int, dim: int) -> None:
        super().__init__()
        self.register_buffer("places", 2 * torch.rand(number, dim) - 1)
        self.in_keys, self.out_keys = [("latent", "state")], ["goal_units"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        index = torch.randint(len(self.places), tensordict.batch_size, device=self.places.device)
        return tensordict.set("goal_units", self.places[index])


@register("remembered")
@dataclass(frozen=True)
class Remembered(GoalSource):
    """Each imagined start gets one of a few places.

    Args:
        number: How many.
    """

    number: int = setting(3, at_least=1)

    def build(self, dim: int, goal: GoalEncoding) -> TensorDictModuleBase:
        """A place, then its encoding."""
        encode = TensorDictModule(goal.position, ["goal_units"], [("latent", "goal")])
        return TensorDictSequential(RememberedPlaces(self.number, dim), encode)
