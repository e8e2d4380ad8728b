"""Exploration by disagreement: several networks predict what comes next, and differ where they have seen little."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import elu, rms_norm, silu

from torchrl_ocwm.modules.architecture import Style
from torchrl_ocwm.modules.recurrence import bounded
from torchrl_ocwm.settings import read


class StackedLinear(nn.Module):
    """Linear layers of several networks, in one batched product.

    Args:
        members: Number of networks M.
        in_features: Features of the input.
        out_features: Features of the output.

    Called with ``[M, N, in]`` or ``[1, N, in]``, the same for all; returns ``[M, N, out]``. Each starts with weights of
    its own, drawn as those of :class:`torch.nn.Linear`.
    """

    def __init__(self, members: int, in_features: int, out_features: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(members, in_features, out_features))
        self.bias = nn.Parameter(torch.empty(members, 1, out_features))
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -1 / math.sqrt(in_features), 1 / math.sqrt(in_features))

    def forward(self, inputs: Tensor) -> Tensor:
        """Inputs ``[M, N, in]`` or ``[1, N, in]`` through the layer of each member, ``[M, N, out]``."""
        return torch.baddbmm(self.bias, inputs.expand(len(self.weight), -1, -1), self.weight)


class OneStepEnsemble(nn.Module):
    """Several networks that predict what follows a latent state and an action (Plan2Explore).

    Args:
        in_features: Features of state, belief and action together.
        out_features: Features of what is predicted.
        members: Number of networks M.
        layers: Hidden layers of each.
        units: Units of each layer.
        style: Which layers (:mod:`torchrl_ocwm.modules.networks`).

    Called with state ``[..., S]``, belief ``[..., H]`` and action ``[..., A]``; returns ``[M, ..., out]``. Actions
    beyond [−1, 1] count as clipped, as they do in the world model.

    Raises:
        ValueError: for less than two members.

    Examples:
        >>> ensemble = OneStepEnsemble(7, 3, members=5, layers=1, units=8)
        >>> ensemble(torch.zeros(4, 2), torch.zeros(4, 3), torch.zeros(4, 2)).shape
        torch.Size([5, 4, 3])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        members: int,
        layers: int,
        units: int,
        style: Style = "dreamer_v3",
    ) -> None:
        super().__init__()
        read(Style, style, "style")
        if members < 2:
            raise ValueError(f"members must be at least 2 to disagree, got {members}")
        sizes = [in_features, *([units] * layers), out_features]
        self.style = style
        self.layers = nn.ModuleList(StackedLinear(members, *pair) for pair in pairwise(sizes))

    def forward(self, state: Tensor, belief: Tensor, action: Tensor) -> Tensor:
        """The predictions of all members, ``[M, ..., out]``."""
        inputs = torch.cat([state, belief, bounded(action)], -1)
        hidden = inputs.reshape(1, -1, inputs.shape[-1])
        *first, last = self.layers
        for layer in first:
            hidden = self._activate(layer(hidden))
        predictions = last(hidden)
        return predictions.reshape(len(predictions), *inputs.shape[:-1], -1)

    def _activate(self, hidden: Tensor) -> Tensor:
        return silu(rms_norm(hidden, hidden.shape[-1:])) if self.style == "dreamer_v3" else elu(hidden)


def disagreement(predictions: Tensor, *, log: bool = False, epsilon: float = 1e-6) -> Tensor:
    """How far predictions lie apart: their variance, averaged over features.

    Args:
        predictions: ``[M, ..., E]``, one of each member.
        log: The logarithm of the mean standard deviation instead.
        epsilon: Smallest standard deviation that the logarithm is taken of.

    Returns:
        ``[..., 1]``.

    Examples:
        >>> disagreement(torch.tensor([[0.0, 1.0], [2.0, 3.0]]))
        tensor([2.])
    """
    # On a CPU, Tensor.var over the first dimension takes fifteen times as long. The mean needs no gradient: deviations
    # add up to nothing.
    predictions = predictions.float()
    deviations = predictions - predictions.detach().mean(0)
    others = len(predictions) - 1
    if log:
        variance = deviations.square().sum(0) / others
        return variance.clamp_min(epsilon**2).sqrt().mean(-1, keepdim=True).log()
    square = torch.linalg.vector_norm(deviations, dim=(0, -1)).square()  # in one pass
    return square.unsqueeze(-1) / (others * predictions.shape[-1])


class Disagreement(nn.Module):
    """:func:`disagreement` of an ensemble about what it is called with.

    Args:
        ensemble: The ensemble.
        log: The logarithm of the standard deviation instead of the variance.
    """

    def __init__(self, ensemble: OneStepEnsemble, *, log: bool = False) -> None:
        super().__init__()
        self.ensemble, self.log = ensemble, log

    def forward(self, state: Tensor, belief: Tensor, action: Tensor) -> Tensor:
        """The disagreement of the members, ``[..., 1]``."""
        return disagreement(self.ensemble(state, belief, action), log=self.log)


class DisagreementReward(TensorDictModule):
    """How little an ensemble agrees on what an imagined action leads to (Plan2Explore).

    It judges the latent and the action of the step before, which
    :class:`~torchrl_ocwm.modules.ImaginationEnv` keeps under ``before`` and ``action``.

    Args:
        ensemble: The ensemble.
        log: The logarithm of the standard deviation instead of the variance.
        state_key: State of the step before, ``[..., S]``.
        belief_key: Its belief, ``[..., H]``.
        action_key: Its action, ``[..., A]``.
        reward_key: Key written, ``[..., 1]``.

    Examples:
        >>> from tensordict import TensorDict
        >>> ensemble = OneStepEnsemble(7, 3, members=5, layers=1, units=8)
        >>> before = {"state": torch.zeros(4, 2), "belief": torch.zeros(4, 3)}
        >>> step = TensorDict({"before": before, "action": torch.zeros(4, 2)}, [4])
        >>> DisagreementReward(ensemble)(step)["reward"].shape
        torch.Size([4, 1])
    """

    def __init__(
        self,
        ensemble: OneStepEnsemble,
        *,
        log: bool = False,
        state_key: NestedKey = ("before", "state"),
        belief_key: NestedKey = ("before", "belief"),
        action_key: NestedKey = "action",
        reward_key: NestedKey = "reward",
    ) -> None:
        super().__init__(
            Disagreement(ensemble, log=log), in_keys=[state_key, belief_key, action_key], out_keys=[reward_key]
        )
