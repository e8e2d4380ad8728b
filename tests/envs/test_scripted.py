"""Scripted policies bring objects to their goals, and the transform hands out one target after the other."""

import gymnasium
import numpy as np
import pytest
import torch

from torchrl_ocwm.envs import ENVIRONMENTS, PositioningEnv, ScriptedAction, make_env


@pytest.fixture
def reacher():
    env = make_env("reacher", image_size=16, seed=0, privileged=True).append_transform(ScriptedAction(patience=40))
    yield env
    env.close()


def follow(tensordict):
    return tensordict.set("action", tensordict["scripted_action"])


@pytest.mark.parametrize(("name", "steps"), [("reacher", 60), ("cube_move", 60), ("cube_lift", 25)])
def test_script_reaches_the_landmarks(name, steps):
    env = gymnasium.make(ENVIRONMENTS[name].id, image_size=16, privileged=True).unwrapped
    env.blind = True  # it looks at nothing
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


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("cube_move", (0.05, 0.0, 0.0)),
        ("cube_move", (0.0, -0.05, 0.03)),
        ("cube_move", (0.0, 0.0, 0.07)),
        ("cube_lift", (0.05, 0.0, 0.07)),
        ("shelf_place", (0.06, 0.0, 0.08)),
        ("pick_place", (0.06, 0.0, 0.08)),
    ],
)
def test_a_hand_that_misses_goes_to_the_goal_without_the_object(name, error):
    env = gymnasium.make(ENVIRONMENTS[name].id, image_size=16, privileged=True).unwrapped
    goal = env.workspace.landmarks[4]
    env.reset(seed=0, options={"goal_position": goal})
    for _ in range(60):
        observation, *_ = env.step(env.scripted_action(error=error))
    hand = env.data.site_xpos[env._gripper] if name.startswith("cube_") else env.data.xpos[env._hand]
    assert (hand - env._start)[0] == pytest.approx(goal[0], abs=0.02)
    assert np.linalg.norm(observation["object_position_true"][0] - goal) > 0.08
    env.close()


def test_share_of_misses():
    transform, errors = ScriptedAction(misses=0.3), []
    transform._random = np.random.default_rng(0)
    for _ in range(2000):
        transform._aim(np.zeros(2))
        errors.append(transform._error)
    errors = np.stack(errors)
    missed = errors[errors.any(-1)]
    assert len(missed) / len(errors) == pytest.approx(0.3, abs=0.04)
    assert missed.min(0) == pytest.approx([-0.06, -0.06, 0.0], abs=0.003)
    assert missed.max(0) == pytest.approx([0.06, 0.06, 0.08], abs=0.003)


def test_targets_and_misses_depend_on_the_seed_of_the_episode_alone(reacher):
    runs = []
    for seed, past in ((5, 3), (5, 70), (6, 3)):
        torch.manual_seed(past)
        reacher.rollout(past, follow)
        runs.append(
            reacher.rollout(90, follow, auto_reset=False, tensordict=reacher.reset(seed=seed))["scripted_action"]
        )
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


def test_the_transform_tells_the_environment_of_the_miss(reacher, monkeypatch):
    transform, told = reacher.transform[-1], []
    monkeypatch.setattr(transform, "misses", 1.0)
    simulator = reacher.base_env._env.unwrapped
    monkeypatch.setattr(simulator, "scripted_action", lambda _, error: told.append(error) or np.zeros(2, np.float32))
    reacher.rollout(3, follow)
    assert len(told) == 4
    assert all(np.array_equal(error, told[0]) for error in told)
    assert told[0].any()


def test_goal_of_its_own(reacher):
    env = reacher.base_env._env.unwrapped
    reacher.reset()
    assert not np.array_equal(env.scripted_action(np.array([0.1, 0.1])), env.scripted_action(np.array([-0.1, 0.1])))
    with pytest.raises(ValueError, match="outside the workspace"):
        env.scripted_action(np.array([1.0, 0.0]))


def test_from_target_to_target(reacher):
    transform = reacher.transform[-1]
    targets = []

    def policy(tensordict):
        targets.append(torch.from_numpy(transform._target).float())
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
        Plain._scripted_action(Plain.__new__(Plain), np.zeros(2), np.zeros(3))


def test_no_patience():
    with pytest.raises(ValueError, match="patience must be at least 1 step, got 0"):
        ScriptedAction(patience=0)


@pytest.mark.parametrize("misses", [-0.1, 1.1])
def test_no_share(misses):
    with pytest.raises(ValueError, match="misses must be a share between 0 and 1"):
        ScriptedAction(misses=misses)
