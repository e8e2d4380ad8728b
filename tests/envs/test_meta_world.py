"""Shelf place and Pick & place: Meta-World's physics, positions from depth, goals in the air, the scripted policy."""

import warnings

import mujoco
import numpy as np
import pytest
from metaworld.envs.sawyer_pick_place_v3 import SawyerPickPlaceEnvV3
from metaworld.envs.sawyer_shelf_place_v3 import SawyerShelfPlaceEnvV3
from observations import actions, error

from torchrl_ocwm.envs import PickPlace, ShelfPlace

CLASSES = {"shelf_place": ShelfPlace, "pick_place": PickPlace}
GOAL = np.array([0.1, 0.12], np.float32)
STILL = np.array([0.0, 0.0, 0.0, -1.0])
EYE = np.array([0.9, 0.0, 0.9])
# The middle of the workspace, which the camera looks at, and its view, degrees.
VIEWS = {"shelf_place": ((-0.025, 0.6, 0.17), 38), "pick_place": ((0.0, 0.6, 0.095), 26)}


@pytest.fixture(scope="module", params=CLASSES)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def env(name):
    env = CLASSES[name](privileged=True)
    yield env
    env.close()


@pytest.fixture
def small(name):
    """Small images, for tests of the physics."""
    env = CLASSES[name](image_size=8, privileged=True)
    yield env
    env.close()


def pixel(name: str, point) -> tuple[float, float]:
    """Column and row at which a point in the world is seen, by hand."""
    middle, view = VIEWS[name]
    forward = (middle - EYE) / np.linalg.norm(middle - EYE)
    right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
    down = np.cross(forward, right)
    ray, focal = np.array(point) - EYE, 32 / np.tan(np.deg2rad(view / 2))
    return 32 + focal * (ray @ right) / (ray @ forward), 32 + focal * (ray @ down) / (ray @ forward)


def with_object_at(env, x: float, y: float, z: float):
    """What is seen with the object put somewhere, the arm where it is."""
    env.data.qpos[9:16] = x, y, z, 1, 0, 0, 0
    mujoco.mj_forward(env.model, env.data)
    return env._observe(env.data)


# The data contract.


def test_proprio_and_true_position_are_the_simulators(env):
    env.reset(seed=1)
    for _ in range(6):
        observation, *_ = env.step(np.array([0.5, 0.0, 0.2, 1.0]))
    data = env.data
    hand, opening, velocity = np.split(observation["proprio"], [3, 4])
    assert hand == pytest.approx(env._suite.get_endeff_pos() - [0, 0.6, 0.02], abs=1e-6)
    # Each claw slides 5 cm from the middle, along y.
    assert opening == pytest.approx(0.1 - data.qpos[7] + data.qpos[8], abs=1e-4)
    assert observation["object_position_true"][0] == pytest.approx(data.body("obj").xpos[[0, 2]] - [0, 0.02], abs=1e-6)
    before = data.body("hand").xpos.copy()
    env.step(np.array([0.5, 0.0, 0.2, 1.0]))
    assert velocity == pytest.approx((data.body("hand").xpos - before) / 0.025, abs=0.03)
    assert velocity[0] > 0.3


def test_the_object_is_where_the_camera_must_see_it(env, name):
    env.reset(seed=2)
    low, high = env.workspace.low, env.workspace.high
    # The arm's start pose hides places higher on the left. No arm is in the way there once it carries the object.
    for x, z in [(low[0], 0.0), (low[0], 0.15), (high[0], 0.0), (high[0], high[1])]:
        observation = with_object_at(env, x, 0.6, z + 0.02)
        mask = observation["masks"][0]
        assert mask.sum() > 7
        red, green, blue = observation["pixels"][:, mask].astype(int)
        assert ((blue if name == "shelf_place" else red) > 2 * green).all()
        rows, columns = np.nonzero(mask)
        column, row = pixel(name, (x, 0.6, z + 0.02))
        assert columns.mean() + 0.5 == pytest.approx(column, abs=0.6)
        assert rows.mean() + 0.5 == pytest.approx(row, abs=0.6)


def test_images_are_upright(env, name):
    env.reset(seed=2)
    low, high = (np.nonzero(with_object_at(env, -0.2, 0.6, z)["masks"][0])[0].mean() for z in (0.02, 0.17))
    assert high < low - 5


def test_nothing_of_meta_worlds_own_marks_in_the_picture(env):
    env.reset(seed=0)
    assert not env.model.site_rgba[:, 3].any()
    seen = np.unique(env.camera.render(env.data).geoms)
    assert (env.model.geom_group[seen[seen >= 0]] <= 1).all()


# Physics and time.


@pytest.mark.parametrize("repeat", [1, 2])
def test_starts_and_physics_are_those_of_meta_world(name, repeat):
    """Beside an environment of Meta-World with its own reset and step, and the same place of the object."""
    original = {"shelf_place": SawyerShelfPlaceEnvV3, "pick_place": SawyerPickPlaceEnvV3}[name]()
    env = CLASSES[name](action_repeat=repeat, image_size=8)
    env.reset(seed=7)
    goal = {"shelf_place": (0.0, 0.85, 0.3), "pick_place": (0.1, 0.8, 0.2)}[name]
    original._last_rand_vec = np.array([*env.data.qpos[9:11], 0.02, *goal])
    original._set_task_called = True
    original.reset()
    assert np.array_equal(env.data.qpos, original.data.qpos)
    for action in actions(env, 10):
        env.step(action)
        for _ in range(repeat):
            original.step(action)
        assert np.array_equal(env.data.qpos, original.data.qpos)
        assert np.array_equal(env.data.qvel, original.data.qvel)
    env.close()


