"""Where an entity can be sent: bounds, uniform goals, evaluation grids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchrl_ocwm.settings import Settings, SettingsError

_GOLDEN = (5**0.5 - 1) / 2


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
        if self.reach is not None and len(self.low) != 2:
            raise SettingsError(f"reach is the ring of a planar arm: it needs two axes, low has {len(self.low)}")
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
        """``[size, size, dim]`` goals that cover what can be reached, at the centres of equal cells (metres).

        Two axes have a square grid. With three, each cell of it has a height, so that the goals are a whole square grid
        seen along any axis (a Latin square), and scattered in between. One axis has a line of ``size * size`` goals.
        """
        cells = size**2 if self.dim == 1 else size
        return self._lay_out(2 * (self.grid_cells(size) + 0.5) / cells - 1)

    def grid_cells(self, size: int) -> Tensor:
        """``[size, size, dim]`` which cell each goal of :meth:`grid` lies in, counted from 0 on each axis."""
        if self.dim == 1:
            return torch.arange(size**2).reshape(size, size, 1)
        row, column = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
        scattered = (torch.arange(size, dtype=torch.float64) * _GOLDEN % 1).argsort()
        others = (scattered[(column + axis * scattered[row]) % size] for axis in range(1, self.dim - 1))
        return torch.stack([column, row, *others], -1)

    def grid_edges(self, size: int, axes: tuple[int, int] = (0, 1)) -> Tensor:
        """``[size + 1, size + 1, 2]`` corners of the cells of :meth:`grid`, seen along all but two axes (metres)."""
        corner = 2 * torch.arange(size + 1) / size - 1
        low, high = (tuple(end[axis] for axis in axes) for end in (self.low, self.high))
        return Workspace(low, high, self.reach)._lay_out(torch.stack(torch.meshgrid(corner, corner, indexing="xy"), -1))

    def _lay_out(self, square: Tensor) -> Tensor:
        """Places ``[..., dim]`` in the box or on the ring, for places in ``[-1, 1]``."""
        if self.reach is not None:
            return _square_to_ring(square, *self.reach)
        low, high = torch.tensor(self.low), torch.tensor(self.high)
        return low + (high - low) * (square + 1) / 2


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
