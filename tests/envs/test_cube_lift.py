"""The Cube lift environment: goals and positions with a height, and what is seen of a cube in the hand."""

from collections.abc import Iterator
from itertools import product

import mujoco
import numpy as np
import pytest
from observations import error

from torchrl_ocwm.envs import CubeLift, make_task

# The camera of robosuite, moved: it looks 45 degrees down, with a view of 45 degrees over 64 pixels.
START = np.array([0.0, 0.0, 0.82])
EYE, FOCAL = np.array([0.7, 0.0, 1.75]), 32 / np.tan(np.deg2rad(22.5))
FORWARD, RIGHT, DOWN = np.array([[-1, 0, -1], [0, 2**0.5, 0], [1, 0, -1]]) / 2**0.5


@pytest.fixture(scope="module")
def env() -> Iterator[CubeLift]:
    env = CubeLift(privileged=True)
    yield env
    env.close()


def pixel(position: np.ndarray) -> tuple[float, float]:
    """Column and row at which a position is seen, by hand."""
    ray = position + START - EYE
    return 32 + FOCAL * (ray @ RIGHT) / (ray @ FORWARD), 32 + FOCAL * (ray @ DOWN) / (ray @ FORWARD)


def test_positions_have_the_height_above_the_start(env: CubeLift) -> None:
    env.reset(seed=1)
    observation = env.move_object((0.1, -0.1, 0.15))
    middle = env.data.xpos[env._suite.cube_body_id] - START
    assert observation["object_position_true"][0] == pytest.approx(middle, abs=1e-6)
    assert middle == pytest.approx(np.array([0.1, -0.1, 0.15]), abs=1e-6)


def test_a_moved_cube_is_at_rest(env: CubeLift) -> None:
    env.reset(seed=1)
    speed = env.model.joint("cube_joint0").dofadr[0]
    env.data.qvel[speed : speed + 6] = 1.0
    env.move_object((0.1, -0.1, 0.15))
    assert not env.data.qvel[speed : speed + 6].any()


def test_position_error_of_a_free_cube(env: CubeLift) -> None:
    """Measured over 57 poses: median 0.7 mm, 95th percentile 1.5 mm."""
    env.reset(seed=12)
    random, address = np.random.default_rng(0), env.model.joint("cube_joint0").qposadr[0]
    errors = []
    for place in random.uniform([0.0, -0.2, 0.0], env.workspace.high, (20, 3)):  # before the arm
        turn = random.uniform(0, np.pi)
        env.data.qpos[address : address + 7] = *(place + START), np.cos(turn), 0, 0, np.sin(turn)
        mujoco.mj_forward(env.model, env.data)
        errors.append(error(env._observe(env.data)))
    assert np.median(errors) < 1.5
    assert max(errors) < 5


def test_the_virtual_target_is_drawn_at_its_height(env: CubeLift, monkeypatch: pytest.MonkeyPatch) -> None:
    goal = np.array([0.1, 0.15, 0.18])  # away from the arm
    start = {"seed": 17, "options": {"goal_position": goal}}
    plain, _ = env.reset(**start)
    monkeypatch.setattr(env, "virtual_target", 6)
    painted, _ = env.reset(**start)
    rows, columns = np.nonzero((plain["pixels"] != painted["pixels"]).any(0))
    assert len(rows) == pytest.approx(np.pi * 9, rel=0.2)
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx(pixel(goal), abs=0.5)
    assert pixel(goal)[1] < pixel(goal * [1, 1, 0])[1] - 4


def test_goal_observations_show_the_cube_in_the_hand(env: CubeLift) -> None:
    env.reset(seed=18)
    env.goal_observation(np.array([0.0, 0.0, 0.1]))
    upright = env._scratch.site_xmat[env._gripper].copy()
    assert upright[8] < -0.99  # it points down
    for goal in product(*np.transpose([env.workspace.low, env.workspace.high])):
        env.goal_observation(np.array(goal))
        data = env._scratch
        assert data.site_xpos[env._gripper] - env._start == pytest.approx(np.array(goal), abs=1e-4)
        assert data.site_xmat[env._gripper] == pytest.approx(upright, abs=1e-3)
        gap = data.qpos[env._fingers] @ [1, -1]
        assert gap == pytest.approx(2 * env.model.geom("cube_g0_vis").size[1], abs=0.005)
        angles, limits = data.qpos[env._arm], env.model.jnt_range[env.model.dof_jntid[env._arm_velocity]]
        assert (angles > limits[:, 0]).all()
        assert (angles < limits[:, 1]).all()


@pytest.mark.slow
def test_the_script_reaches_the_upper_corners() -> None:
    """The landmarks are in test_scripted.py."""
    env = CubeLift(image_size=8)
    env.blind = True  # it looks at nothing
    for seed, goal in enumerate(product((-0.2, 0.2), (-0.2, 0.2), (0.2,))):
        env.reset(seed=seed, options={"goal_position": goal})
        for _ in range(25):
            env.step(env.scripted_action())
        assert env.true_position()[0] == pytest.approx(np.array(goal), abs=0.02)
    env.close()


def test_a_distractor() -> None:
    task = make_task("cube_lift", objects=["cube", "distractor"], image_size=16)
    assert (task.objects, task.workspace.dim) == (("cube", "distractor"), 3)
