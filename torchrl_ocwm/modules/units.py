"""Positions inside the model: metres ↔ workspace units."""

from __future__ import annotations

import torch
from torch import Tensor, nn


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
        """Positions ``[..., D]`` in metres as workspace units."""
        if metres.shape[-1] != self.dim:
            raise ValueError(f"positions have {self.dim} coordinates here, got shape {tuple(metres.shape)}")
        return (metres.to(self.low.dtype) - (self.low + self.high) / 2) / self.metres_per_unit

    def to_metres(self, units: Tensor) -> Tensor:
        """Positions ``[..., D]`` in metres."""
        return units * self.metres_per_unit + (self.low + self.high) / 2
