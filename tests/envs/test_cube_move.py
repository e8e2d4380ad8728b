"""The Cube move environment: robosuite's physics, positions from depth, goals, a second cube."""

import json
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from gymnasium.utils.seeding import np_random
from observations import actions, assert_same, error
from robosuite.controllers import load_composite_controller_config, load_part_controller_config
from robosuite.environments.manipulation.lift import Lift

from torchrl_ocwm.envs import CubeMove, Task, make_task

GOAL = np.array([0.1, -0.12], np.float32)
STILL = np.array([0.0, 0.0, 0.0, -1.0])
# The camera: agentview, moved; it looks 45 degrees down, with a view of 45 degrees over 64 pixels.
EYE, FOCAL = np.array([0.7, 0.0, 1.75]), 32 / np.tan(np.deg2rad(22.5))
FORWARD, RIGHT, DOWN = np.array([[-1, 0, -1], [0, 2**0.5, 0], [1, 0, -1]]) / 2**0.5


@pytest.fixture(scope="module")
def env():
    env = CubeMove(privileged=True)
    yield env
    env.close()


@pytest.fixture(scope="module")
def pair():
    env = CubeMove(objects=("cube", "distractor"), privileged=True)
    yield env
    env.close()


def pixel(x: float, y: float, z: float) -> tuple[float, float]:
    """Column and row at which a point in the world is seen, by hand."""
    ray = np.array([x, y, z]) - EYE
    return 32 + FOCAL * (ray @ RIGHT) / (ray @ FORWARD), 32 + FOCAL * (ray @ DOWN) / (ray @ FORWARD)


def with_cube_at(env: CubeMove, x: float, y: float, z: float, turn: float = 0.0):
    """What is seen with the cube put somewhere."""
    address = env.model.joint("cube_joint0").qposadr[0]
    env.data.qpos[address : address + 7] = x, y, z, np.cos(turn / 2), 0, 0, np.sin(turn / 2)
    mujoco.mj_forward(env.model, env.data)
    return env._observe(env.data)


def move_to(env: CubeMove, observation, target, steps: int):
    """Move the closed gripper towards a place relative to the start."""
    for _ in range(steps):
        move = ((np.array(target) - observation["proprio"][-3:]) / 0.05).clip(-1, 1)
        observation, *_ = env.step(np.append(move, 1.0))
    return observation


# The data contract.


def test_proprio_and_true_position_are_robosuites_own(env):
    env.reset(seed=1)
    observation, *_ = env.step(np.ones(4))
    suite, data = env._suite, env.data
    mujoco.mj_forward(env.model, data)
    robot = suite.robots[0]
    fingers = data.qpos[robot._ref_gripper_joint_pos_indexes["right"]]
    gripper = data.site_xpos[robot.eef_site_id["right"]] - [0, 0, 0.82]
    expected = np.concatenate([robot._joint_positions, robot._joint_velocities, fingers, gripper])
    assert observation["proprio"] == pytest.approx(expected, abs=1e-6)
    assert observation["object_position_true"][0] == pytest.approx(data.xpos[suite.cube_body_id][:2], abs=1e-6)


def test_the_cube_is_red_and_where_the_camera_must_see_it(env):
    env.reset(seed=2)
    for x, y in [(0, 0), (0.25, 0.25), (-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25)]:
        observation = with_cube_at(env, x, y, 0.82, turn=0.4)
        mask = observation["masks"][0]
        red, green, blue = observation["pixels"][:, mask].astype(int)
        assert (red > 1.5 * green).all()
        assert (red > 1.5 * blue).all()
        rows, columns = np.nonzero(mask)
        column, row = pixel(x, y, 0.82)
        assert columns.mean() + 0.5 == pytest.approx(column, abs=0.6)
        assert rows.mean() + 0.5 == pytest.approx(row, abs=0.6)


def test_nothing_of_robosuites_own_marks_in_the_picture(env):
    env.reset(seed=0)
    assert (env.model.site_rgba[:, 3] <= 0).all()
    seen = np.unique(env.camera.render(env.data).geoms)
    assert (env.model.geom_group[seen[seen >= 0]] == 1).all()