def test_start_states_come_from_the_environments_own_random_numbers(small):
    small.reset(seed=0)
    state = np.random.get_state()[1].copy()  # Meta-World's own resets draw from it
    starts = np.stack([small.reset() and small.data.body("obj").xpos.copy() for _ in range(20)])
    assert np.array_equal(np.random.get_state()[1], state)
    assert (np.abs(starts[:, :2] - [0, 0.6]) <= 0.02).all()
    assert (np.ptp(starts[:, :2], axis=0) > 0.02).all()
    assert starts[:, 2] == pytest.approx(0.02, abs=1e-3)


def test_actions_move_the_hand(small):
    for axis in range(3):
        for sign in (-1, 1):
            before, _ = small.reset(seed=4)
            action = STILL.copy()
            action[axis] = sign
            for _ in range(4):
                after, *_ = small.step(action)
            moved = after["proprio"][:3] - before["proprio"][:3]
            assert sign * moved[axis] > 0.04
            assert np.abs(np.delete(moved, axis)).max() < 0.02


def test_the_gripper_opens_and_closes(small):
    small.reset(seed=4)
    openings = []
    for gripper in (-1, 1):
        for _ in range(15):
            observation, *_ = small.step(np.array([0, 0, 0, gripper]))
        openings.append(observation["proprio"][3])
    assert openings[0] == pytest.approx(0.1, abs=0.005)
    assert openings[1] < 0.05


def test_episodes_are_longer_than_meta_worlds(small):
    small.reset(seed=0)
    for step in range(1, 252):  # Meta-World stops at 500 control steps
        *_, terminated, truncated, _ = small.step(STILL)
        assert not terminated
        assert truncated == (step >= 250)


# Positions from masks.


def test_position_error_over_random_places(env):
    """Measured over 200 places: median 2.1 mm (Shelf place) and 1.5 mm, 95th percentile 9.8 and 6.8 mm."""
    env.reset(seed=12)
    random = np.random.default_rng(0)
    errors = []
    for x, z in random.uniform(env.workspace.low, env.workspace.high, (50, 2)):
        observation = with_object_at(env, x, random.uniform(0.55, 0.65), z + 0.02)
        if observation["object_visible"][0]:
            errors.append(error(observation))
    assert len(errors) > 40  # the hand hides some places above the start
    assert np.median(errors) < 3.5
    assert np.percentile(errors, 95) < 15


def test_virtual_target_lies_at_the_goal(env, name, monkeypatch):
    start = {"seed": 17, "options": {"goal_position": (-0.12, 0.1)}}
    plain, _ = env.reset(**start)
    monkeypatch.setattr(env, "virtual_target", 6)
    painted, _ = env.reset(**start)
    rows, columns = np.nonzero((plain["pixels"] != painted["pixels"]).any(0))
    column, row = pixel(name, (-0.12, 0.6, 0.12))
    assert len(rows) == pytest.approx(np.pi * 9, rel=0.2)
    assert columns.mean() + 0.5 == pytest.approx(column, abs=0.5)
    assert rows.mean() + 0.5 == pytest.approx(row, abs=0.5)


# Goal observations.


def test_goal_observation_shows_the_object_in_the_closed_gripper(env):
    env.reset(seed=18)
    low, high = env.workspace.low, env.workspace.high
    corners = [(x, z) for x in (low[0], high[0]) for z in (low[1], high[1])]
    for goal in [*env.workspace.grid(3).flatten(0, 1).tolist(), *corners]:
        hand, opening, _ = np.split(env.goal_observation(goal)["proprio"], [3, 4])
        assert hand == pytest.approx([goal[0], 0, goal[1] + 0.036], abs=0.01)  # around the object, from above
        assert opening < 0.06


# The scripted policy.


def test_scripted_policy_reaches_the_goals(small):
    """Also at the corners: all of the workspace can be reached. Measured at 64 x 64: 30 of 30 uniform goals."""
    low, high = small.workspace.low, small.workspace.high
    corners = [(x, z) for x in (low[0], high[0]) for z in (low[1], high[1])]
    for goal in [*corners, *small.workspace.grid(2).flatten(0, 1).tolist()]:
        small.reset(options={"goal_position": goal})
        for _ in range(60):
            action = small.scripted_action()
            assert action.shape == (4,)
            assert np.abs(action).max() <= 1
            observation, *_ = small.step(action)
        assert observation["object_position_true"][0] == pytest.approx(np.array(goal), abs=0.01)


def test_scripted_policy_heeds_the_goal_and_says_nothing(small):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        moves = []
        for x in (-0.15, 0.15):
            small.reset(seed=1, options={"goal_position": (x, 0.1)})
            for _ in range(20):
                observation, *_ = small.step(small.scripted_action())
            moves.append(observation["object_position_true"][0, 0])
    assert moves[0] < -0.03
    assert moves[1] > 0.03


def test_positions_while_the_arm_carries_the_object(env):
    """Measured over 30 episodes: median 5.0 mm, 95th percentile 8.8 mm (Shelf place) and 7.3 mm."""
    observation, _ = env.reset(seed=3, options={"goal_position": GOAL})
    errors = [error(observation)]
    for _ in range(40):
        observation, *_ = env.step(env.scripted_action())
        assert observation["object_visible"].tolist() == [True]
        errors.append(error(observation))
    assert np.median(errors) < 8
    assert max(errors) < 15
