"""Which evidence is wanted, and how much of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torchrl_ocwm.agents import SIZES
from torchrl_ocwm.envs import find_environment
from torchrl_ocwm.settings import Settings, SettingsError, setting


@dataclass(frozen=True, kw_only=True)
class Evidence(Settings):
    """Settings of a figure's runs.

    Args:
        figure: Which of the paper's tables and figures.
        env: Environment, or list of them.
        agents: Only these rows, or all rows of these agents; none: all rows.
        size: Size of the agents. It also says how many steps, updates and goals there are.
        seeds: Runs of each row, with the seeds 0, 1, 2 and so on.
        steps: Environment steps of each dataset; ``None``: as many as go with the size.
        updates: Updates of each run; ``None``: as many as go with size and environment.
        goals: Goals of each evaluation, a square grid; ``None``: as many as go with the size.

    Raises:
        SettingsError: for a setting out of its range, with its name.
    """

    figure: Literal[
        "table",
        "limits",
        "target_size",
        "loss_scale",
        "visual_goals",
        "fairness",
        "goal_latents",
        "curves",
        "exploration",
    ]
    env: str | tuple[str, ...] = "reacher"
    agents: tuple[str, ...] = ()
    size: str = "cpu"
    seeds: int = setting(3, at_least=1, at_most=1000)
    steps: int | None = setting(None, at_least=1)
    updates: int | None = setting(None, at_least=1, at_most=10**9)
    goals: int | None = setting(None, at_least=1, at_most=10**6)

    def validate(self) -> None:
        """Sizes and environments are known."""
        if self.size not in SIZES:
            raise SettingsError(f"size must be one of {', '.join(SIZES)}, got {self.size!r}")
        if not self.environments:
            raise SettingsError("env must name an environment or several, got none")
        for name in self.environments:
            find_environment(name)

    @property
    def environments(self) -> tuple[str, ...]:
        """The environments, each once."""
        return tuple(dict.fromkeys((self.env,) if isinstance(self.env, str) else self.env))


@dataclass(frozen=True, kw_only=True)
class Machine(Settings):
    """Where runs go, and how many at a time. It does not decide what they find.

    Args:
        launcher: ``"local"`` for processes of this machine, ``"ray"`` for tasks of a Ray cluster, whose machines see
            the same folders.
        workers: Runs at a time; ``None``: as many as there are cores for, or as many as there are GPUs.
        threads: Threads of PyTorch in each run.
        device: Where agents are trained: ``cpu``, ``cuda``.
    """

    launcher: Literal["local", "ray"] = "local"
    workers: int | None = setting(None, at_least=1, at_most=1024)
    threads: int = setting(1, at_least=1, at_most=1024)
    device: str = "cpu"
