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


def interquartile_mean(values: Tensor) -> Tensor:
    """Mean of the middle half of values ``[..., K]``: neither the worst quarter nor the best counts.

    Returns:
        ``[...]``.

    Examples:
        >>> interquartile_mean(torch.tensor([0.0, 1.0, 2.0, 100.0]))
        tensor(1.5000)
    """
    cut = values.shape[-1] // 4
    return values.sort(-1).values[..., cut : values.shape[-1] - cut].mean(-1)


def bootstrap_interval(
    values: Tensor, *, share: float = 0.95, resamples: int = 2000, seed: int = 0
) -> tuple[float, float] | None:
    """Interval of the interquartile mean over seeds and goals, by a stratified bootstrap.

    In each resample, every goal draws as many of its own values as there are seeds, with replacement (Agarwal et al.,
    2021, with goals as tasks). So it does not say how a seed that is worse on all goals changes the mean.

    Args:
        values: ``[S, N]``, a value for each seed and goal.
        share: Share of the resamples that lie in it.
        resamples: How many there are.
        seed: Seeds them.

    Returns:
        Its ends; ``None`` for a single seed, which says nothing of others.

    Examples:
        >>> bootstrap_interval(torch.tensor([[0.5, 0.5], [0.5, 0.5]]))
        (0.5, 0.5)
    """
    seeds, goals = values.shape
    if seeds < 2:
        return None
    generator = torch.Generator().manual_seed(seed)
    means = torch.cat(
        [
            interquartile_mean(values.double().gather(0, drawn).flatten()).reshape(1)
            for drawn in torch.randint(seeds, (resamples, seeds, goals), generator=generator)
        ]
    )
    low, high = means.quantile(torch.tensor([(1 - share) / 2, (1 + share) / 2], dtype=torch.float64)).tolist()
    return low, high
