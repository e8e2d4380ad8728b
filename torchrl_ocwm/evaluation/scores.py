"""How near an entity came to its goal."""

from __future__ import annotations

import torch
from torch import Tensor

_AT_START = 1e-3  # metres


def score_is_undefined(goal: Tensor) -> Tensor:
    """Whether goals ``[..., D]`` lie within a millimetre of the start, so that there is no way to normalise by.

    Examples:
        >>> score_is_undefined(torch.tensor([[0.0, 0.2], [0.0, 0.0]]))
        tensor([False,  True])
    """
    return torch.linalg.vector_norm(goal, dim=-1) < _AT_START


def normalized_score(position: Tensor, goal: Tensor) -> Tensor:
    """exp(−‖p − p_g‖ / ‖p_g‖): 1 at the goal, 1/e for staying at the start (paper, equation 2 and appendix).

    Args:
        position: ``[..., D]`` metres from the start position.
        goal: ``[..., D]`` metres from the start position. A goal at the start has no score: it is NaN.

    Returns:
        ``[...]`` in (0, 1], or NaN.

    Examples:
        >>> goal = torch.tensor([0.0, 0.2])
        >>> normalized_score(torch.stack([goal, torch.zeros(2)]), goal)
        tensor([1.0000, 0.3679])
    """
    distance = torch.linalg.vector_norm(position - goal, dim=-1)
    score = torch.exp(-distance / torch.linalg.vector_norm(goal, dim=-1))
    return score.masked_fill(score_is_undefined(goal), torch.nan)


def mean_and_error(values: Tensor) -> tuple[float, float | None]:
    """Mean over seeds and its standard error; no error for a single seed.

    Examples:
        >>> mean_and_error(torch.tensor([0.5, 1.0]))
        (0.75, 0.25)
    """
    mean = float(values.double().mean())
    if len(values) < 2:
        return mean, None
    return mean, float(values.double().std() / len(values) ** 0.5)
