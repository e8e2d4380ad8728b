"""How many steps apart two states are, learnt from pairs of them (LEXA temporal)."""

from __future__ import annotations

from itertools import pairwise

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import batch_norm


class TemporalDistance(nn.Module):
    """Steps that it takes from one state to another as a share of a horizon, from embeddings of both.

    Args:
        features: Features of an embedding E.
        layers: Hidden layers.
        units: Units of each, with ReLU.
        batch_norm: Whether each is normalised over the batch. The statistics are those of the batch while it learns
            (``learning=True``), and their moving mean otherwise, whatever the module's mode: an actor is judged by a
            network that does not depend on what else is judged with it.

    Called with embeddings ``[..., E]`` of here and ``[..., E]`` of there; returns ``[..., 1]`` float32, 0 to about 1.

    Examples:
        >>> distance = TemporalDistance(5, layers=2, units=8, batch_norm=True)
        >>> distance(torch.zeros(3, 4, 5), torch.ones(3, 4, 5)).shape
        torch.Size([3, 4, 1])
    """

    def __init__(self, features: int, *, layers: int = 4, units: int = 400, batch_norm: bool = False) -> None:
        super().__init__()
        widths = [2 * features, *[units] * layers]
        self.linears = nn.ModuleList(nn.Linear(*pair) for pair in pairwise(widths))
        self.norms = nn.ModuleList(_BatchNorm(units) for _ in range(layers if batch_norm else 0))
        self.last = nn.Linear(widths[-1], 1)

    def forward(self, here: Tensor, there: Tensor, *, learning: bool = False) -> Tensor:
        """The distance ``[..., 1]`` from one embedding ``[..., E]`` to another."""
        hidden = torch.cat([here, there], -1).reshape(-1, 2 * here.shape[-1])
        for layer, linear in enumerate(self.linears):
            hidden = linear(hidden)
            if self.norms:
                hidden = self.norms[layer](hidden, learning)
            hidden = hidden.relu()
        return self.last(hidden).float().reshape(*here.shape[:-1], 1)


class TemporalDistanceReward(TensorDictModule):
    """Minus the learnt number of steps to the goal, as a share of a horizon (LEXA).

    Args:
        distance: Called with two embeddings ``[..., E]``; gives ``[..., 1]``.
        embedding_key: Embedding of the state, ``[..., E]``.
        goal_key: Embedding of the goal, ``[..., E]``.
        reward_key: Key written, ``[..., 1]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> reward = TemporalDistanceReward(lambda here, there: (there - here).abs())
        >>> data = TensorDict({"embedding": torch.zeros(1, 1), "latent": {"goal": torch.full((1, 1), 0.5)}}, [1])
        >>> reward(data)["reward"]
        tensor([[-0.5000]])
    """

    def __init__(
        self,
        distance: nn.Module,
        *,
        embedding_key: NestedKey = "embedding",
        goal_key: NestedKey = ("latent", "goal"),
        reward_key: NestedKey = "reward",
    ) -> None:
        super().__init__(_Negative(distance), in_keys=[embedding_key, goal_key], out_keys=[reward_key])


class _Negative(nn.Module):
    def __init__(self, distance: nn.Module) -> None:
        super().__init__()
        self.distance = distance

    def forward(self, here: Tensor, there: Tensor) -> Tensor:
        """Minus the distance, ``[..., 1]``."""
        return -self.distance(here, there)


class _BatchNorm(nn.BatchNorm1d):
    """Batch normalisation that is told when it learns."""

    def forward(self, hidden: Tensor, learning: bool = False) -> Tensor:
        mean, variance = self.running_mean, self.running_var
        assert mean is not None
        assert variance is not None
        if not learning:  # copies: the moving means may move before this is differentiated
            mean, variance = mean.clone(), variance.clone()
        momentum = 0.1 if self.momentum is None else self.momentum
        return batch_norm(hidden, mean, variance, self.weight, self.bias, learning, momentum, self.eps)
