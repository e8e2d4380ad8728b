"""Recordings of a robot that nobody here knows: from tensors to a dataset, an agent, and an action."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.data import DatasetError, EpisodeDataset, episode_to_records
from torchrl_ocwm.envs import ActionRange, Task, Workspace
from torchrl_ocwm.settings import SettingsError
from torchrl_ocwm.testing import random_records, reacher_task

EXAMPLES = Path(__file__).parents[2] / "examples"
TASK = Task("my_arm", 32, ("block",), 7, 3, Workspace(low=(-0.2, -0.2, 0.0), high=(0.2, 0.2, 0.3)))
JOINTS = ActionRange(low=(0.0, -3.0, -0.5), high=(2.0, 3.0, 1.5))

TASKS = {
    "no simulator": TASK,
    "84 pixels": replace(TASK, image_size=84),
    "128 pixels": replace(TASK, image_size=128),
    "not square": replace(TASK, image_size=(24, 50)),
    "two cameras": replace(TASK, image_size=(32, 64)),
    "joint targets": replace(TASK, action_range=JOINTS),
    "discrete actions": replace(TASK, discrete=True),
}


def record(task: Task, folder: Path, *, without: tuple[str, ...] = (), episodes: int = 2, steps: int = 12) -> Path:
    """As somebody would do it: frames, the actions between them in the robot's own units, one episode at a time."""
    metadata = {"environment": task.name, "options": {}, "task": task.to_dict()}
    dataset = None
    for seed in range(episodes):
        frames = random_records(task, 1, steps + 1, seed=seed)[0]["next"]
        frames = frames.exclude("done", "terminated", "reward", *without)
        episode = frames[:-1].clone()
        episode["action"] = act(task, steps)
        done = torch.zeros(steps, 1, dtype=torch.bool)
        done[-1] = True
        episode["next"] = frames[1:].clone().update({"done": done, "terminated": torch.zeros_like(done)})
        records = episode_to_records(episode)
        if dataset is None:
            dataset = EpisodeDataset.create(folder, example=records[0], metadata=metadata)
        dataset.append(records)
    assert dataset is not None
    dataset.close()
    return folder


def act(task: Task, steps: int) -> Tensor:
    if task.discrete:
        return torch.nn.functional.one_hot(torch.randint(task.action, (steps,)), task.action).float()
    if task.action_range is not None:
        low, high = torch.tensor(task.action_range.low), torch.tensor(task.action_range.high)
        return task.action_range.normalise(low + (high - low) * torch.rand(steps, task.action)).clamp(-1, 1)
    return 2 * torch.rand(steps, task.action) - 1


def train(dataset: Path, output: Path, *more: str) -> Path:
    every = ("log", "eval", "checkpoint")
    settings = ("updates=3", *(f"{interval}_interval=2" for interval in every))
    arguments = [
        f"dataset={dataset}",
        "env.name=my_arm",
        f"output={output}",
        "size=debug",
        "training.video_interval=3",
        *more,
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["train_offline.py", *arguments, *(f"training.{setting}" for setting in settings)])
        runpy.run_path(str(EXAMPLES / "train_offline.py"), run_name="__main__")
    return output / "checkpoint.zip"


@pytest.mark.parametrize("name", TASKS)
def test_recordings_train_to_an_agent_that_acts(name: str, tmp_path: Path) -> None:
    task = TASKS[name]
    agent = "dreamer_pcp" if name.endswith("pixels") else "focus_pcp"  # large images take long
    with pytest.warns(UserWarning, match="no environment 'my_arm' is registered") as warned:
        checkpoint = train(record(task, tmp_path / "data"), tmp_path / "run", f"agent={agent}")
    assert len([one for one in warned if "no evaluations" in str(one.message)]) == 1
    [log] = (tmp_path / "run" / "log").glob("**/loss_actor.csv")
    assert [int(float(line.split(",")[0])) for line in log.read_text().split()] == [2, 3]
    assert len(list((tmp_path / "run" / "videos").glob("*.mp4"))) == 1

    policy = load_agent(checkpoint)
    assert policy.agent.task == task
    step = random_records(task, 2, 1)[:, 0]["next"].select("pixels", "proprio", "object_position", "goal_position")
    step["is_init"] = torch.ones(2, 1, dtype=torch.bool)
    action = policy(step)["action"]
    assert action.shape == (2, 3)
    assert action.abs().max() <= 1
    if task.discrete:
        assert sorted(action[0].tolist()) == [0, 0, 1]
    if task.action_range is not None:
        targets = task.action_range.to_robot(action)
        assert (targets >= torch.tensor(JOINTS.low)).all()
        assert (targets <= torch.tensor(JOINTS.high)).all()


