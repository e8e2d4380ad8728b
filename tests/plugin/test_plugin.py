"""Parts, rows and environments of another package, which is not installed but named in the environment variable."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from other_package import plugin  # noqa: F401
from torchrl.checkpoint import CheckpointError

from torchrl_ocwm import build_agent, load_agent, make_env, make_task
from torchrl_ocwm.agents import AGENTS, SIZES, Agent, Behaviour, collecting_policy, save_agent
from torchrl_ocwm.agents.checkpoint import describe, read_parts
from torchrl_ocwm.data import Collection, EpisodeDataset, collect
from torchrl_ocwm.envs import EnvChoice, find_environment, make_scene, registry
from torchrl_ocwm.errors import MissingPackageError
from torchrl_ocwm.evaluation import EvaluationEnvs
from torchrl_ocwm.parts import VARIABLE, load_plugins
from torchrl_ocwm.settings import SettingsError, change, to_dict
from torchrl_ocwm.testing import random_records, reacher_task

HERE, ROOT = Path(__file__).parent, Path(__file__).parents[2]


LOAD = """
import os, sys
from torchrl.checkpoint import CheckpointError
from torchrl_ocwm import load_agent
from torchrl_ocwm.parts import load_plugins

named = os.environ.pop("TORCHRL_OCWM_PLUGINS")
try:
    load_agent(sys.argv[1])
except CheckpointError as error:
    print(error)
