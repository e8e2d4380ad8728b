"""The policy's networks."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_ocwm.modules.networks import UNIMIX, Style, make_mlp


class BoundedNormalActor(nn.Module):
    """Mean and standard deviation of a bounded normal policy, as in DreamerV3.

    Args:
        in_features: Features of all inputs together.
        action: Number of actions A.
        layers: Hidden layers.
        units: Units of each.
        min_std: Smallest standard deviation.
        max_std: Largest.
        style: Which layers (:mod:`torchrl_ocwm.modules.networks`).

    Called with latents ``[..., any]``; returns mean ``[..., A]`` in (−1, 1) and standard deviation ``[..., A]``,
    float32.

    Examples:
        >>> mean, std = BoundedNormalActor(6, 2, layers=1, units=8)(torch.zeros(3, 4), torch.zeros(3, 2))
        >>> mean.shape, bool((std >= 0.1).all())
        (torch.Size([3, 2]), True)
    """

    def __init__(
        self,
        in_features: int,
        action: int,
        *,
        layers: int,
        units: int,
        min_std: float = 0.1,
        max_std: float = 1.0,
        style: Style = "dreamer_v3",
    ) -> None:
        super().__init__()
        # A small last layer: the first policy is centred and as wide as it can be.
        self.mlp = make_mlp(style, in_features, 2 * action, layers=layers, units=units, outscale=0.01)
        self.min_std, self.max_std = min_std, max_std

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation ``[..., A]`` of the actions for inputs ``[..., any]``."""
        mean, spread = self.mlp(*inputs).float().chunk(2, -1)
        return mean.tanh(), self.min_std + (self.max_std - self.min_std) * torch.sigmoid(spread + 2)


class CategoricalActor(nn.Module):
    """Probabilities of discrete actions, as in DreamerV3.

    Args:
        in_features: Features of all inputs together.
        action: Number of actions A.
        layers: Hidden layers.
        units: Units of each.
        style: Which layers (:mod:`torchrl_ocwm.modules.networks`).

    Called with latents ``[..., any]``; returns probabilities ``[..., A]`` float32, none of which is zero.

    Examples:
        >>> CategoricalActor(6, 4, layers=1, units=8)(torch.zeros(3, 4), torch.zeros(3, 2)).sum(-1)
        tensor([1., 1., 1.], grad_fn=<SumBackward1>)
    """

    def __init__(self, in_features: int, action: int, *, layers: int, units: int, style: Style = "dreamer_v3") -> None:
        super().__init__()
        self.mlp = make_mlp(style, in_features, action, layers=layers, units=units, outscale=0.01)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Probabilities ``[..., A]`` of the actions for inputs ``[..., any]``."""
        logits = self.mlp(*inputs).float()
        return (1 - UNIMIX) * logits.softmax(-1) + UNIMIX / logits.shape[-1]
