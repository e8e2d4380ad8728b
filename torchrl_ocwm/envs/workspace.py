"""Where an entity can be sent: bounds, uniform goals, evaluation grids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchrl_ocwm.settings import Settings, SettingsError


@dataclass(frozen=True)
class Workspace(Settings):
    """The box of goal positions of a task, in metres from the start position.

    Goals are drawn uniformly in the box. What the robot can reach inside it may be smaller: for a planar arm it is
    the ring between ``reach[0]`` and ``reach[1]`` around the origin, and evaluation goals are laid out there.

    Args:
        low: Lower corner, one value per axis, metres.
        high: Upper corner, metres.
        reach: Smallest and largest distance from the origin that can be reached, metres. ``None``: the whole box.
        landmarks: Hand-picked goals for quick evaluations, metres (the paper draws its training curves with ten).

    Raises:
        SettingsError: if ``low`` is not below ``high`` on every axis, or the points do not fit them.

    Examples:
        >>> workspace = Workspace(low=(-0.24, -0.24), high=(0.24, 0.24), reach=(0.04, 0.24))
        >>> workspace.grid(10).shape
        torch.Size([10, 10, 2])
        >>> bool(workspace.contains(torch.tensor([0.3, 0.0])))
        False
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    reach: tuple[float, float] | None = None
    landmarks: tuple[tuple[float, ...], ...] = ()

    def validate(self) -> None:
        """Lower corners are lower, and all points have as many coordinates."""
        if not 0 < len(self.low) == len(self.high) or not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise SettingsError(f"low must be below high on every axis, got {self.low} and {self.high}")
        if self.reach is not None and not 0 <= self.reach[0] < self.reach[1]:
            raise SettingsError(f"reach must be a smaller and a larger distance, got {self.reach}")
        if odd := [point for point in self.landmarks if len(point) != len(self.low)]:
            raise SettingsError(f"landmarks must have {len(self.low)} coordinates, got {odd[0]}")

    @property
    def dim(self) -> int:
        """Number of coordinates of a goal."""
        return len(self.low)

    def contains(self, position: Tensor | np.ndarray, tolerance: float = 1e-6) -> Tensor:
        """Whether positions ``[..., dim]`` (metres) lie in the box; a bool tensor ``[...]``."""
        position = torch.as_tensor(position)
        low, high = position.new_tensor(self.low), position.new_tensor(self.high)
        return ((position >= low - tolerance) & (position <= high + tolerance)).all(-1)

    def check(self, goal: Tensor | np.ndarray | tuple[float, ...]) -> Tensor:
        """Return ``goal`` as a float32 tensor ``[..., dim]``, or say what is wrong with it.

        Raises:
            ValueError: if the goal has another dimension, is not finite, or lies outside the box.
        """
        goal = torch.as_tensor(np.asarray(goal), dtype=torch.float32)
        if goal.ndim == 0 or goal.shape[-1] != self.dim:
            raise ValueError(f"a goal position of this task has {self.dim} coordinates, got shape {tuple(goal.shape)}")
        if not goal.isfinite().all():
            raise ValueError(f"a goal position must be finite, got {goal.tolist()}")
        if not self.contains(goal).all():
            raise ValueError(
                f"goal position {goal.tolist()} lies outside the workspace, low {self.low} to high {self.high} (metres)"
            )
        return goal

    def sample(self, shape: tuple[int, ...] = (), generator: torch.Generator | None = None) -> Tensor:
        """Goals drawn uniformly in the box, ``[*shape, dim]`` in metres."""
        low, high = torch.tensor(self.low), torch.tensor(self.high)
        return low + (high - low) * torch.rand(*shape, self.dim, generator=generator)

    def grid(self, size: int) -> Tensor:
        """``[size, size, dim]`` goals that cover what can be reached, as equal cells, at the cell centres (metres)."""
        return self._lay_out((torch.arange(size) + 0.5) / size)

    def grid_edges(self, size: int) -> Tensor:
        """``[size + 1, size + 1, dim]`` corners of the cells of :meth:`grid`, to draw heatmaps."""
        return self._lay_out(torch.arange(size + 1) / size)

    def _lay_out(self, fraction: Tensor) -> Tensor:
        square = torch.stack(torch.meshgrid(2 * fraction - 1, 2 * fraction - 1, indexing="xy"), -1)
        if self.reach is not None:
            return _square_to_ring(square, *self.reach)
        low, high = torch.tensor(self.low), torch.tensor(self.high)
        # The first and the last axis span the grid; an axis between them (a depth) stays in the middle.
        position = ((low + high) / 2).repeat(*square.shape[:-1], 1)
        axes = [0, self.dim - 1]
        position[..., axes] = low[axes] + (high - low)[axes] * (square + 1) / 2
        return position


def _square_to_ring(square: Tensor, inner: float, outer: float) -> Tensor:
    """Map ``[-1, 1]^2`` onto a ring so that equal areas stay equal (Shirley and Chiu's concentric map, stretched)."""
    x, y = square.unbind(-1)
    wide = x.abs() > y.abs()
    radius = torch.where(wide, x, y)
    ratio = torch.where(wide, y, x) / torch.where(radius == 0, torch.ones_like(radius), radius)
    angle = torch.where(wide, ratio * torch.pi / 4, torch.pi / 2 - ratio * torch.pi / 4)
    direction = torch.stack([angle.cos(), angle.sin()], -1) * torch.where(radius < 0, -1.0, 1.0).unsqueeze(-1)
    stretched = (inner**2 + radius.square() * (outer**2 - inner**2)).sqrt()
    return direction * stretched.unsqueeze(-1)
