"""A goal that actor and critic see in waves, and the reward that judges by it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from torchrl_ocwm.agents import Goal, GoalEncoding, ImaginedReward, Reward, Scene, register
from torchrl_ocwm.settings import setting


class Fourier(nn.Module):
    """Sines and cosines ``[..., 2 D W]`` of positions ``[..., D]`` in workspace units."""

    waves: Tensor

    def __init__(self, number: int) -> None:
        super().__init__()
        self.register_buffer("waves", torch.arange(1.0, number + 1))

    def forward(self, position: Tensor) -> Tensor:
        angles = (position.unsqueeze(-1) * self.waves).flatten(-2)
        return torch.cat([angles.sin(), angles.cos()], -1)


@register("waves")
@dataclass(frozen=True)
class Waves(Goal):
    """The position of the goal as sines and cosines.

    Args:
        number: How many of each, for each axis.
    """

    number: int = setting(2, at_least=1)

    def build(self, scene: Scene) -> GoalEncoding:
        """A frame is the goal of the object's place in it."""
        dim, encode = scene.model.units.dim, Fourier(self.number)
        frame = TensorDictModule(nn.Sequential(_OneOf(scene), encode), ["object_units"], [("latent", "goal")])
        return GoalEncoding(2 * dim * self.number, encode, None, frame, object_index=scene.object_index)


@register("in_phase")
@dataclass(frozen=True)
class InPhase(Reward):
    """Minus the distance of what the object's place is in waves from the goal."""

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        assert goal is not None
        one, encode = _OneOf(scene), goal.position

        def reward(positions: Tensor, seen: Tensor) -> Tensor:
            return -(encode(one(positions)) - seen).norm(dim=-1, keepdim=True)

        judge = TensorDictModule(reward, ["object_units", ("latent", "goal")], ["reward"])
        return ImaginedReward(TensorDictSequential(scene.model.object_position(), judge))


class _OneOf(nn.Module):
    """The place ``[..., D]`` of the object that a behaviour is about, of those of all ``[..., O * D]``."""

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.dim, self.index = scene.model.units.dim, scene.object_index

    def forward(self, positions: Tensor) -> Tensor:
        return positions.unflatten(-1, (-1, self.dim))[..., self.index, :]
