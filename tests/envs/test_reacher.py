"""The Reacher environment: physics, masks and positions, starts and goals, virtual target, bad input."""

import importlib.util
from contextlib import closing
from pathlib import Path

import mujoco
import numpy as np
import pytest
from dm_control import suite
from dm_control.suite import reacher as dm_reacher
from observations import actions, assert_same, error

from torchrl_ocwm.envs import Reacher

LINK = 0.12
GOAL = np.array([0.1, -0.12], np.float32)


@pytest.fixture(scope="module")
def env():
    env = Reacher(privileged=True)
    yield env
    env.close()


# The data contract.


def test_true_position_and_proprio_follow_the_joints(env):
    env.reset(seed=1)
    for action in actions(env, 5):
        observation, *_ = env.step(action)
        shoulder, wrist = env.data.qpos
        expected = LINK * np.array(
            [np.cos(shoulder) + np.cos(shoulder + wrist), np.sin(shoulder) + np.sin(shoulder + wrist)]
        )
        assert observation["object_position_true"][0] == pytest.approx(expected, abs=1e-6)
        proprio = [np.cos(shoulder), np.sin(shoulder), wrist, *env.data.qvel]
        assert observation["proprio"] == pytest.approx(np.array(proprio), rel=1e-6)


def test_mask_is_the_finger_in_the_picture(env):
    """The mask lies where a camera 74 cm above the finger, with a view of 45 degrees, sees it."""
    for seed in range(10):
        observation, _ = env.reset(seed=seed)
        rows, columns = np.nonzero(observation["masks"][0])
        x, y = observation["object_position_true"][0]
        focal = 32 / np.tan(np.deg2rad(22.5))
        assert columns.mean() + 0.5 == pytest.approx(32 + focal * x / 0.74, abs=0.5)
        assert rows.mean() + 0.5 == pytest.approx(32 - focal * y / 0.74, abs=0.5)


def test_render_shows_the_pixels(env):
    observation, _ = env.reset(seed=0)
    assert env.render() is None
    with_picture = Reacher(render_mode="rgb_array", image_size=64)
    with_picture.reset(seed=0)
    picture = with_picture.render()
    with_picture.close()
    assert np.array_equal(picture.transpose(2, 0, 1), observation["pixels"])


@pytest.mark.parametrize("image_size", [48, 96])
def test_image_size(image_size):
    env = Reacher(image_size=image_size, privileged=True)
    observation, _ = env.reset(seed=0)
    env.close()
    assert observation["pixels"].shape == (3, image_size, image_size)
    assert observation["masks"].shape == (1, image_size, image_size)
    # A pixel is 62 cm / image_size wide: 45 degrees, 75 cm above the table.
    assert error(observation) < 620 / image_size


def test_the_task_has_no_target_of_its_own_in_the_picture(env):
    env.reset(seed=0)
    assert env.model.geom("target").rgba[3] == 0
    assert not (env.camera.render(env.data).geoms == env.model.geom("target").id).any()


# Goals.


def test_goals_are_uniform_in_the_workspace(env):
    env.reset(seed=0)
    goals = np.stack([env.reset()[0]["goal_position"] for _ in range(400)])
    assert len(np.unique(goals, axis=0)) == 400
    assert (np.abs(goals) <= 0.24).all()
    # Four standard deviations of a binomial with 400 draws.
    quadrants = np.bincount((goals > 0) @ [1, 2], minlength=4)
    assert quadrants == pytest.approx(100, abs=4 * (400 * 0.25 * 0.75) ** 0.5)
    corners = (np.linalg.norm(goals, axis=1) > 0.24).mean()
    share = 1 - np.pi / 4
    assert corners == pytest.approx(share, abs=4 * (share * (1 - share) / 400) ** 0.5)


def test_start_states_are_uniform_in_the_joint_angles(env):
    env.reset(seed=0)
    angles = np.stack([(env.reset(), env.data.qpos.copy())[1] for _ in range(400)])
    limits = np.array([np.pi, np.deg2rad(160)])
    assert (np.abs(angles) <= limits).all()
    # Mean and standard deviation of a uniform variable, four standard errors.
    assert angles.mean(0) / limits == pytest.approx(0, abs=4 / 3**0.5 / 20)
    assert angles.std(0) / limits == pytest.approx(1 / 3**0.5, rel=0.1)


# Physics and time.


