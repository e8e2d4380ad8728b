"""How agents are evaluated and examined."""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt

from torchrl_ocwm.data.settings import check_above_zero, check_at_least


@dataclass(frozen=True)
class Evaluation:
    """Settings of an evaluation on a grid of goals.

    Args:
        goals: Goals, laid out as a square grid over the reachable workspace.
        episode_steps: Steps per episode.
        image_goals: Also give the goals as images, what would be seen with the object there, to the agents that take
            them.
        random: Also evaluate smooth random actions.
        workers: Processes; 0 steps all environments in the process that evaluates. Scores do not depend on it.
        envs: Environments stepped in each process. Scores do not depend on it.
        video_goals: Goals that the video shows, all if they are fewer; 0 for no video.
        seed: Seeds the episodes: start states, what the world model draws, and random actions.
        timeout: Seconds without a step after which a process counts as hanging, and the evaluation ends.

    Raises:
        ValueError: for a setting out of its range, with its name.

    Examples:
        >>> Evaluation(goals=9, video_goals=3).grid_size
        3
    """

    goals: int = 100
    episode_steps: int = 150
    image_goals: bool = False
    random: bool = True
    workers: int = 2
    envs: int = 10
    video_goals: int = 6
    seed: int = 0
    timeout: float = 120.0

    def __post_init__(self) -> None:
        check_at_least(self, 1, "goals", "episode_steps", "envs")
        check_at_least(self, 0, "workers", "video_goals", "seed")
        check_above_zero(self, "timeout")
        if self.grid_size**2 != self.goals:
            near = [size**2 for size in (self.grid_size, self.grid_size + 1)]
            raise ValueError(f"goals={self.goals} is not a square grid; try {near[0]} or {near[1]}")

    @property
    def grid_size(self) -> int:
        """Goals on each side of the grid."""
        return isqrt(self.goals)


@dataclass(frozen=True)
class Diagnosis:
    """Settings of an examination of a world model on a dataset.

    Args:
        sequences: Sequences from random places in episodes that are spread over the dataset.
        length: Frames of each.
        context: Frames that the world model sees before it imagines the rest from the actions alone.
        frames: Frames for the comparison of goal latents: each has to be found again among all of them.
        video_sequences: Sequences that the video of the objects shows, all if they are fewer; 0 for no
            pictures of them.
        seed: Seeds the choice of sequences and frames, and the sampled latents.
        device: Where to compute: ``cpu``, ``cuda``, ``cuda:1``.

    Raises:
        ValueError: for a setting out of its range, with its name.

    Examples:
        >>> Diagnosis(sequences=10).length
        50
    """

    sequences: int = 100
    length: int = 50
    context: int = 5
    frames: int = 100
    video_sequences: int = 6
    seed: int = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        check_at_least(self, 1, "sequences", "length", "context")
        check_at_least(self, 2, "frames")
        check_at_least(self, 0, "video_sequences", "seed")
        if self.context >= self.length:
            raise ValueError(
                f"context={self.context} of length={self.length} frames: some have to be seen and some to be imagined"
            )