# Physics and time.


@pytest.mark.slow
@pytest.mark.parametrize("repeat", [1, 2])
def test_starts_and_physics_are_those_of_robosuite(repeat):
    """Beside an environment of robosuite with its own loop and observations, and the same random numbers."""
    controller = load_composite_controller_config(robot="Panda")
    gripper = controller["body_parts"]["right"]["gripper"]
    controller["body_parts"]["right"] = load_part_controller_config(default_controller="OSC_POSITION")
    controller["body_parts"]["right"]["gripper"] = gripper
    original = Lift(
        robots="Panda",
        controller_configs=controller,
        use_camera_obs=False,
        has_offscreen_renderer=False,
        hard_reset=False,
        control_freq=20,
        seed=0,
    )
    env = CubeMove(action_repeat=repeat, image_size=8)
    env.reset(seed=7)
    original.rng, _ = np_random(7)
    original.placement_initializer.rng = original.rng
    original.rng.uniform(size=2)  # the goal
    original.reset()
    assert np.array_equal(env.data.qpos, original.sim.data.qpos)
    for action in actions(env, 8):
        env.step(action)
        for _ in range(repeat):
            original.step(action)
        assert np.array_equal(env.data.qpos, original.sim.data.qpos)
        assert np.array_equal(env.data.qvel, original.sim.data.qvel)
    env.close()


def test_a_state_reserves_little_memory(env):
    """With robosuite's own limits it is 1.2 GB; twenty environments then leave no room for another process."""
    assert env.model.narena == 64 * 2**20


def test_start_states(env):
    env.reset(seed=0)
    starts = np.stack([env.reset()[0]["object_position_true"][0] for _ in range(20)])
    assert (np.abs(starts) <= 0.03).all()
    assert (np.ptp(starts, axis=0) > 0.03).all()


def test_actions_move_the_gripper(env):
    for axis in range(3):
        for sign in (-1, 1):
            before, _ = env.reset(seed=4)
            action = STILL.copy()
            action[axis] = sign
            for _ in range(3):
                after, *_ = env.step(action)
            moved = after["proprio"][-3:] - before["proprio"][-3:]
            assert sign * moved[axis] > 0.05
            assert np.abs(np.delete(moved, axis)).max() < 0.03


def test_the_gripper_opens_and_closes(env):
    env.reset(seed=4)
    widths = []
    for gripper in (-1, 1):
        for _ in range(5):
            observation, *_ = env.step(np.array([0, 0, 0, gripper]))
        widths.append(observation["proprio"][14] - observation["proprio"][15])
    assert widths[0] == pytest.approx(0.08, abs=0.005)
    assert widths[1] < 0.02


def test_the_arm_pushes_the_cube(env):
    start, _ = env.reset(seed=5)
    x, y = start["object_position_true"][0]
    observation = move_to(env, start, (x - 0.1, y, 0.15), 4)
    observation = move_to(env, observation, (x - 0.1, y, 0.0), 5)
    observation = move_to(env, observation, (x + 0.1, y, 0.0), 7)
    moved = observation["object_position_true"][0] - start["object_position_true"][0]
    assert moved[0] > 0.06
    assert abs(moved[1]) < 0.04
    assert observation["object_visible"].tolist() == [True]
    assert error(observation) < 12  # the gripper hides a part of it


# Positions from masks.


def test_position_error_over_random_poses(env):
    """Measured over 300 poses: median 1.9 mm, 95th percentile 4.9 mm."""
    env.reset(seed=12)
    random = np.random.default_rng(0)
    poses = zip(random.uniform(-0.25, 0.25, (40, 2)), random.uniform(0, 2 * np.pi, 40), strict=True)
    errors = [error(with_cube_at(env, x, y, 0.82, turn)) for (x, y), turn in poses]
    assert np.median(errors) < 2.5
    assert np.percentile(errors, 95) < 6


@pytest.mark.parametrize("height", [0.87, 0.95, 1.0])
def test_position_of_a_cube_in_the_air(env, height):
    env.reset(seed=12)
    for x, y in [(0.0, 0.1), (-0.1, -0.2), (0.15, -0.15)]:
        assert error(with_cube_at(env, x, y, height, turn=0.5)) < 7


