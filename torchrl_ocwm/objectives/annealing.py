"""Weights of losses that change while an agent learns."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class AnnealedWeight(nn.Module):
    """A weight that goes from one value to another, by the same factor at each update, and stays there.

    Each call in training mode is an update. How many there were is saved with the module.

    Args:
        first: Its value at the first update, above 0.
        last: Its value in the end, above 0.
        updates: How many updates it takes on the way.

    Called without arguments; returns a float32 scalar.

    Raises:
        ValueError: for a value that is not above 0, or no update.

    Examples:
        >>> weight = AnnealedWeight(100.0, 1.0, 2)
        >>> [round(weight().item()) for _ in range(4)]
        [100, 10, 1, 1]
    """

    done: Tensor

    def __init__(self, first: float, last: float, updates: int) -> None:
        super().__init__()
        if min(first, last, updates) <= 0:
            raise ValueError(f"a weight moves between values above 0 in updates, got {first} to {last} in {updates}")
        self.first, self.ratio, self.updates = first, last / first, updates
        self.register_buffer("done", torch.zeros(()))

    def forward(self) -> Tensor:
        """The weight of this update."""
        weight = self.first * self.ratio ** (self.done / self.updates).clamp_max(1)
        if self.training:
            self.done.add_(1)
        return weight
