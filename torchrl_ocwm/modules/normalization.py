"""Rewards on one scale, and latents around zero, whatever they were."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from torchrl_ocwm.settings import read

Normalization = Literal["none", "scale", "standard"]


class _Moving(nn.Module):
    """Counts calls, and says how much the newest counts: as much as each before it, and ``rate`` at least."""

    calls: Tensor

    def __init__(self, rate: float) -> None:
        super().__init__()
        self.rate = rate
        self.register_buffer("calls", torch.zeros(()))

    def _count(self) -> Tensor:
        """Count a call; its share, a scalar."""
        self.calls.add_(1)
        return (1 / self.calls).clamp_min(self.rate)


class StreamingNorm(_Moving):
    """Normalise by moments that move along with what is seen.

    Each call in training mode first takes its values into the moments: the mean of all calls so far, until these are
    ``1 / rate``, and from then on an exponential moving average. In evaluation mode they stay as they are. They are
    saved with the module. Values that nothing was seen of yet stay as they are. Gradients go through the values, not
    through the moments.

    Args:
        mode: ``"standard"`` subtracts the mean and divides by the standard deviation; ``"scale"`` divides by the root
            mean square, so that signs stay; ``"none"`` changes nothing.
        rate: Share of the newest values in the moments.
        epsilon: Smallest divisor.

    Called with values ``[...]``; returns the same shape.

    Raises:
        ValueError: for another mode.

    Examples:
        >>> norm = StreamingNorm("standard")
        >>> norm(torch.tensor([1.0, 3.0])), norm.eval()(torch.tensor([4.0]))
        (tensor([-1.,  1.]), tensor([2.]))
    """

    mean: Tensor
    square: Tensor

    def __init__(self, mode: Normalization = "standard", *, rate: float = 0.01, epsilon: float = 1e-6) -> None:
        super().__init__(rate)
        read(Normalization, mode, "mode")
        self.mode, self.epsilon = mode, epsilon
        self.register_buffer("mean", torch.zeros(()))
        self.register_buffer("square", torch.ones(()))

    @torch.no_grad()
    def update(self, values: Tensor) -> None:
        """Take values ``[...]`` into the moments."""
        weight = self._count()
        self.mean.lerp_(values.float().mean(), weight)
        self.square.lerp_(values.float().square().mean(), weight)

    def forward(self, values: Tensor) -> Tensor:
        """Values of any shape, normalised; in training mode they are counted first."""
        if self.training:
            self.update(values)
        if self.mode == "scale":
            return values / self.square.sqrt().clamp_min(self.epsilon)
        if self.mode == "standard":
            spread = (self.square - self.mean.square()).clamp_min(self.epsilon**2).sqrt()
            return (values - self.mean) / spread
        return values


class MovingCentre(_Moving):
    """Subtract the mean vector of what was seen.

    Each call in training mode first takes its vectors into the mean: that of all calls so far, until these are
    ``1 / rate``, and from then on an exponential moving average. In evaluation mode it stays as it is. It is saved with
    the module. Gradients go through the vectors, not through the mean.

    Args:
        features: Length L of a vector.
        rate: Share of the newest vectors in the mean.

    Attributes:
        mean: ``[L]`` float32.

    Called with vectors ``[..., L]``; returns the same shape.

    Examples:
        >>> centre = MovingCentre(2)
        >>> centre(torch.tensor([[1.0, 0.0], [3.0, 2.0]])), centre.eval()(torch.tensor([4.0, 1.0]))
        (tensor([[-1., -1.],
                [ 1.,  1.]]), tensor([2., 0.]))
    """

    mean: Tensor

    def __init__(self, features: int, *, rate: float = 0.01) -> None:
        super().__init__(rate)
        self.register_buffer("mean", torch.zeros(features))

    @torch.no_grad()
    def update(self, vectors: Tensor) -> None:
        """Take vectors ``[..., L]`` into the mean."""
        self.mean.lerp_(vectors.float().reshape(-1, vectors.shape[-1]).mean(0), self._count())

    def forward(self, vectors: Tensor) -> Tensor:
        """Vectors ``[..., L]`` without the mean; in training mode they are counted first."""
        if self.training:
            self.update(vectors)
        return vectors - self.mean