def test_two_action_ranges_are_each_others_inverse_and_ends_are_ends() -> None:
    ends = torch.tensor([JOINTS.low, JOINTS.high])
    assert JOINTS.normalise(ends).tolist() == [[-1, -1, -1], [1, 1, 1]]
    assert torch.allclose(JOINTS.to_robot(JOINTS.normalise(ends / 3)), ends / 3, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"action_range": ActionRange(low=(0.0,), high=(1.0,))}, "action_range must have 3 values, got 1"),
        ({"action_range": JOINTS, "discrete": True}, "action_range does nothing: discrete actions have no range"),
        ({"image_size": (0, 3)}, r"image_size must be at least 1, got \(0, 3\)"),
    ],
)
def test_tasks_that_cannot_be(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        replace(TASK, **changes)


def test_a_range_without_extent_is_refused() -> None:
    with pytest.raises(SettingsError, match="low must be below high for every action"):
        ActionRange(low=(0.0, 1.0), high=(1.0, 1.0))


def test_discrete_actions_can_be_recorded_as_whole_numbers(tmp_path: Path) -> None:
    path = record(replace(TASK, discrete=True), tmp_path / "data", episodes=1)
    with EpisodeDataset.open(path, write=True) as dataset:
        records = dataset[0]
        records["action"] = torch.arange(len(records)).remainder(3).unsqueeze(-1)
        dataset.append(records)
        assert torch.equal(dataset[1]["action"].argmax(-1), records["action"].squeeze(-1))
        records["action"] = records["action"] + 1
        with pytest.raises(DatasetError, match="the task has actions 0 to 2, as one whole number each, got 1 to 3"):
            dataset.append(records)
        records["action"] = torch.full((len(records), 3), 0.5)
        with pytest.raises(DatasetError, match="the task's actions are discrete"):
            dataset.append(records)


def test_gradients_reach_the_actor_of_discrete_actions() -> None:
    task = replace(reacher_task(), discrete=True)
    agent = build_agent("dreamer_pcp", task, "debug")
    agent.loss(random_records(task, 2, 5))["loss_actor"].backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in agent.actor.parameters())
    imagined = agent.imagination.rollout(3, agent.actor, auto_reset=False, tensordict=_latent(agent))
    assert torch.equal(imagined["action"].sort(-1).values, torch.tensor([0.0, 1.0]).expand(4, 3, 2))


def _latent(agent: Any) -> TensorDict:
    latent = {"state": torch.rand(4, agent.model.state), "belief": torch.rand(4, agent.model.belief)}
    latent["goal"] = torch.rand(4, 2)
    return TensorDict({"latent": TensorDict(latent, [4])}, [4])


def test_recordings_without_positions_say_once_who_cannot_learn_from_them(tmp_path: Path) -> None:
    lacks = ("masks", "object_position", "object_visible", "goal_position")
    path = record(TASK, tmp_path / "data", without=lacks)
    with pytest.raises(SystemExit, match=r"holds no .*object_position.*MaskToPosition.*observed=\[proprio\]"):
        train(path, tmp_path / "pcp", "agent=dreamer_pcp")
    with pytest.warns(UserWarning, match="no evaluations"):
        assert train(path, tmp_path / "lexa", "agent=lexa_cosine", "agent.world_model.observed=[proprio]").exists()


def test_a_dataset_of_an_environment_names_it_where_another_is_asked_for(tmp_path: Path) -> None:
    path = record(TASK, tmp_path / "data")
    with pytest.raises(SystemExit, match="holds my_arm, not env=reacher; give env.name=my_arm"):
        train(path, tmp_path / "run", "env.name=reacher")


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None] | None:
    monkeypatch.chdir(tmp_path)
    return None
