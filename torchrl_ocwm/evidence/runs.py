"""What evidence is made of: datasets, trainings and evaluations, each found by the content of its settings."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar

from torchrl_ocwm.agents import AGENTS, SIZES
from torchrl_ocwm.data import DatasetError, EpisodeDataset
from torchrl_ocwm.evidence.command_line import Command, given, override, written
from torchrl_ocwm.evidence.options import all_options, image_size
from torchrl_ocwm.evidence.settings import Machine
from torchrl_ocwm.settings import change, to_dict
from torchrl_ocwm.training import CHECKPOINT, Online, Training

#: Episodes of each evaluation during training, to as many of the landmark goals.
LANDMARKS = 5
#: Evaluations during training.
EVALUATIONS = 10
#: Seeds an explorer's dataset, and how much it learns while it explores.
SEED_STEPS, UPDATE_RATIO = 0.1, 0.1


@dataclass(frozen=True, kw_only=True)
class Run(ABC):
    """Something to be done once: its folder is named by the content of its settings.

    Commands that have been stopped, or that were run before, go on where they were when they are run again.
    """

    kind: ClassVar[str]

    @property
    @abstractmethod
    def prefix(self) -> str:
        """What people call it by."""

    @property
    @abstractmethod
    def content(self) -> dict[str, Any]:
        """The settings that decide what it finds."""

    @property
    @abstractmethod
    def work(self) -> int:
        """How much there is to do: steps or updates."""

    @property
    @abstractmethod
    def pace(self) -> str:
        """What it is as fast as, of other runs."""

    @property
    def needs(self) -> tuple[Run, ...]:
        """What has to be there before."""
        return ()

    @abstractmethod
    def commands(self, root: Path, machine: Machine) -> list[Command]:
        """What does it, one after the other."""

    @abstractmethod
    def reached(self, root: Path) -> int:
        """How much of the work is done, as far as its files say."""

    @cached_property
    def name(self) -> str:
        """Its folder in that of all runs; runs of the same name are the same.

        Settings with their default are no part of it: one that is added later, with what was the rule before as its
        default, changes no name.
        """
        text = json.dumps(to_dict(self.content, defaults=False), sort_keys=True)
        return f"{self.kind}/{self.prefix}-{sha256(text.encode()).hexdigest()[:8]}"


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


def steps_in(path: Path) -> int:
    """Environment steps of a dataset, if there is one."""
    try:
        with EpisodeDataset.open(path) as dataset:
            return dataset.num_steps
    except DatasetError:
        return 0


def last_step(folder: Path) -> int:
    """The last update that a training has logged."""
    from torchrl_ocwm.evaluation.plots import read_scalar

    curve = read_scalar(folder, "loss_value") if (folder / CHECKPOINT).exists() else None
    return 0 if curve is None else int(curve[0][-1])