# Virtual target.


def test_virtual_target_lies_at_the_goal(env, monkeypatch):
    start = {"seed": 17, "options": {"goal_position": (-0.1, 0.12)}}
    plain, _ = env.reset(**start)
    monkeypatch.setattr(env, "virtual_target", 6)
    painted, _ = env.reset(**start)
    rows, columns = np.nonzero((plain["pixels"] != painted["pixels"]).any(0))
    column, row = pixel(-0.1, 0.12, 0.82)
    assert len(rows) == pytest.approx(np.pi * 9, rel=0.2)
    assert columns.mean() + 0.5 == pytest.approx(column, abs=0.5)
    assert rows.mean() + 0.5 == pytest.approx(row, abs=0.5)


# Goal observations.


def test_goal_observation_shows_the_arm_at_rest_and_the_cube_on_the_table(env):
    env.reset(seed=18)
    start = env.goal_observation((0.0, 0.0))
    for _ in range(3):
        env.step(np.array([1.0, 0.0, -1.0, 1.0]))  # the arm reaches over the table
    for goal in [(0.0, 0.0), (-0.25, -0.25), (0.25, 0.25)]:
        assert np.array_equal(env.goal_observation(goal)["proprio"], start["proprio"])
        height = env._scratch.geom_xpos[env.model.geom("cube_g0_vis").id, 2] - env.model.geom("cube_g0_vis").size[2]
        assert height == pytest.approx(0.8, abs=1e-6)


# A second cube.


def test_distractor_has_a_mask_and_a_position_of_its_own(pair):
    for seed in range(5):
        observation, _ = pair.reset(seed=seed)
        cube, distractor = observation["masks"]
        assert observation["masks"].shape == (2, 64, 64)
        assert observation["object_visible"].tolist() == [True, True]
        assert not (cube & distractor).any()
        red, _, blue = observation["pixels"][:, distractor].astype(int)
        assert (blue > 1.5 * red).all()
        true = observation["object_position_true"]
        assert np.linalg.norm(true[0] - true[1]) > 0.05
        assert (np.abs(true[1]) <= 0.15).all()
        assert max(error(observation, 0), error(observation, 1)) < 10
        offset = observation["object_position"][0] - observation["goal_position"]
        assert pair.step(STILL)[1] == pytest.approx(-np.hypot(*offset), abs=0.01)


def test_distractor_repeats_with_the_seed_and_stays_in_goal_observations(pair):
    first, _ = pair.reset(seed=3)
    other, _ = pair.reset()
    assert not np.array_equal(first["object_position_true"][1], other["object_position_true"][1])
    again, _ = pair.reset(seed=3)
    assert_same(first, again)
    goal = pair.goal_observation((0.2, -0.2))
    assert goal["object_position_true"][0] == pytest.approx([0.2, -0.2], abs=1e-6)
    assert np.array_equal(goal["object_position_true"][1], first["object_position_true"][1])


@pytest.mark.parametrize("objects", [(), ("distractor",), ("distractor", "cube"), ("cube", "ball")])
def test_unknown_objects(objects):
    with pytest.raises(ValueError, match=r"objects must be \('cube',\) or \('cube', 'distractor'\), got"):
        CubeMove(objects=objects)


# Names, resources and noise.


def test_task_with_a_distractor_through_json():
    task = make_task("cube_move", objects=["cube", "distractor"], image_size=16, horizon=9)
    assert task.objects == ("cube", "distractor")
    assert Task.from_dict(json.loads(json.dumps(task.to_dict()))) == task


@pytest.mark.slow
def test_robosuite_says_nothing_and_keeps_its_hands_off_the_environment():
    code = (
        "import os; from torchrl_ocwm.envs import CubeMove; env = CubeMove(image_size=8); env.reset(seed=0);"
        "env.close(); print(os.environ.get('MUJOCO_GL'))"
    )
    environment = {key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "DISPLAY")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert "robosuite" not in done.stderr
    assert done.stdout == "None\n"
