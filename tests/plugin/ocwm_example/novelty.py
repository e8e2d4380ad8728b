"""An exploration reward that learns: how badly a network guesses what a random one says of a state."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_ocwm.agents import EXPLORERS, Behaviour, GoalEncoding, ImaginedReward, Reward, Scene, register
from torchrl_ocwm.settings import setting


class RandomDistillation(nn.Module):
    """The squared error ``[..., 1]`` of the guess for states ``[..., S]``."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.guess = nn.Linear(features, 8)
        self.register_buffer("random", torch.randn(8, features))

    def forward(self, state: Tensor) -> Tensor:
        return (self.guess(state) - state @ self.random.mT).square().mean(-1, keepdim=True)


class RandomDistillationLoss(LossModule):
    """Trains the guess on the states of the records."""

    def __init__(self, network: RandomDistillation) -> None:
        super().__init__()
        self.network = network
        self.in_keys, self.out_keys = [("records", "next", "state")], ["loss_novelty"]

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        pass

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return TensorDict({"loss_novelty": self.network(tensordict["records", "next", "state"]).mean()})


@register("novelty")
@dataclass(frozen=True)
class Novelty(Reward):
    """The error of the guess.

    Args:
        lr: Learning rate of the guess.
    """

    lr: float = setting(1e-2, above=0)

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """Reward and loss share the network."""
        network = RandomDistillation(scene.architecture.categoricals * scene.architecture.classes)
        reward = TensorDictModule(network, [("latent", "state")], ["reward"])
        return ImaginedReward(reward, RandomDistillationLoss(network), self.lr)


EXPLORERS["novelty"] = Behaviour(reward=Novelty())
