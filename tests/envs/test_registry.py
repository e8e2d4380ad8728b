"""make_env and make_task: names, seeds, goals, several processes, and what is said when a simulator is missing."""

import re
import subprocess
import sys
from contextlib import closing
from functools import partial

import gymnasium
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_ocwm.envs import (
    ENVIRONMENTS,
    Reacher,
    Task,
    find_environment,
    make_env,
    make_task,
    register_environment,
    registry,
)


@pytest.fixture(scope="module")
def env():
    env = make_env("reacher", horizon=4)
    yield env
    env.close()


@pytest.fixture(scope="module")
def pair():
    env = make_env("reacher", num_envs=2, seed=0, image_size=16, horizon=5)
    yield env
    env.close()


@pytest.mark.filterwarnings("ignore")
def test_torchrl_specs(env):
    check_env_specs(env)


def test_every_environment_is_registered_with_gymnasium():
    for environment in ENVIRONMENTS.values():
        assert gymnasium.spec(environment.id).entry_point == environment.entry_point


def test_keys_of_a_rollout(env):
    rollout = env.rollout(10, break_when_any_done=True)
    assert rollout.batch_size == (4,)
    shapes = {key: (value.shape[1:], value.dtype) for key, value in rollout["next"].items()}
    assert shapes == {
        "pixels": ((3, 64, 64), torch.uint8),
        "masks": ((1, 64, 64), torch.bool),
        "proprio": ((5,), torch.float32),
        "object_position": ((1, 2), torch.float32),
        "object_visible": ((1,), torch.bool),
        "goal_position": ((2,), torch.float32),
        "success": ((1,), torch.bool),
        "is_init": ((1,), torch.bool),
        "reward": ((1,), torch.float32),
        "done": ((1,), torch.bool),
        "terminated": ((1,), torch.bool),
        "truncated": ((1,), torch.bool),
    }
    assert rollout["is_init"].flatten().tolist() == [True, False, False, False]
    assert rollout["next", "truncated"].flatten().tolist() == [False, False, False, True]
    assert not rollout["next", "terminated"].any()


def test_goal_at_reset(env):
    goal = torch.tensor([0.12, -0.03])
    first = env.reset(options={"goal_position": goal.numpy()})
    assert torch.equal(first["goal_position"], goal)
    rollout = env.rollout(3, auto_reset=False, tensordict=first)
    assert torch.equal(rollout["next", "goal_position"], goal.expand(3, 2))
    distance = (rollout["next", "object_position"][:, 0] - goal).norm(dim=-1, keepdim=True)
    assert torch.allclose(rollout["next", "reward"], -distance, atol=1e-6)


def test_goal_in_the_tensordict_given_to_reset(env):
    goal = torch.tensor([0.12, -0.03])
    drawn = env.reset(seed=3)
    first = env.reset(TensorDict({"goal_position": goal}), seed=3)
    assert torch.equal(first["goal_position"], goal)
    assert torch.equal(first["proprio"], drawn["proprio"])
    rollout = env.rollout(10, auto_reset=False, tensordict=first, break_when_any_done=False)
    assert torch.equal(rollout["goal_position"][:4], goal.expand(4, 2))
    assert not (rollout["goal_position"][4:] == goal).any()  # the next episodes draw their own
    options = {"goal_position": (0.05, 0.05)}
    assert env.reset(first, options=options)["goal_position"].tolist() == pytest.approx([0.05, 0.05])


@pytest.mark.parametrize(
    ("goal", "message"),
    [([0.3, 0.0], "outside the workspace"), ([float("nan"), 0.0], "must be finite"), ([0.1], "has 2 coordinates")],
)
def test_goal_in_a_tensordict_is_checked(env, goal, message):
    with pytest.raises(ValueError, match=message):
        env.reset(TensorDict({"goal_position": torch.tensor(goal)}))


def test_goals_in_a_tensordict_for_environments_side_by_side(pair):
    goals = torch.tensor([[0.1, 0.05], [-0.2, 0.0]])
    with closing(SerialEnv(2, partial(make_env, "reacher", image_size=16))) as serial:
        for env in (serial, pair):
            first = env.reset(TensorDict({"goal_position": goals}, [2]))
            assert torch.equal(first["goal_position"], goals)
            # One is done: its next episode has another goal, while the other keeps its own.
            first["_reset"] = torch.tensor([[True], [False]])
            again = env.reset(first.select("_reset"))
            assert not torch.equal(again["goal_position"][0], goals[0])


def test_seeds_side_by_side(env, pair):
    """What an episode looks like does not depend on the process it runs in."""
    for seeds in ((31, 32), (32, 31)):
        starts = pair.reset(list_of_kwargs=[{"seed": seed, "options": {"goal_position": (0.1, 0.1)}} for seed in seeds])
        for start, seed in zip(starts, seeds, strict=True):
            assert torch.equal(start["proprio"], env.reset(seed=seed)["proprio"])
            assert start["goal_position"].tolist() == pytest.approx([0.1, 0.1])


def test_gymnasium_finds_the_environments_by_module():
    """Nothing of ours is imported before; dm_control's own renderer, which may not work here, is not loaded."""
    make = "gymnasium.make('torchrl_ocwm.envs:ocwm/Reacher-v0').action_space.shape"
    code = f"import gymnasium, sys; print({make}, 'dm_control.mujoco' in sys.modules)"
    done = subprocess.run([sys.executable, "-W", "error::UserWarning", "-c", code], capture_output=True, text=True)
    assert done.stdout == "(2,) False\n", done.stderr


