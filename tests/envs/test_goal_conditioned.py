"""Goals as hindsight replay knows them, and success in the tensordict."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from torchrl.data import HERReplayBuffer, LazyTensorStorage
from torchrl.envs import EnvBase, GymWrapper

from torchrl_ocwm.envs import GoalConditioned, make_env


class TwoObjects(gymnasium.Env):
    """The first stays at the origin, the second moves 3 cm along x with each step; the goal is at (10 cm, 0)."""

    observation_space = spaces.Dict(
        {
            "pixels": spaces.Box(0, 255, (3, 4, 4), np.uint8),
            "proprio": spaces.Box(-np.inf, np.inf, (1,), np.float32),
            "object_position": spaces.Box(-np.inf, np.inf, (2, 2), np.float32),
            "goal_position": spaces.Box(-1, 1, (2,), np.float32),
        }
    )
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def _see(self) -> dict[str, np.ndarray]:
        return {
            "pixels": np.full((3, 4, 4), self.steps, np.uint8),
            "proprio": np.array([7.0], np.float32),
            "object_position": np.array([[0, 0], [0.03 * self.steps, 0]], np.float32),
            "goal_position": np.array([0.1, 0], np.float32),
        }

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.steps = 0
        return self._see(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        self.steps += 1
        return self._see(), -0.1, False, self.steps == 4, {"success": False, "other": 1}


def test_observations() -> None:
    env = GoalConditioned(TwoObjects(), object_index=1, pixels=True)
    env.reset()
    seen, *_ = env.step(np.zeros(1, np.float32))
    np.testing.assert_allclose(seen["observation"], [7, 0, 0, 0.03, 0])
    np.testing.assert_allclose(seen["achieved_goal"], [0.03, 0])
    np.testing.assert_allclose(seen["desired_goal"], [0.1, 0])
    assert (seen["pixels"] == 1).all()
    assert env.observation_space.contains(seen)


@pytest.mark.parametrize(
    ("index", "sparse", "rewards", "successes"),
    [
        (0, False, [-0.1, -0.1, -0.1], [False, False, False]),
        (1, False, [-0.07, -0.04, -0.01], [False, True, True]),
        (1, True, [-1, 0, 0], [False, True, True]),
    ],
)
def test_rewards_are_of_the_object_that_is_meant(index, sparse, rewards, successes) -> None:
    env = GoalConditioned(TwoObjects(), object_index=index, sparse=sparse)
    env.reset()
    steps = [env.step(np.zeros(1, np.float32)) for _ in rewards]
    assert [step[1] for step in steps] == pytest.approx(rewards, abs=1e-6)
    assert [step[4]["is_success"] for step in steps] == [step[4]["success"] for step in steps] == successes
    assert steps[0][4]["other"] == 1


@pytest.mark.parametrize("make", [np.array, torch.tensor])
def test_rewards_of_many_goals_at_once(make) -> None:
    env = GoalConditioned(TwoObjects())
    achieved, desired = make([[0.0, 0.0], [0.3, 0.4], [0.0, 0.0]]), make([[0.0, 0.0], [0.0, 0.0], [0.03, 0.0]])
    assert env.compute_reward(achieved, desired, [{}] * 3).tolist() == pytest.approx([0, -0.5, -0.03])
    sparse = GoalConditioned(TwoObjects(), sparse=True)
    assert sparse.compute_reward(achieved, desired, {}).tolist() == [0, -1, 0]


def test_an_object_that_is_not_there() -> None:
    with pytest.raises(ValueError, match="object_index must be one of the 2 objects, got 2"):
        GoalConditioned(TwoObjects(), object_index=2)


@pytest.fixture(scope="module")
def reacher() -> Iterator[gymnasium.Env]:
    env = gymnasium.make("torchrl_ocwm.envs:ocwm/Reacher-v0", image_size=16, mask_scale=4, horizon=5)
    yield env
    env.close()


def test_the_dense_reward_is_that_of_the_environment(reacher: gymnasium.Env) -> None:
    wrapped = GoalConditioned(reacher)
    check_env(wrapped, skip_render_check=True)
    actions = [np.array([np.cos(step), np.sin(step)], np.float32) for step in range(4)]
    reacher.reset(seed=1)
    plain = [reacher.step(action) for action in actions]
    wrapped.reset(seed=1)
    ours = [wrapped.step(action) for action in actions]
    assert [step[1] for step in ours] == pytest.approx([step[1] for step in plain], abs=1e-6)
    assert [step[4]["success"] for step in ours] == [step[4]["success"] for step in plain]


def test_hindsight_replay_of_torchrl(reacher: gymnasium.Env) -> None:
    """With each goal replaced by where the object got to, some step of every episode is at its goal."""
    wrapped = GoalConditioned(reacher)
    replay = HERReplayBuffer(
        lambda batch: wrapped.compute_reward(batch["next", "achieved_goal"], batch["desired_goal"], {}).unsqueeze(-1),
        her_ratio=1.0,
        strategy="final",
        goal_key="desired_goal",
        achieved_goal_key="achieved_goal",
        storage=LazyTensorStorage(20),
        batch_size=64,
    )
    env = GymWrapper(wrapped)
    for _ in range(2):
        replay.extend(env.rollout(5))
    batch = replay.sample()
    expected = -torch.linalg.vector_norm(batch["next", "achieved_goal"] - batch["desired_goal"], dim=-1)
    torch.testing.assert_close(batch["next", "reward"].squeeze(-1), expected)
    assert len(batch["desired_goal"].unique(dim=0)) == 2


@pytest.fixture(scope="module")
def env() -> Iterator[EnvBase]:
    env = make_env("reacher", image_size=16, mask_scale=4, horizon=4)
    yield env
    env.close()


def test_success_is_in_the_tensordict(env: EnvBase) -> None:
    x, y = env.reset(seed=3)["object_position"][0].tolist()
    for away, success in ((0.01, True), (0.1, False)):
        first = env.reset(seed=3, options={"goal_position": (x + away, y)})
        assert first["success"].shape == (1,)
        assert first["success"].dtype == torch.bool
        assert first["success"].item() is success
    rollout = env.rollout(3)
    distance = torch.linalg.vector_norm(
        rollout["next", "object_position"][:, 0] - rollout["next", "goal_position"], dim=-1, keepdim=True
    )
    assert torch.equal(rollout["next", "success"], distance <= 0.05)
    assert env.observation_spec["success"].shape == (1,)
