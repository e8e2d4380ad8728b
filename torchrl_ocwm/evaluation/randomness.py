"""Random numbers that belong to episodes, not to the batch in which they are played."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

_DRAWS: dict[Any, Callable[..., Tensor]] = {
    torch.rand: torch.rand,
    torch.rand_like: torch.rand,
    torch.randn: torch.randn,
    torch.randn_like: torch.randn,
}


class EpisodeRandomness(TorchFunctionMode):
    """Within it, what :func:`torch.rand`, ``randn``, ``rand_like`` and ``randn_like`` draw is drawn row by row.

    The world model of a policy that acts draws its states with :func:`torch.rand`, for all episodes of a batch at
    once. With a generator for each episode an episode is played the same in any batch.

    Args:
        seeds: The episodes' seeds, one for each row.

    Raises:
        ValueError: by a draw whose numbers cannot be shared out evenly among the episodes.

    Examples:
        >>> with EpisodeRandomness([5, 6]):
        ...     both = torch.rand(2, 3)
        >>> with EpisodeRandomness([6]):
        ...     bool((torch.rand(1, 3) == both[1:]).all())
        True
    """

    def __init__(self, seeds: Sequence[int]) -> None:
        super().__init__()
        self.generators = [torch.Generator().manual_seed(seed) for seed in seeds]

    def __torch_function__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None) -> Any:
        """Draw episode by episode."""
        kwargs = kwargs or {}
        if func not in _DRAWS or kwargs.get("generator") is not None:
            return func(*args, **kwargs)
        # The shape, dtype and device that were asked for, on meta: no number is drawn.
        like = func(*args, **{**kwargs, "device": "meta"})
        device = kwargs.get("device", args[0].device if args and isinstance(args[0], Tensor) else None)
        episodes = len(self.generators)
        if like.numel() % episodes:
            raise ValueError(f"random numbers {tuple(like.shape)} cannot be shared out among {episodes} episodes")
        each, draw = like.numel() // episodes, _DRAWS[func]
        rows = [draw(each, dtype=like.dtype, generator=generator) for generator in self.generators]
        return torch.cat(rows).reshape(like.shape).to(device)