def test_true_positions_are_privileged():
    with closing(make_env("reacher", privileged=True, image_size=16)) as env:
        assert env.rollout(2)["next", "object_position_true"].shape == (2, 1, 2)
    assert make_task("reacher", privileged=True) == make_task("reacher")


def test_seed_repeats_a_rollout(env):
    rollouts = []
    for _ in range(2):
        env.set_seed(7)
        torch.manual_seed(0)
        rollouts.append(env.rollout(4))
    assert (rollouts[0] == rollouts[1]).all()


def test_seed_argument():
    starts = []
    for seed in (1, 1, 2):
        env = make_env("ocwm/Reacher-v0", seed=seed, image_size=16)
        assert isinstance(env, TransformedEnv)
        starts.append(env.reset()["proprio"])
        env.close()
    assert torch.equal(starts[0], starts[1])
    assert not torch.equal(starts[0], starts[2])


def test_two_processes(pair):
    assert isinstance(pair, ParallelEnv)
    rollout = pair.rollout(5)
    assert rollout.batch_size == (2, 5)
    assert rollout["next", "pixels"].shape == (2, 5, 3, 16, 16)
    assert rollout["next", "done"][:, -1].all()
    # Seeded differently.
    assert not torch.equal(rollout["proprio"][0, 0], rollout["proprio"][1, 0])


def test_two_processes_share_a_goal(pair):
    goal = torch.tensor([0.1, 0.05])
    assert torch.equal(pair.reset(options={"goal_position": goal.numpy()})["goal_position"], goal.expand(2, 2))


def test_two_processes_with_a_goal_each(pair):
    goals = torch.tensor([[0.1, 0.05], [-0.2, 0.0]])
    first = pair.reset(list_of_kwargs=[{"options": {"goal_position": goal.numpy()}} for goal in goals])
    assert torch.equal(first["goal_position"], goals)
    rollout = pair.rollout(3, auto_reset=False, tensordict=first)
    assert torch.equal(rollout["next", "goal_position"], goals[:, None].expand(2, 3, 2))


def test_two_processes_repeat_with_their_seed(pair):
    starts = []
    for _ in range(2):
        pair.set_seed(3)
        starts.append(pair.reset()["proprio"].clone())
    assert torch.equal(*starts)


def test_task_describes_the_environment():
    task = make_task("reacher", image_size=32, virtual_target=3, horizon=9)
    assert task == Task(
        name="reacher",
        image_size=32,
        objects=("finger",),
        proprio=5,
        action=2,
        workspace=Reacher.workspace,
        options={"image_size": 32, "virtual_target": 3},
    )


@pytest.mark.parametrize("make", [make_env, make_task])
def test_unknown_name_lists_the_others(make):
    with pytest.raises(ValueError, match=r"unknown environment 'reach'; there are reacher"):
        make("reach")


@pytest.mark.parametrize("make", [make_env, make_task])
@pytest.mark.parametrize("missing", ["gymnasium", "mujoco", "dm_control"])
def test_missing_simulator_says_what_to_install(monkeypatch, make, missing):
    monkeypatch.setattr(registry, "find_spec", lambda name: None if name == missing else True)
    with pytest.raises(
        ModuleNotFoundError, match=rf"'reacher' needs {missing}.*pip install 'torchrl-ocwm\[dm-control\]"
    ):
        make("reacher")


class Other:
    """Not an environment, but a class."""


@pytest.mark.usefixtures("registries")
def test_registering():
    made = register_environment("push_far", "somewhere:Else", modules=("not_there",))
    assert (made.id, find_environment("ocwm/PushFar-v0"), ENVIRONMENTS["push_far"]) == ("ocwm/PushFar-v0", made, made)
    assert gymnasium.spec("ocwm/PushFar-v0").entry_point == "somewhere:Else"
    assert register_environment("push_far", "somewhere:Else").modules == ()
    with pytest.raises(ModuleNotFoundError, match="No module named 'somewhere'"):
        make_env("push_far")
    register_environment("other", Other)
    assert gymnasium.spec("ocwm/Other-v0").entry_point is Other
    anew = type("Other", (), {"__module__": __name__})  # a cell of a notebook that is run again
    register_environment("other", anew)
    assert gymnasium.spec("ocwm/Other-v0").entry_point is anew


@pytest.mark.usefixtures("registries")
def test_what_a_registered_environment_needs():
    register_environment("far", "somewhere:Else", modules=("not_there",))
    with pytest.raises(
        ModuleNotFoundError, match="'far' needs not_there, which is not installed: pip install not_there"
    ):
        make_task("far")


@pytest.mark.parametrize(
    ("name", "entry_point", "message"),
    [
        ("Reacher", "a:B", "a name like 'cube_move', got 'Reacher'"),
        ("reacher2 ", "a:B", "a name like 'cube_move'"),
        ("far", "a.B", "must be a class or 'module:Class', got 'a.B'"),
        ("far", "os.system('a'):B", "must be a class or 'module:Class'"),
        ("reacher", "a:B", "'reacher' is registered already, as torchrl_ocwm.envs.reacher:Reacher"),
    ],
)
def test_what_cannot_be_registered(name, entry_point, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        register_environment(name, entry_point)


def test_number_of_environments():
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        make_env("reacher", num_envs=0)


def test_options_reach_the_environment():
    with pytest.raises(ValueError, match="horizon must be at least 1, got 0"):
        make_env("reacher", horizon=0)
