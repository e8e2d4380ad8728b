"""What the settings of online training do, in runs of a few steps; and which behaviour acts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from rows import shows
from tensordict import TensorDictBase

from torchrl_ocwm.agents import AGENTS, EXPLORERS, Agent, build_agent, collecting_policy, save_agent
from torchrl_ocwm.agents.presets import AgentConfig
from torchrl_ocwm.data import Collection, EpisodeDataset, collect
from torchrl_ocwm.envs import make_task
from torchrl_ocwm.training import online as online_module
from torchrl_ocwm.training.online import Player, collect_seed_steps, train_online
from torchrl_ocwm.training.settings import Online, Training

OPTIONS = {"image_size": 16, "horizon": 10}
SHORT = Online(
    seed_policy=("scripted", "random"),
    seed_steps=(20, 10),
    seed_updates=2,
    update_ratio=0.1,
    round_episodes=2,
    workers=0,
)


def exploring() -> AgentConfig:
    return AGENTS["dreamer_pcp"].and_behaviours(explore=EXPLORERS["apt"])


def fresh() -> Agent:
    torch.manual_seed(0)
    return build_agent(exploring(), make_task("reacher", image_size=16), "debug")


def played(folder: Path, **changes: Any) -> dict[str, int]:
    """Episodes in the dataset by who played them, after four updates."""
    online = replace(SHORT, **changes)
    with collect_seed_steps(folder / "data", "reacher", online, options=OPTIONS, progress=False) as dataset:
        training = Training(updates=4, log_interval=1, eval_interval=0)
        train_online(fresh(), dataset, folder, training, online, progress=False)
        return dict(dataset.metadata["policies"])


@shows(*(f"Online.{name}" for name in ("steps", "seed_policy", "seed_steps", "seed_updates")))
@shows(*(f"Online.{name}" for name in ("update_ratio", "round_episodes", "behaviours")))
@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, {"scripted": 2, "random": 1, "reach": 1, "explore": 1}),
        ({"seed_policy": ("random",), "seed_steps": (30,), "steps": 30}, {"random": 3}),
        ({"round_episodes": 5, "steps": 35}, {"scripted": 2, "random": 1, "reach": 1}),
        ({"round_episodes": 1, "seed_updates": 3}, {"scripted": 2, "random": 1, "reach": 1}),
        ({"behaviours": ("explore",), "update_ratio": 0.05}, {"scripted": 2, "random": 1, "explore": 4}),
    ],
)
def test_who_plays_how_much(tmp_path: Path, changes: dict[str, Any], expected: dict[str, int]) -> None:
    assert played(tmp_path, **changes) == expected


@shows("Online.collector", "Online.workers", "Online.timeout")
def test_which_collector(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []

    class Nothing:
        def update_policy_weights_(self) -> None:
            pass

        def __iter__(self) -> Iterator[TensorDictBase]:
            return iter(())

        def shutdown(self) -> None:
            pass

    def make(make: Any, policy: Any, online: Online, **numbers: Any) -> Nothing:
        seen.append((online.collector, online.workers))
        return Nothing()

    monkeypatch.setattr(online_module, "make_collector", make)
    monkeypatch.setattr(online_module, "next_episodes", lambda batches, collector, timeout: seen.append(timeout) or [])
    online = replace(SHORT, collector="async", workers=3, timeout=7)
    with collect_seed_steps(tmp_path / "data", "reacher", SHORT, options=OPTIONS, progress=False) as dataset:
        player = Player(fresh(), dataset, online, seed=5)
        player._next_episodes()
        player.close()
    assert seen == [("async", 3), 7.0]


@shows(*(f"TrainOnline.{name}" for name in ("agent", "env", "size", "training", "online", "output", "dataset")))
def test_the_recipe_trains_what_it_is_told(
    command: Callable[..., str], scripts: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: dict[str, Any] = {}

    def stub(agent: Agent, dataset: EpisodeDataset, folder: Path, training: Training, online: Online, **_: Any) -> Path:
        seen.update(agent=agent, dataset=dataset, folder=folder, training=training, online=online)
        return folder / "checkpoint.zip"

    monkeypatch.setattr(scripts["train_online"], "train_online", stub)
    arguments = ("size=debug", "env.options.image_size=16", "env.options.horizon=5", "online.workers=0")
    quiet = ("training.eval_interval=0", "training.video_interval=0", "online.seed_steps=[5]", "output=there")
    command("train_online", "agent=focus", *arguments, *quiet, "training.seed=3", "online.update_ratio=0.5")
    assert seen["agent"].config == AGENTS["focus"]
    assert (seen["agent"].size.learning.batch_size, seen["agent"].task.image_size) == (2, 16)
    assert (seen["training"].seed, seen["online"].update_ratio) == (3, 0.5)
    assert (seen["folder"], seen["dataset"].path) == (Path("there"), Path("there/data"))
    assert (seen["dataset"].metadata["environment"], seen["dataset"].metadata["options"]["horizon"]) == ("reacher", 5)
    command("train_online", "agent=focus", *arguments, *quiet, "dataset=elsewhere")
    assert seen["dataset"].path == Path("elsewhere")
    assert (tmp_path / "elsewhere" / "dataset.json").exists()


# Which behaviour of an agent acts.


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_agent(fresh(), tmp_path_factory.mktemp("agent") / "agent.zip")


@shows("Collection.behaviour")
def test_a_behaviour_collects(tmp_path: Path, checkpoint: Path) -> None:
    actions = []
    for behaviour in (None, "reach", "explore"):
        settings = Collection(steps=10, policy=str(checkpoint), behaviour=behaviour, workers=0)
        policy = collecting_policy(settings, "reacher", OPTIONS)
        folder = tmp_path / str(behaviour)
        dataset = collect(folder, "reacher", settings, policy=policy, options=OPTIONS, progress=False)
        assert dataset.metadata["policies"] == {f"{checkpoint} ({behaviour})" if behaviour else str(checkpoint): 1}
        actions.append(dataset.records["action"].clone())
    assert torch.equal(actions[0], actions[1])
    assert not torch.equal(actions[1], actions[2])


@shows("Evaluation.behaviour")
def test_a_behaviour_is_evaluated(
    command: Callable[..., str], scripts: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch, checkpoint: Path
) -> None:
    seen, load = [], scripts["evaluate"].load_agent

    def note(file: Path, *, behaviour: str | None) -> Any:
        policy = load(file, behaviour=behaviour)
        seen.append(policy.behaviour is policy.agent.behaviour(behaviour))
        return policy

    monkeypatch.setattr(scripts["evaluate"], "load_agent", note)
    monkeypatch.setattr(scripts["evaluate"], "draw", lambda *_, **__: [])
    small = (f"checkpoint={checkpoint}", "goals=1", "episode_steps=1", "workers=0", "video_goals=0", "random=false")
    assert "| dreamer_pcp + apt, explore |" in command(
        "evaluate", f"checkpoint={checkpoint}", "behaviour=explore", *small
    )
    assert "| dreamer_pcp + apt |" in command("evaluate", "output=other", *small)
    assert seen == [True, True]
