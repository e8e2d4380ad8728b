"""Runs that make a dataset: of policies, of an agent that learns meanwhile, of another one with targets drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_ocwm.agents import AGENTS, SIZES
from torchrl_ocwm.data import DatasetError, EpisodeDataset, dataset_coverage
from torchrl_ocwm.evidence.command_line import Command, given, override
from torchrl_ocwm.evidence.options import all_options, image_size
from torchrl_ocwm.evidence.run import Run
from torchrl_ocwm.evidence.settings import Machine
from torchrl_ocwm.training import Online
from torchrl_ocwm.training.provenance import digest

#: Seeds an explorer's dataset, and how much it learns while it explores.
SEED_STEPS, UPDATE_RATIO = 0.1, 0.1


@dataclass(frozen=True, kw_only=True)
class Data(Run):
    """A dataset.

    Args:
        env: Where it is from.
        options: Of the environment, beside its defaults.
        seed: Seeds all of it.
    """

    kind = "datasets"

    env: str
    options: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0

    def dataset(self, root: Path) -> Path:
        """Where the dataset is."""
        return root / self.name / "data"

    def reached(self, root: Path) -> int:
        """Steps collected."""
        return steps_in(self.dataset(root))

    def episodes(self, root: Path) -> str:
        """Their digest."""
        try:
            with EpisodeDataset.open(self.dataset(root)) as dataset:
                return digest(dataset)
        except DatasetError:
            return ""

    def coverage(self, root: Path) -> dict[str, dict[str, float]]:
        """How often each object moves, and how much of the workspace it visits."""
        try:
            with EpisodeDataset.open(self.dataset(root)) as dataset:
                seen = dataset_coverage(dataset, dataset.task.objects, dataset.task.workspace)
        except DatasetError:
            return {}
        return {name: one._asdict() for name, one in seen.items()}


@dataclass(frozen=True, kw_only=True)
class Collected(Data):
    """A dataset of policies that do not learn.

    Args:
        policies: Who collects, one after the other, and how many steps.
    """

    policies: Mapping[str, int]

    @property
    def prefix(self) -> str:
        """Environment and policies."""
        return "-".join([self.env, *self.policies])

    @property
    def content(self) -> dict[str, Any]:
        """All of it."""
        return {
            "env": self.env,
            "options": all_options(self.env, self.options),
            "policies": list(self.policies.items()),
            "seed": self.seed,
        }

    @property
    def work(self) -> int:
        """Steps."""
        return sum(self.policies.values())

    @property
    def pace(self) -> str:
        """Simulator and image."""
        return f"collect {self.env} {image_size(self.env, self.options)}"

    def commands(self, root: Path, machine: Machine) -> list[Command]:  # noqa: ARG002
        """``ocwm collect``, once for each policy."""
        shared = [f"env={self.env}", *given("env.options", self.options), f"seed={self.seed}", "workers=0"]
        path, done, commands = override("dataset", self.dataset(root)), 0, []
        for policy, steps in self.policies.items():
            done += steps
            commands.append(("collect", *shared, f"policy={policy}", f"steps={done}", path))
        return commands


@dataclass(frozen=True, kw_only=True)
class Explored(Data):
    """A dataset of an agent, which learns from what it has collected.

    Args:
        explorer: The agent, a row.
        size: Its size.
        steps: Environment steps.
        policies: Who collects the first steps, and how many; none: a tenth of them are random.
        update_ratios: Updates per step, of the first steps and of its own.
        round_episodes: Episodes of a round.
    """

    explorer: str
    size: str
    steps: int
    policies: Mapping[str, int] = field(default_factory=dict)
    update_ratios: tuple[float, float] = (UPDATE_RATIO, UPDATE_RATIO)
    round_episodes: int = 2

    @property
    def prefix(self) -> str:
        """Environment and agent."""
        return f"{self.env}-{self.explorer}"

    @property
    def content(self) -> dict[str, Any]:
        """All of it."""
        return {
            "env": self.env,
            "options": all_options(self.env, self.options),
            "agent": AGENTS[self.explorer],
            "size": SIZES[self.size],
            "online": self._online,
            "seed": self.seed,
        }

    @property
    def work(self) -> int:
        """Steps."""
        return self.steps

    @property
    def pace(self) -> str:
        """Simulator, agent, its size, and how much it learns."""
        much = "" if not self.policies else f" {self.update_ratios[1]}"
        return f"explore {self.env} {image_size(self.env, self.options)} {self.explorer} {self.size}{much}"

    @property
    def updates(self) -> int:
        """Updates while it collects."""
        own = self.steps - sum(self._first.values())
        return max(1, self._online.seed_updates + round(self.update_ratios[1] * own))

    @property
    def _first(self) -> Mapping[str, int]:
        return self.policies or {"random": max(1, round(SEED_STEPS * self.steps))}

    @property
    def _online(self) -> Online:
        return Online(
            steps=self.steps,
            seed_policy=tuple(self._first),
            seed_steps=tuple(self._first.values()),
            seed_updates=max(1, round(self.update_ratios[0] * sum(self._first.values()))),
            update_ratio=self.update_ratios[1],
            round_episodes=self.round_episodes,
            workers=0,
        )

    def commands(self, root: Path, machine: Machine) -> list[Command]:
        """``ocwm train-online``."""
        online = self._online
        settings = {
            "steps": online.steps,
            "seed_policy": list(online.seed_policy),
            "seed_steps": list(online.seed_steps),
            "seed_updates": online.seed_updates,
            "update_ratio": online.update_ratio,
            "round_episodes": online.round_episodes,
            "workers": online.workers,
        }
        training = {"seed": self.seed, "updates": self.updates, "eval_interval": 0, "video_interval": 0}
        return [
            (
                "train-online",
                *(f"agent={self.explorer}", f"env={self.env}", f"size={self.size}"),
                *given("env.options", self.options),
                *given("online", settings),
                *given("training", {**training, "threads": machine.threads, "device": machine.device}),
                override("output", root / self.name),
                override("dataset", self.dataset(root)),
            )
        ]


@dataclass(frozen=True, kw_only=True)
class Drawn(Data):
    """The episodes of another dataset, with their goals in the images: agents with and without see the same.

    Args:
        plain: The other dataset. Environment and seed are its own; the options say how large the target is.
    """

    plain: Data

    @property
    def prefix(self) -> str:
        """That of the other dataset."""
        return f"{self.plain.prefix}-target"

    @property
    def content(self) -> dict[str, Any]:
        """The other dataset, and the target."""
        return {"plain": self.plain.content, "virtual_target": self._diameter}

    @property
    def _diameter(self) -> int:
        return self.options["virtual_target"]

    @property
    def work(self) -> int:
        """Steps."""
        return self.plain.work

    @property
    def pace(self) -> str:
        """Simulator and image."""
        return f"draw {self.env} {image_size(self.env, self.options)}"

    @property
    def needs(self) -> tuple[Run, ...]:
        """The other dataset."""
        return (self.plain,)

    def commands(self, root: Path, machine: Machine) -> list[Command]:  # noqa: ARG002
        """``ocwm draw-targets``."""
        paths = override("dataset", self.plain.dataset(root)), override("destination", self.dataset(root))
        return [("draw-targets", *paths, f"diameter={self._diameter}")]


def steps_in(path: Path) -> int:
    """Environment steps of a dataset, if there is one."""
    try:
        with EpisodeDataset.open(path) as dataset:
            return dataset.num_steps
    except DatasetError:
        return 0
