"""Positions and proprioception inside the model: the units that make their errors count."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_CONSTANT = 1e-6  # a standard deviation that is rounding


class WorkspaceUnits(nn.Module):
    """Scale positions so that the workspace becomes [−1, 1] on each axis.

    In metres the error of a position vanishes beside that of an image; in workspace units it is of order one. Users
    see metres everywhere, the model sees units.

    Args:
        low: Lower corner of the workspace, metres, one value per axis.
        high: Upper corner, metres.

    Calling it turns ``[..., D]`` metres into units, float32.

    Raises:
        ValueError: unless low < high on every axis; when called, for positions of another dimension.

    Examples:
        >>> units = WorkspaceUnits((-0.2, 0.0), (0.2, 0.4))
        >>> units(torch.tensor([0.1, 0.4]))
        tensor([0.5000, 1.0000])
        >>> units.to_metres(torch.tensor([0.5, 1.0]))
        tensor([0.1000, 0.4000])
    """

    low: Tensor
    high: Tensor

    def __init__(self, low: tuple[float, ...], high: tuple[float, ...]) -> None:
        super().__init__()
        if len(low) != len(high) or not all(a < b for a, b in zip(low, high, strict=True)):
            raise ValueError(f"a workspace needs low < high on every axis, got low={low} and high={high}")
        self.register_buffer("low", torch.tensor(low))
        self.register_buffer("high", torch.tensor(high))

    @property
    def dim(self) -> int:
        """Number of axes D."""
        return self.low.shape[0]

    @property
    def metres_per_unit(self) -> Tensor:
        """``[D]``, half the width of the workspace."""
        return (self.high - self.low) / 2

    def forward(self, metres: Tensor) -> Tensor:
        if metres.shape[-1] != self.dim:
            raise ValueError(f"positions have {self.dim} coordinates here, got shape {tuple(metres.shape)}")
        return (metres - (self.low + self.high) / 2) / self.metres_per_unit

    def to_metres(self, units: Tensor) -> Tensor:
        """Positions ``[..., D]`` in metres."""
        return units * self.metres_per_unit + (self.low + self.high) / 2


class ProprioUnits(nn.Module):
    """Shift and scale proprioception so that each value has mean 0 and standard deviation 1 in the data.

    Metres, radians and radians per second weigh alike then: one centimetre of a hand is as much of its range as a fast
    turn of a joint. Until :meth:`measure` has seen data, values stay as they are.

    Args:
        features: Number of values P.

    Calling it turns ``[..., P]`` into units, float32.

    Examples:
        >>> units = ProprioUnits(2)
        >>> units.measure(torch.tensor([[0.0, 5.0], [2.0, 5.0]]))
        >>> units(torch.tensor([3.0, 5.0]))
        tensor([2., 0.])
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("deviation", torch.ones(features))

    def measure(self, proprio: Tensor) -> None:
        """Take mean and standard deviation from data ``[N, P]``; values that never change keep their scale."""
        deviation, mean = torch.std_mean(proprio.double(), 0, correction=0)
        self.mean.copy_(mean)
        self.deviation.copy_(torch.where(deviation > _CONSTANT, deviation, 1.0))

    def forward(self, proprio: Tensor) -> Tensor:
        return (proprio - self.mean) / self.deviation