def test_two_control_steps_per_step_by_default(env):
    env.reset(seed=6)
    model = mujoco.MjModel.from_xml_string(*dm_reacher.get_model_and_assets())
    data = mujoco.MjData(model)
    data.qpos[:] = env.data.qpos
    mujoco.mj_forward(model, data)
    for action in actions(env, 20):
        env.step(action)
        data.ctrl[:] = action
        mujoco.mj_step(model, data)
        mujoco.mj_step(model, data)
        assert np.array_equal(env.data.qpos, data.qpos)
        assert np.array_equal(env.data.qvel, data.qvel)
        mujoco.mj_forward(model, data)
        assert np.array_equal(env.data.geom_xpos, data.geom_xpos)


@pytest.mark.parametrize("repeat", [1, 3])
def test_physics_are_those_of_dm_control(repeat):
    env = Reacher(action_repeat=repeat, image_size=8)
    env.reset(seed=7)
    original = suite.load("reacher", "easy")
    original.reset()
    with original.physics.reset_context():
        original.physics.data.qpos[:] = env.data.qpos
        original.physics.data.qvel[:] = 0
    for action in actions(env, 10):
        env.step(action)
        for _ in range(repeat):
            original.step(action)
        assert env.data.qpos == pytest.approx(original.physics.data.qpos, abs=1e-9)
    env.close()


# Positions from masks.


def load_benchmark():
    path = Path(__file__).parents[2] / "benchmarks" / "position_error.py"
    spec = importlib.util.spec_from_file_location("position_error", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("mask_scale", "median", "rare"), [(1, 2.3, 4.5), (2, 0.75, 2.0)])
def test_position_error_over_random_poses(mask_scale, median, rare):
    with closing(Reacher(mask_scale=mask_scale, privileged=True)) as env:
        errors = load_benchmark().of_poses(env, 60, seed=0)
    assert not np.isnan(errors).any()
    assert np.median(errors) == pytest.approx(median, rel=0.2)
    assert np.percentile(errors, 95) < rare


@pytest.mark.parametrize(("visible", "expected"), [(True, 5.0), (False, np.nan)])
def test_position_error_sees_hidden_poses_and_wrong_positions(visible, expected):
    observation = {
        "object_position": np.array([[0.103, 0.204]]),
        "object_position_true": np.array([[0.1, 0.2]]),
        "object_visible": np.array([visible]),
    }
    assert load_benchmark().millimetres(observation) == pytest.approx(expected, abs=1e-6, nan_ok=True)


def test_finer_masks_are_sampled_at_the_size_of_the_images(env):
    with closing(Reacher(mask_scale=3, privileged=True)) as fine:
        coarse, same = (one.reset(seed=5, options={"goal_position": GOAL})[0] for one in (env, fine))
    assert np.array_equal(same["pixels"], coarse["pixels"])
    assert np.array_equal(same["masks"], coarse["masks"])  # with an odd scale the samples are at the same places
    assert not np.array_equal(same["object_position"], coarse["object_position"])


# Virtual target.


def pictures(diameter: int, goal, seed: int = 17):
    """Observations of the same state without and with a virtual target."""
    plain, painted = Reacher(privileged=True), Reacher(virtual_target=diameter, privileged=True)
    both = [env.reset(seed=seed, options={"goal_position": goal})[0] for env in (plain, painted)]
    both += [env.step(np.ones(2))[0] for env in (plain, painted)]
    plain.close()
    painted.close()
    return both


def test_no_target_by_default(env):
    plain, drawn, *_ = pictures(0, GOAL)
    by_default, _ = env.reset(seed=17, options={"goal_position": GOAL})
    assert_same(plain, drawn)
    assert_same(plain, by_default)


def test_target_of_one_pixel_lies_at_the_goal():
    for goal in [(0.1, -0.12), (-0.2, 0.2), (0.24, 0.24)]:
        for plain, painted in zip(*[iter(pictures(1, goal))] * 2, strict=True):
            changed = (plain["pixels"] != painted["pixels"]).any(0)
            rows, columns = np.nonzero(changed)
            # Camera 74 cm above the finger's plane, 45 degrees over 64 pixels.
            focal = 32 / np.tan(np.deg2rad(22.5))
            assert columns.tolist() == [int(32 + focal * goal[0] / 0.74)]
            assert rows.tolist() == [int(32 - focal * goal[1] / 0.74)]


