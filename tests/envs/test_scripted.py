"""Scripted policies bring objects to their goals, and the transform hands out one target after the other."""

import gymnasium
import numpy as np
import pytest
import torch

from torchrl_ocwm.envs import ENVIRONMENTS, PositioningEnv, ScriptedAction, make_env


@pytest.fixture
def reacher():
    env = make_env("reacher", image_size=16, seed=0).append_transform(ScriptedAction(patience=40))
    yield env
    env.close()


def follow(tensordict):
    return tensordict.set("action", tensordict["scripted_action"])


@pytest.mark.parametrize(("name", "steps"), [("reacher", 60), ("cube_move", 60)])
def test_script_reaches_the_landmarks(name, steps):
    env = gymnasium.make(ENVIRONMENTS[name].id, image_size=16).unwrapped
    for number, landmark in enumerate(env.workspace.landmarks):
        env.reset(seed=number, options={"goal_position": landmark})
        nearest = np.inf
        for _ in range(steps):
            action = env.scripted_action()
            assert env.action_space.contains(action)
            observation, *_ = env.step(action)
            distance = np.linalg.norm(observation["object_position_true"][0] - observation["goal_position"])
            nearest = min(nearest, distance)
        assert nearest < 0.02, landmark
    env.close()


def test_goal_of_its_own(reacher):
    env = reacher.base_env._env.unwrapped
    reacher.reset()
    assert not np.array_equal(env.scripted_action(np.array([0.1, 0.1])), env.scripted_action(np.array([-0.1, 0.1])))
    with pytest.raises(ValueError, match="outside the workspace"):
        env.scripted_action(np.array([1.0, 0.0]))


def test_from_target_to_target(reacher):
    torch.manual_seed(0)
    transform = reacher.transform[-1]
    targets = []

    def policy(tensordict):
        targets.append(transform._target.clone())
        return follow(tensordict)

    rollout = reacher.rollout(200, policy)
    changes = [step for step in range(1, 200) if not torch.equal(targets[step], targets[step - 1])]
    assert torch.equal(targets[0], rollout["goal_position"][0])
    assert len(changes) >= 5
    starts = [0, *changes]
    for start, end in zip(starts, changes, strict=False):
        distance = (rollout["object_position_true"][end, 0] - targets[start]).norm()
        arrived, gave_up = distance < 0.02, end - start == 40
        assert arrived or gave_up
        assert end - start <= 40


def test_a_reset_starts_with_the_goal(reacher):
    reacher.rollout(80, follow)
    tensordict = reacher.reset()
    expected = reacher.base_env._env.unwrapped.scripted_action(tensordict["goal_position"].numpy())
    assert np.array_equal(tensordict["scripted_action"].numpy(), expected)


def test_spec(reacher):
    assert reacher.observation_spec["scripted_action"].shape == (2,)
    assert reacher.reset()["scripted_action"].dtype == torch.float32


def test_environment_without_a_script(monkeypatch):
    class Plain(PositioningEnv):
        pass

    with pytest.raises(NotImplementedError, match="Plain has no scripted policy; collect with policy=random"):
        Plain._scripted_action(Plain.__new__(Plain), np.zeros(2))


def test_no_patience():
    with pytest.raises(ValueError, match="patience must be at least 1 step, got 0"):
        ScriptedAction(patience=0)
