"""How agents are evaluated and examined."""

from __future__ import annotations

from dataclasses import dataclass
from math import isqrt

from torchrl_ocwm.settings import Settings, SettingsError, setting


@dataclass(frozen=True)
class Evaluation(Settings):
    """Settings of an evaluation on a grid of goals.

    Args:
        behaviour: Which of an agent's behaviours acts; ``None``: that which acts unless another is asked for.
        goals: Goals, laid out as a square grid over the reachable workspace. In three dimensions they look like such a
            grid from every side.
        episode_steps: Steps per episode.
        image_goals: Also give the goals as images, what would be seen with the object there, to the agents that take
            both. Those that take nothing else get them anyway.
        random: Also evaluate smooth random actions.
        workers: Processes; 0 steps all environments in the process that evaluates. Scores do not depend on it.
        envs: Environments stepped in each process. Scores do not depend on it.
        video_goals: Goals that the video shows, all if they are fewer; 0 for no video.
        seed: Seeds the episodes: start states, what the world model draws, and random actions.
        timeout: Seconds without a step after which a process counts as hanging, and the evaluation ends.

    Raises:
        SettingsError: for a setting out of its range, with its name.

    Examples:
        >>> Evaluation(goals=9, video_goals=3).grid_size
        3
    """

    behaviour: str | None = None
    goals: int = setting(100, at_least=1, at_most=10**6)
    episode_steps: int = setting(150, at_least=1)
    image_goals: bool = False
    random: bool = True
    workers: int = setting(2, at_least=0, at_most=1024)
    envs: int = setting(10, at_least=1, at_most=10**4)
    video_goals: int = setting(6, at_least=0)
    seed: int = setting(0, at_least=0, at_most=2**32 - 1)
    timeout: float = setting(120.0, above=0, at_most=10**6)

    def validate(self) -> None:
        """A square grid."""
        if self.grid_size**2 != self.goals:
            near = [size**2 for size in (self.grid_size, self.grid_size + 1)]
            raise SettingsError(f"goals={self.goals} is not a square grid; try {near[0]} or {near[1]}")

    @property
    def grid_size(self) -> int:
        """Goals on each side of the grid."""
        return isqrt(self.goals)


@dataclass(frozen=True)
class Diagnosis(Settings):
    """Settings of an examination of a world model on a dataset.

    Args:
        behaviour: Whose goal latents are compared, those of its object; ``None``: of the behaviour that acts.
        sequences: Sequences from random places in episodes that are spread over the dataset.
        length: Frames of each.
        context: Frames that the world model sees before it imagines the rest from the actions alone.
        frames: Frames for the comparison of goal latents: each has to be found again among all of them.
        video_sequences: Sequences that the video of the objects shows, all if they are fewer; 0 for no
            pictures of them.
        seed: Seeds the choice of sequences and frames, and the sampled latents.
        device: Where to compute: ``cpu``, ``cuda``, ``cuda:1``.

    Raises:
        SettingsError: for a setting out of its range, with its name.

    Examples:
        >>> Diagnosis(sequences=10).length
        50
    """

    behaviour: str | None = None
    sequences: int = setting(100, at_least=1)
    length: int = setting(50, at_least=1)
    context: int = setting(5, at_least=1)
    frames: int = setting(100, at_least=2)
    video_sequences: int = setting(6, at_least=0)
    seed: int = setting(0, at_least=0, at_most=2**32 - 1)
    device: str = "cpu"

    def validate(self) -> None:
        """Some frames are seen and some imagined."""
        if self.context >= self.length:
            raise SettingsError(
                f"context={self.context} of length={self.length} frames: some have to be seen and some to be imagined"
            )
