"""Runs that train an agent, and that evaluate it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_ocwm.agents import AGENTS, SIZES
from torchrl_ocwm.evidence.command_line import Command, given, override, written
from torchrl_ocwm.evidence.datasets import Data
from torchrl_ocwm.evidence.options import image_size
from torchrl_ocwm.evidence.run import Run
from torchrl_ocwm.evidence.settings import Machine
from torchrl_ocwm.settings import change
from torchrl_ocwm.training import CHECKPOINT, Training
from torchrl_ocwm.training.provenance import trained_on

#: Episodes of each evaluation during training, to as many of the landmark goals.
LANDMARKS = 5
#: Evaluations during training.
EVALUATIONS = 10


@dataclass(frozen=True, kw_only=True)
class Trained(Run):
    """An agent that has learnt from a dataset.

    Args:
        data: The dataset.
        agent: A row.
        changes: Settings of the row that are otherwise, by dotted names.
        size: Its size.
        seed: Seeds weights and sampling.
        updates: Updates.
        episode_steps: Steps of the episodes that are played meanwhile. They decide nothing.
    """

    kind = "trainings"

    data: Data
    agent: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    size: str
    seed: int
    updates: int
    episode_steps: int = 100

    @property
    def prefix(self) -> str:
        """Environment, row and seed."""
        return f"{self.data.env}-{self.agent}-s{self.seed}"

    @property
    def content(self) -> dict[str, Any]:
        """Agent, size, dataset, and what decides a training."""
        return {
            "agent": change(AGENTS[self.agent], self.changes),
            "size": SIZES[self.size],
            "training": Training(seed=self.seed, updates=self.updates),
            "data": self.data.content,
        }

    @property
    def work(self) -> int:
        """Updates."""
        return self.updates

    @property
    def steps_played(self) -> int:
        """Steps of the episodes that are played meanwhile."""
        return self.updates // self._eval_interval * LANDMARKS * self.episode_steps

    @property
    def _eval_interval(self) -> int:
        return -(-self.updates // EVALUATIONS)

    @property
    def pace(self) -> str:
        """Row, size and image."""
        return f"train {self.agent} {self.size} {image_size(self.data.env, self.data.options)}"

    @property
    def needs(self) -> tuple[Run, ...]:
        """The dataset."""
        return (self.data,)

    def commands(self, root: Path, machine: Machine) -> list[Command]:
        """``ocwm train``."""
        evaluation = {
            "eval_interval": self._eval_interval,
            "eval_episodes": LANDMARKS,
            "eval_steps": self.episode_steps,
            "eval_beside": False,  # other runs have the other cores
        }
        learning = {"seed": self.seed, "updates": self.updates, "video_interval": 0}
        settings = {**learning, **evaluation, "threads": machine.threads, "device": machine.device}
        return [
            (
                "train",
                *(f"agent={self.agent}", f"env={self.data.env}", f"size={self.size}"),
                *given("agent", self.changes),
                *given("training", settings),
                override("dataset", self.data.dataset(root)),
                override("output", root / self.name),
            )
        ]

    def reached(self, root: Path) -> int:
        """Updates that are logged."""
        return last_step(root / self.name)

    def episodes(self, root: Path) -> str:
        """Their digest, from the checkpoint."""
        file = root / self.name / CHECKPOINT
        return trained_on(file) if file.exists() else ""


@dataclass(frozen=True, kw_only=True)
class Evaluated(Run):
    """The scores of an agent on a grid of goals.

    Args:
        trained: The agent. Its seed is that of the episodes too.
        goals: Goals, a square grid.
        episode_steps: Steps of each episode.
        image_goals: Whether goals are given as images too.
        random: Whether random actions are evaluated too.
    """

    kind = "evaluations"

    trained: Trained
    goals: int
    episode_steps: int
    image_goals: bool = False
    random: bool = False

    @property
    def prefix(self) -> str:
        """That of the training."""
        return self.trained.prefix

    @property
    def content(self) -> dict[str, Any]:
        """The agent, and what is asked of it."""
        return {"trained": self.trained.content, **self._settings}

    @property
    def _settings(self) -> dict[str, Any]:
        return {
            "goals": self.goals,
            "episode_steps": self.episode_steps,
            "image_goals": self.image_goals,
            "random": self.random,
            "seed": self.trained.seed,
        }

    @property
    def work(self) -> int:
        """Steps of all episodes."""
        return self.goals * self.episode_steps * (1 + self.image_goals + self.random)

    @property
    def pace(self) -> str:
        """Simulator, row, size and image."""
        data = self.trained.data
        return f"evaluate {data.env} {image_size(data.env, data.options)} {self.trained.agent} {self.trained.size}"

    @property
    def needs(self) -> tuple[Run, ...]:
        """The agent."""
        return (self.trained,)

    def commands(self, root: Path, machine: Machine) -> list[Command]:  # noqa: ARG002
        """``ocwm evaluate``."""
        settings = [f"{name}={written(value)}" for name, value in self._settings.items()]
        checkpoint = override("checkpoint", root / self.trained.name / CHECKPOINT)
        output = override("output", root / self.name)
        return [("evaluate", checkpoint, output, *settings, "workers=0", "envs=10", "video_goals=0")]

    def reached(self, root: Path) -> int:
        """All or nothing: an evaluation begins anew."""
        return self.work if (root / self.name / "results.json").exists() else 0


def last_step(folder: Path) -> int:
    """The last update that a training has logged."""
    from torchrl_ocwm.evaluation.plots import read_scalar

    curve = read_scalar(folder, "loss_value") if (folder / CHECKPOINT).exists() else None
    return 0 if curve is None else int(curve[0][-1])
