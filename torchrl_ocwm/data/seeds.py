"""Seeds of episodes."""

from __future__ import annotations

from hashlib import sha256
from typing import Literal


def episode_seed(purpose: Literal["collect", "train", "evaluate", "imagine"], seed: int, number: int) -> int:
    """The seed of one episode's random numbers, the same whoever plays it and whatever was played before.

    Args:
        purpose: What the episode is for: those of two purposes share no seed.
        seed: Seed of the collection or evaluation.
        number: Which episode of it; the goal's number in an evaluation.

    Returns:
        A seed below 2⁴⁸, for gymnasium and PyTorch.

    Examples:
        >>> episode_seed("collect", 0, 3) == episode_seed("evaluate", 0, 3)
        False
    """
    return int.from_bytes(sha256(f"{purpose} {seed} {number}".encode()).digest()[:6], "big")
