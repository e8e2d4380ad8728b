"""What a dataset shows of its objects: how often they move, and where they have been."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_ocwm.data.dataset import EpisodeDataset
from torchrl_ocwm.envs.workspace import Workspace

_MOVED = 1e-3  # metres in a step
_CHUNK = 10_000


class Coverage(NamedTuple):
    """Of one object: the share of steps in which it moves, and of the workspace's cells that it visits."""

    moves: float
    visited: float


def object_coverage(
    positions: Tensor, episode_lengths: list[int], workspace: Workspace, *, cells: int = 10
) -> Coverage:
    """How often an object moves and how much of the workspace it visits: nobody learns to move what never moves.

    Args:
        positions: ``[N, D]`` metres, of all frames of some episodes, one episode behind the other.
        episode_lengths: Frames of each episode.
        workspace: Where goals are.
        cells: Cells per side of the grid that goals are evaluated on (:meth:`~torchrl_ocwm.envs.Workspace.grid`).

    Returns:
        The share of steps that move the object by more than a millimetre, and the share of the cells whose middle is
        the nearest to it at least once, while it is in the workspace.

    Examples:
        >>> square = Workspace(low=(-1.0, -1.0), high=(1.0, 1.0))
        >>> object_coverage(torch.tensor([[-0.5, -0.5], [0.5, -0.5], [0.5, -0.5]]), [3], square, cells=2)
        Coverage(moves=0.5, visited=0.5)
    """
    distance = (positions[1:] - positions[:-1]).norm(dim=-1)
    within = torch.ones(len(distance), dtype=torch.bool)
    within[torch.tensor(episode_lengths).cumsum(0)[:-1] - 1] = False
    centres = workspace.grid(cells).flatten(0, 1)
    inside = positions[workspace.contains(positions)]
    nearest = [torch.cdist(part, centres).argmin(-1) for part in inside.split(_CHUNK)]
    visited = len(torch.cat(nearest).unique()) if nearest else 0
    return Coverage((distance[within] > _MOVED).float().mean().item(), visited / len(centres))


def coverage_curve(
    positions: Tensor, episode_lengths: list[int], workspace: Workspace, *, points: int = 20, cells: int = 10
) -> dict[int, Coverage]:
    """Coverage of the first episodes of a dataset, of more and more of them.

    Args:
        positions: As for :func:`object_coverage`.
        episode_lengths: Frames of each episode.
        workspace: Where goals are.
        points: How many, evenly spread over the episodes.
        cells: As for :func:`object_coverage`.

    Returns:
        Environment steps so far → coverage so far.

    Examples:
        >>> square = Workspace(low=(-1.0, -1.0), high=(1.0, 1.0))
        >>> path = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [0.5, -0.5], [0.5, 0.5]])
        >>> coverage_curve(path, [2, 2], square, points=2, cells=2)
        {1: Coverage(moves=1.0, visited=0.5), 2: Coverage(moves=1.0, visited=0.75)}
    """
    ends = torch.tensor(episode_lengths).cumsum(0).tolist()
    counts = sorted({max(len(ends) * point // points, 1) for point in range(1, points + 1)})
    return {
        ends[count - 1] - count: object_coverage(
            positions[: ends[count - 1]], episode_lengths[:count], workspace, cells=cells
        )
        for count in counts
    }


def object_positions(dataset: EpisodeDataset) -> Tensor:
    """Positions ``[N, O, D]`` metres of a dataset: the simulator's, or estimates where there are none."""
    keys = dataset.records["next"].keys()
    return dataset.records["next", "object_position_true" if "object_position_true" in keys else "object_position"]


def dataset_coverage(dataset: EpisodeDataset, objects: tuple[str, ...], workspace: Workspace) -> dict[str, Coverage]:
    """Coverage of each object of a dataset, from :func:`object_positions`."""
    positions = object_positions(dataset)
    return {
        name: object_coverage(positions[:, number].clone(), dataset.episode_lengths, workspace)
        for number, name in enumerate(objects)
    }