@pytest.mark.parametrize("diameter", [6, 10, 16])
def test_area_of_the_target(diameter):
    plain, painted, *_ = pictures(diameter, (-0.1, 0.12))
    assert not (plain["masks"][0] & (plain["pixels"] != painted["pixels"]).any(0)).any()
    changed = (plain["pixels"] != painted["pixels"]).any(0)
    assert changed.sum() == pytest.approx(np.pi * diameter**2 / 4, rel=0.1)
    rows, columns = np.nonzero(changed)
    focal = 32 / np.tan(np.deg2rad(22.5))
    assert columns.mean() + 0.5 == pytest.approx(32 - focal * 0.1 / 0.74, abs=0.5)
    assert rows.mean() + 0.5 == pytest.approx(32 - focal * 0.12 / 0.74, abs=0.5)


# Goal observations.


@pytest.mark.parametrize(("goal", "distance"), [((0.24, 0.24), 0.24), ((0.02, 0.0), 0.24 * np.cos(np.deg2rad(80)))])
def test_goal_observation_of_an_unreachable_goal_is_the_nearest(env, goal, distance):
    env.reset(seed=18)
    position = env.goal_observation(goal)["object_position_true"][0]
    assert position == pytest.approx(distance * np.array(goal) / np.linalg.norm(goal), abs=1e-6)


# Bad input.


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ((0.3, 0.0), "lies outside the workspace"),
        ((0.1, 0.1, 0.1), "has 2 coordinates, got shape"),
        (((0.1, 0.1), (0.0, 0.0)), r"one goal position of shape \(2,\) is needed, got \(2, 2\)"),
        ((float("nan"), 0.0), "must be finite"),
    ],
)
def test_bad_goals(env, goal, message):
    with pytest.raises(ValueError, match=message):
        env.reset(options={"goal_position": goal})
    with pytest.raises(ValueError, match=message):
        env.goal_observation(goal)


def test_unknown_reset_option(env):
    with pytest.raises(ValueError, match=r"unknown reset options \['target'\]; the only one is 'goal_position'"):
        env.reset(options={"target": GOAL})


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(3), r"has shape \(2,\), got \(3,\)"),
        (np.zeros((1, 2)), r"has shape \(2,\), got \(1, 2\)"),
        (np.array([0.0, np.nan]), "must be finite"),
        (np.array([np.inf, 0.0]), "must be finite"),
    ],
)
def test_bad_actions(env, action, message):
    env.reset(seed=20)
    before = env.data.qpos.copy()
    with pytest.raises(ValueError, match=message):
        env.step(action)
    assert np.array_equal(env.data.qpos, before)


@pytest.mark.parametrize("name", ["image_size", "horizon", "action_repeat", "mask_scale"])
@pytest.mark.parametrize("value", [0, -1])
def test_sizes_below_one(name, value):
    with pytest.raises(ValueError, match=f"{name} must be at least 1, got {value}"):
        Reacher(**{name: value})


def test_negative_target():
    with pytest.raises(ValueError, match="virtual_target must be 0 or more, got -1"):
        Reacher(virtual_target=-1)


def test_positions_at_points_of_the_image_in_closed_form() -> None:
    """The camera looks straight down from the middle, over 75 cm, with MuJoCo's default view of 45 degrees."""
    with closing(Reacher()) as env:
        fovy, height = env.model.cam_fovy[env.camera.camera_id], 0.75 - 0.01
        half = height * np.tan(np.deg2rad(fovy) / 2)  # metres from the middle to the edge of the image
        assert env.unproject([[32, 32], [48, 32], [32, 48]]) == pytest.approx(
            np.array([[0, 0], [half / 2, 0], [0, -half / 2]]), abs=1e-6
        )


def test_a_point_where_there_is_no_plane() -> None:
    with closing(Reacher()) as env:
        env.data.cam_xmat[env.camera.camera_id] = np.diag([1, -1, -1]).ravel()  # it looks up
        with pytest.raises(ValueError, match=r"does not see the plane of the goals at \[32.0, 32.0\]"):
            env.unproject([32, 32])


def test_three_axes_lie_in_a_horizontal_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(Reacher()) as env:
        monkeypatch.setattr(env, "_axes", [0, 1, 2])
        assert env.unproject(env.project(np.array([0.1, -0.05, 0.2])), height=0.2) == pytest.approx(
            np.array([0.1, -0.05, 0.2]), abs=1e-5
        )