os.environ["TORCHRL_OCWM_PLUGINS"] = named
load_plugins.cache_clear()
print(load_agent(sys.argv[1]).agent.config)
"""


def all_parts() -> Agent:
    """An agent with all parts of the other package."""
    config = change(
        AGENTS["dreamer_pcp"],
        {
            "world_model": "wide",
            "behaviours.reach.reward": {"name": "nearness", "width": 0.2},
            "behaviours.reach.goals": "remembered",
            "behaviours.explore": {"reward": "novelty"},
            "behaviours.point": {"goal": {"name": "waves", "number": 3}, "reward": "in_phase", "goals": "frames"},
        },
    )
    return build_agent(config, reacher_task(), change(SIZES["debug"], {"learning.optimizer": "sgd"}))


def example(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "examples" / script), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_row_by_its_name() -> None:
    """An unknown name loads the package."""
    agent = build_agent("nearness", reacher_task(), "debug")
    assert agent.loss(random_records(reacher_task(), 2, 3))["loss_actor"].isfinite()


def test_all_kinds_of_parts() -> None:
    agent = all_parts()
    assert agent.model.belief == 2 * SIZES["debug"].architecture.belief
    losses = agent.loss(random_records(reacher_task(), 2, 3))
    assert losses["loss_explore_novelty"] > 0
    rates = [group["lr"] for group in agent.parameter_groups()]
    assert rates.count(1e-2) == 1
    optimizer = agent.size.learning.optimizer.build(agent.parameter_groups())
    assert type(optimizer) is torch.optim.SGD
    guess = agent.behaviour("explore").loss.reward_loss.network.guess
    before = guess.weight.clone()
    losses["loss_explore_novelty"].backward()
    optimizer.step()
    assert not torch.equal(guess.weight, before)


def test_a_goal_of_positions_and_of_frames() -> None:
    point = all_parts().behaviour("point")
    place = torch.tensor([0.5, -0.25])
    angles = torch.tensor([0.5, 1.0, 1.5, -0.25, -0.5, -0.75])
    torch.testing.assert_close(point.goal.position(place), torch.cat([angles.sin(), angles.cos()]))
    assert point.goal.features == 12
    records = random_records(reacher_task(), 2, 3)
    agent = all_parts()
    frames = agent.model.records()(records)["next"]
    goals = agent.behaviour("point").loss.imagination_start(frames)["latent", "goal"]
    seen = agent.behaviour("point").goal.position(frames["object_units"].flatten(0, 1))
    assert torch.cdist(goals.flatten(0, -2), seen).min(1).values.max() < 1e-5
    assert agent.loss(records)["loss_point_actor"].isfinite()


def test_a_goal_source_with_a_buffer_is_saved_moved_and_seen() -> None:
    agent = all_parts()
    source = agent.behaviour("reach").loss.goal_source[0]
    (name,) = (name for name in agent.loss.state_dict() if name.endswith("places"))
    assert any(module is source for module in agent.loss.modules())
    agent.loss.load_state_dict({**agent.loss.state_dict(), name: torch.full((3, 2), 0.5)})
    assert (source.places == 0.5).all()
    records = agent.model.records()(random_records(reacher_task(), 2, 3))
    start = agent.behaviour("reach").loss.imagination_start(records["next"])
    assert (start["latent", "goal"] == 0.5).all()
    agent.loss.to(torch.float64)
    assert source.places.dtype == torch.float64


def test_a_fresh_process_loads_an_agent_of_such_parts(tmp_path: Path) -> None:
    file = save_agent(all_parts(), tmp_path / "agent.zip")
    (tmp_path / "load.py").write_text(LOAD)
    command = [sys.executable, str(tmp_path / "load.py"), str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    line, config = done.stdout.splitlines()
    assert "Nearness(width=0.2)" in config
    for part in (
        "world_model 'wide'",
        "reward 'nearness'",
        "goal_source 'remembered'",
        "goal 'waves'",
        "optimizer 'sgd'",
    ):
        assert f"{part} of the package 'ocwm_example'" in line
    assert line.endswith(f"install what registers them, or name it in {VARIABLE}")


def test_a_package_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "ocwm_example, ocwm_exmple")
    load_plugins.cache_clear()
    with pytest.raises(MissingPackageError, match=f"{VARIABLE} names 'ocwm_exmple', which is not installed and not on"):
        build_agent("no_such_row", reacher_task(), "debug")


def test_nothing_in_a_description_names_code() -> None:
    """Only what is registered is built, whatever the description says of packages."""
    description = describe(all_parts())
    description["plugins"] = {"reward evil": "os"}
    description["agent"]["behaviours"]["reach"]["reward"] = {"name": "evil"}
    with pytest.raises(CheckpointError, match="not registered here: reward 'evil' of the package 'os'"):
        read_parts(description)


def test_a_part_without_a_name_cannot_be_saved(tmp_path: Path) -> None:
    class Unnamed(type(AGENTS["dreamer_pcp"].behaviours["reach"].reward)):
        pass

    row = change(AGENTS["dreamer_pcp"], {})
    reach = Behaviour(row.behaviours["reach"].goal, Unnamed(), row.behaviours["reach"].goals)
    agent = build_agent(type(row)(row.world_model, {"reach": reach}), reacher_task(), "debug")
    with pytest.raises(SettingsError, match="Unnamed has no name: put @register"):
        save_agent(agent, tmp_path / "agent.zip")


def test_an_environment_by_its_name() -> None:
    task = make_task("dots", image_size=24)
    assert (task.name, task.objects, task.proprio, task.action) == ("dots", ("red", "blue"), 4, 4)
    assert make_task("ocwm/Dots-v0", image_size=24) == task
    with closing(make_env("dots", horizon=3)) as env:
        assert env.rollout(10, break_when_any_done=True)["next", "pixels"].shape == (3, 3, 32, 32)
    with pytest.raises(SettingsError, match=r"options\.image_size must be at least 8, got 1"):
        EnvChoice("dots", {"image_size": 1})


def test_environments_side_by_side_in_processes_that_know_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    find_environment("dots")
    monkeypatch.delenv(VARIABLE)
    with closing(make_env("dots", num_envs=2, horizon=3)) as env:
        assert env.rollout(2)["pixels"].shape == (2, 2, 3, 32, 32)


def test_from_collected_data_to_a_table(tmp_path: Path) -> None:
    """Collect in workers, train, evaluate in workers: all on the command line."""
    data, run, output = tmp_path / "data", tmp_path / "run", tmp_path / "evaluation"
    done = example("collect.py", "env=dots", f"dataset={data}", "steps=60", "workers=1", "env.options.horizon=15")
    assert "60 steps in 4 episodes" in done.stdout, done.stderr
    assert EpisodeDataset.open(data).task.name == "dots"
    training = ("updates=2", "eval_interval=2", "eval_episodes=2", "eval_steps=3", "video_interval=0")
    reach = ("reward.width=0.3", "goals=remembered", "object=blue")
    parts = ("agent=nearness", "explore=novelty", *(f"agent.behaviours.reach.{one}" for one in reach))
    more = ("size=debug", "size.learning.optimizer=sgd", *(f"training.{one}" for one in training))
    done = example("train_offline.py", "env=dots", f"dataset={data}", f"output={run}", *parts, *more)
    assert done.returncode == 0, done.stderr
    agent = load_agent(run / "checkpoint.zip").agent
    behaviours = to_dict(agent.config)["behaviours"]
    assert behaviours["reach"]["reward"] == {"name": "nearness", "width": 0.3}
    assert behaviours["explore"]["reward"] == {"name": "novelty", "lr": 1e-2}
    small = ("goals=4", "episode_steps=3", "workers=1", "envs=4", "video_goals=1", f"output={output}")
    done = example("evaluate.py", f"checkpoint={run / 'checkpoint.zip'}", *small)
    assert done.returncode == 0, done.stderr
    results = json.loads((output / "results.json").read_text())
    name = next(row for row in results["agents"] if row != "random")
    assert "behaviours.reach.reward.width=0.3" in name
    assert results["settings"]["object"] == "blue"
    policy = load_agent(run / "checkpoint.zip")
    goals = torch.tensor(results["goals"])
    with EvaluationEnvs(policy.agent.task, episode_steps=3, workers=0, envs=4) as envs:
        episodes = envs.run(policy, goals)
    away = (episodes["object_position_true"][:, -1, 1] - goals).norm(dim=-1)
    scored = torch.tensor(results["agents"][name]["per_goal"][0]["final_distance"])
    torch.testing.assert_close(scored, away, atol=1e-4, rtol=0)
    # The agent collects in a process of its own.
    more = Collection(steps=75, policy=str(run / "checkpoint.zip"), workers=1)
    options = EpisodeDataset.open(data).metadata["options"]
    acts = collecting_policy(more, "dots", options)
    with collect(data, "dots", more, policy=acts, options=options, progress=False) as dataset:
        assert list(dataset.metadata["policies"].values()) == [4, 1]


# An environment of gymnasium-robotics, which the other package wraps in one file.

fetch_installed = pytest.mark.skipif(
    find_spec("gymnasium_robotics") is None,
    reason="gymnasium-robotics is not installed: pip install gymnasium-robotics",
)


@pytest.fixture(scope="module")
def fetch() -> Iterator[Any]:
    scene = make_scene(find_environment("fetch_pick_place"), privileged=True, action_repeat=1)
    yield scene
    scene.close()


def off(observation: dict[str, np.ndarray]) -> float:
    """Of the estimated position, metres."""
    return float(np.linalg.norm(observation["object_position"] - observation["object_position_true"]))


def test_what_to_install_for_an_environment_of_another_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "find_spec", lambda module: None if module == "gymnasium_robotics" else True)
    with pytest.raises(MissingPackageError, match="'fetch_pick_place' needs gymnasium_robotics.*pip install gymnas"):
        make_env("fetch_pick_place")


@fetch_installed
def test_starts_and_physics_are_those_of_gymnasium_robotics(fetch: Any) -> None:
    from gymnasium_robotics.envs.fetch.pick_and_place import MujocoFetchPickAndPlaceEnv

    original = MujocoFetchPickAndPlaceEnv()
    fetch.reset(seed=3)
    original.reset(seed=3)
    original.np_random.bit_generator.state = np.random.default_rng(3).bit_generator.state
    original.np_random.uniform(size=3)  # the goal
    original._reset_sim()
    assert np.array_equal(fetch.data.qpos, original.data.qpos)
    for action in np.random.default_rng(0).uniform(-1, 1, (8, 4)):
        observation, *_ = fetch.step(action)
        original.step(action)
        assert np.array_equal(fetch.data.qpos, original.data.qpos)
    block = original._get_obs()["achieved_goal"] - fetch.start
    assert observation["object_position_true"][0] == pytest.approx(block, abs=1e-6)
    assert off(observation) < 0.02
    original.close()


@fetch_installed
def test_goal_images_of_gymnasium_robotics_show_the_block_there(fetch: Any) -> None:
    fetch.reset(seed=4)
    for goal in fetch.workspace.grid(4).flatten(0, 1).numpy():
        observation = fetch.goal_observation(goal)
        assert observation["object_position_true"][0] == pytest.approx(goal, abs=1e-6)
        assert observation["object_visible"].all()
        assert off(observation) < 0.02


@fetch_installed
@pytest.mark.slow
def test_gymnasium_robotics_from_collected_data_to_a_table(
    command: Callable[..., str], recwarn: pytest.WarningsRecorder
) -> None:
    """It has no landmarks: training says so once, and goes on. Goals of the evaluation have three coordinates."""
    env = ("env=fetch_pick_place", "dataset=data")
    options = ("env.options.horizon=15", "env.options.image_size=32")
    assert "45 steps in 3 episodes" in command("collect", *env, "steps=45", "workers=1", *options)
    short = ("size=debug", "training.updates=2", "training.eval_interval=1", "training.video_interval=0")
    command("train_offline", *env, "agent=focus_lcp", *short, "output=run")
    assert len([one for one in recwarn if "'fetch_pick_place' has no landmark goals" in str(one.message)]) == 1
    small = ("goals=4", "episode_steps=3", "workers=0", "envs=1", "video_goals=1", "image_goals=true")
    command("evaluate", "checkpoint=run/checkpoint.zip", *small, "output=evaluation")
    results = json.loads(Path("evaluation", "results.json").read_text())
    workspace = make_task("fetch_pick_place").workspace
    torch.testing.assert_close(torch.tensor(results["goals"]), workspace.grid(2).flatten(0, 1))
    assert list(results["agents"]) == ["random", "focus_lcp", "focus_lcp, image goals"]
    assert all(0 < score < 1 for score in results["agents"]["focus_lcp"]["per_goal"][0]["final_score"])
    assert Path("evaluation", "heatmap.png").stat().st_size > 1000
