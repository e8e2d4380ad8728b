from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.envs import Task, make_task
from torchrl_ocwm.evaluation import (
    EvaluationEnvs,
    LandmarkEvaluation,
    ReconstructionError,
    episode_records,
    goal_images,
    transition,
)
from torchrl_ocwm.testing import random_records, reacher_task


def still(tensordict: TensorDictBase) -> TensorDictBase:
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 2))


def push(tensordict: TensorDictBase) -> TensorDictBase:
    return tensordict.set("action", torch.ones(*tensordict.batch_size, 2))


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("reacher")


@pytest.fixture(scope="module")
def envs(task: Task) -> Iterator[EvaluationEnvs]:
    with EvaluationEnvs(task, episode_steps=5, workers=0, envs=4) as envs:
        yield envs


def goals(task: Task, number: int) -> Tensor:
    return task.workspace.grid(4).flatten(0, 1)[:number]


@pytest.mark.parametrize("number", [1, 4, 6])
def test_one_episode_per_goal(envs: EvaluationEnvs, task: Task, number: int) -> None:
    episodes = envs.run(push, goals(task, number))
    assert episodes.shape == (number, 5)
    torch.testing.assert_close(episodes["goal_position"], goals(task, number).unsqueeze(1).expand(-1, 5, -1))
    distance = (episodes["object_position"][:, :, 0] - episodes["goal_position"]).norm(dim=-1, keepdim=True)
    torch.testing.assert_close(episodes["reward"], -distance)


def test_seed_decides(envs: EvaluationEnvs, task: Task) -> None:
    first, second, other = (envs.run(push, goals(task, 6), seed=seed) for seed in (3, 3, 4))
    torch.testing.assert_close(first["object_position_true"], second["object_position_true"], rtol=0, atol=0)
    assert not torch.equal(first["object_position_true"], other["object_position_true"])


def test_episodes_move_with_the_policy(envs: EvaluationEnvs, task: Task) -> None:
    def travelled(policy: Any) -> float:
        position = envs.run(policy, goals(task, 4))["object_position_true"][:, :, 0]
        return float((position[:, -1] - position[:, 0]).norm(dim=-1).mean())

    assert travelled(still) < 1e-6
    assert travelled(push) > 1e-3


def test_records_are_those_of_a_dataset(envs: EvaluationEnvs, task: Task) -> None:
    """One more than steps: the first frame too, and with each frame the action that led to it."""
    episodes = envs.run(push, goals(task, 3), inspect=transition)
    records = episode_records(episodes)
    assert records.shape == (3, 6)
    assert records["is_init"].squeeze(-1).nonzero()[:, 1].tolist() == [0, 0, 0]
    torch.testing.assert_close(records["action"][:, :, 0], torch.tensor([0.0, 1, 1, 1, 1, 1]).expand(3, 6))
    seen = records["next", "object_position"]
    torch.testing.assert_close(seen[:, 1:], episodes["object_position"])
    assert not torch.equal(seen[:, 0], seen[:, 1])
    assert records["next", "masks"].flatten(2).any(-1).all()
    kept = set(random_records(task, 1, 2)["next"].keys())
    assert kept - set(records["next"].keys()) <= {"object_position_true"}


def test_goals_reach_the_environments_of_every_process(task: Task) -> None:
    with EvaluationEnvs(task, episode_steps=5, workers=2, envs=2) as parallel:
        episodes = parallel.run(push, goals(task, 4), keep=("pixels",))
    assert episodes["pixels"].shape == (4, 5, 3, 64, 64)
    distance = (episodes["object_position"][:, -1, 0] - goals(task, 4)).norm(dim=-1)
    torch.testing.assert_close(episodes["reward"][:, -1, 0], -distance)  # each environment had its own goal


@pytest.mark.parametrize("workers", [0, 2])
def test_each_environment_keeps_its_goal_image(task: Task, workers: int) -> None:
    places = goals(task, 3)
    images = goal_images(task, places)
    seen = []

    def look(tensordict: TensorDictBase) -> TensorDictBase:
        seen.append(tensordict["goal", "pixels"].clone())
        return push(tensordict)

    with EvaluationEnvs(task, episode_steps=3, workers=workers, envs=2) as envs:
        envs.run(look, places, images=images)
    full = images[[0, 1, 2, 2]].split(max(workers, 1) * 2)
    for step, given in enumerate(seen):
        torch.testing.assert_close(given.flatten(0, 1), full[step // 3], rtol=0, atol=0)


def test_goal_images_show_the_object_at_the_goal(task: Task) -> None:
    places = goals(task, 3)
    with gymnasium.make("ocwm/Reacher-v0", privileged=True) as env:
        env.reset(seed=5)
        for place, image in zip(places, goal_images(task, places), strict=True):
            there = env.unwrapped.goal_observation(place.numpy())
            assert np.linalg.norm(there["object_position_true"][0] - place.numpy()) < 0.005
            np.testing.assert_array_equal(there["pixels"], image)


def test_goals_are_checked(envs: EvaluationEnvs) -> None:
    with pytest.raises(ValueError, match="lies outside the workspace"):
        envs.run(still, torch.tensor([[0.5, 0.0]]))
    with pytest.raises(ValueError, match="has 2 coordinates"):
        envs.run(still, torch.zeros(3, 3))


def test_reconstruction_error_by_hand(make_agent: Any) -> None:
    agent = make_agent("dreamer")
    decoders = agent.model.vector_decoders
    decoders["object_position"] = Constant([0.5, 0.0])  # units of 0.24 m
    decoders["goal_position"] = Constant([0.0, 1.0])
    latent = TensorDict({"state": torch.zeros(3, agent.model.state), "belief": torch.zeros(3, agent.model.belief)}, [3])
    step = TensorDict(
        {
            "latent": latent,
            "object_position_true": torch.tensor([[[0.12, 0.05]]]).expand(3, 1, 2),
            "goal_position": torch.tensor([[0.1, 0.24]]).expand(3, 2),
        },
        [3],
    )
    errors = ReconstructionError(agent)(step)
    torch.testing.assert_close(errors["entity_error"], torch.full((3,), 0.05))
    torch.testing.assert_close(errors["goal_error"], torch.full((3,), 0.1))
    assert "goal_error" not in ReconstructionError(make_agent("dreamer_pcp"))(step)


class Constant(torch.nn.Module):
    def __init__(self, value: list[float]) -> None:
        super().__init__()
        self.value = torch.tensor(value)

    def forward(self, state: Tensor, belief: Tensor) -> Tensor:
        return self.value.expand(*state.shape[:-1], -1)


def test_landmarks(task: Task) -> None:
    agent = build_agent("dreamer_pcp", task, "debug")
    scores = LandmarkEvaluation(agent, episodes=2, episode_steps=3)(0)
    assert set(scores) == {f"evaluation/{name}" for name in ("final_score", "mean_score", "success", "final_distance")}
    assert 0 < scores["evaluation/final_score"] < 1
    with pytest.raises(ValueError, match="11 evaluation episodes, but reacher has 10 landmarks"):
        LandmarkEvaluation(agent, episodes=11, episode_steps=3)(0)


def test_the_test_task_is_reachers(task: Task) -> None:
    """What tests and doctests use without a simulator has the simulator's shapes."""
    workspace = replace(task.workspace, landmarks=reacher_task().workspace.landmarks, reach=(0.042, 0.24))
    assert replace(task, workspace=workspace) == reacher_task()
    assert task.workspace.reach == pytest.approx((0.042, 0.24), abs=1e-3)
