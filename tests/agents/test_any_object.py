"""What a behaviour about another object than the first is about: goals, rewards, training records, scores."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_ocwm.agents import AGENTS, Agent, Behaviour, build_agent
from torchrl_ocwm.data import Collection, EpisodeDataset, collect
from torchrl_ocwm.envs import Task
from torchrl_ocwm.evaluation import EvaluationEnvs, LandmarkEvaluation, goal_images, measure, normalized_score
from torchrl_ocwm.modules import UnitRMS
from torchrl_ocwm.settings import SettingsError, change
from torchrl_ocwm.testing import random_dataset, random_records, reacher_task
from torchrl_ocwm.training.offline import train_offline
from torchrl_ocwm.training.run import TrainingBatches
from torchrl_ocwm.training.settings import Training

OBJECTS = ("cube", "distractor")
TASK = replace(reacher_task(16), objects=OBJECTS)
OPTIONS: dict[str, Any] = {"objects": list(OBJECTS), "image_size": 32}


def about(name: str | None, row: str = "dreamer_pcp", task: Task = TASK, **changes: Any) -> Agent:
    torch.manual_seed(0)
    return build_agent(change(AGENTS[row], {"behaviours.reach.object": name, **changes}), task, "debug")


def latents(agent: Agent) -> TensorDict:
    goal = agent.behaviour().goal
    features = {"state": agent.model.state, "belief": agent.model.belief, "goal": 0 if goal is None else goal.features}
    return TensorDict({"latent": {name: torch.rand(5, size) for name, size in features.items()}}, [5])


@pytest.mark.parametrize(("name", "index"), [(None, 0), ("cube", 0), ("distractor", 1)])
def test_positions_and_their_reward(name: str | None, index: int) -> None:
    agent = about(name)
    assert (agent.policy().object_index, agent.recorded_object) == (index, index)
    known = latents(agent)
    decoded = agent.model.object_position()(known.clone())["object_units"].unflatten(-1, (2, 2))[:, index]
    units = agent.model.units
    distance = (units.to_metres(decoded) - units.to_metres(known["latent", "goal"])).norm(dim=-1, keepdim=True)
    torch.testing.assert_close(agent.imagination.world_model[1](known)["reward"], -distance)


@pytest.mark.parametrize("index", [0, 1])
def test_latents_and_their_reward(index: int) -> None:
    agent = about(OBJECTS[index], "focus_lcp")
    goal = agent.behaviour().goal
    places, encode = 2 * torch.rand(5, 2) - 1, agent.model.positional_encoder
    both = encode(places.unsqueeze(-2).expand(5, 2, 2))
    torch.testing.assert_close(goal.position(places), UnitRMS()(both[:, index]))
    images = torch.randint(256, (5, 1, 3, 16, 16), dtype=torch.uint8)
    drawn = []
    for encoder in (goal.image, agent.model.latents_in_images()):
        torch.manual_seed(1)  # of the posterior
        drawn.append(encoder(images))
    torch.testing.assert_close(drawn[0], UnitRMS()(drawn[1][:, index]))
    known = latents(agent)
    known["latent", "goal"] = UnitRMS()(
        agent.model.extractor(known["latent", "state"], known["latent", "belief"])[:, index]
    )
    assert (agent.imagination.world_model[1](known)["reward"] > -1e-3).all()


@pytest.mark.parametrize(("row", "entry"), [("dreamer_pcp", "object_units"), ("focus_lcp", "image_latent")])
def test_goals_of_frames_in_which_it_is_seen(row: str, entry: str) -> None:
    agent = about("distractor", row, **{"behaviours.reach.goals": "frames"})
    records = random_records(TASK, 2, 4)
    records["next", "object_visible"][..., 0] = False
    records["next", "object_visible"][..., 1] = torch.eye(2, 4, dtype=torch.bool)  # two frames of eight
    frames = agent.model.records()(records)["next"]
    goals = agent.behaviour().loss.imagination_start(frames)["latent", "goal"]
    expected = frames[entry].unflatten(-1, (2, 2))[..., 1, :] if row == "dreamer_pcp" else frames[entry][..., 1, :]
    expected = expected if row == "dreamer_pcp" else UnitRMS()(expected)
    seen = torch.stack([expected[0, 0], expected[1, 1]])
    assert (torch.cdist(goals, seen).min(1).values < 1e-4).all()


@pytest.mark.parametrize("row", ["dreamer", "dreamer_pcp"])
@pytest.mark.parametrize("index", [0, 1])
def test_training_records(row: str, index: int, tmp_path: Path) -> None:
    agent = about(OBJECTS[index], row)
    with random_dataset(tmp_path / "data", TASK) as dataset:
        batch = TrainingBatches(agent, dataset, Training())._replay.sample()["next"]
    away = (batch["object_position"][..., index, :] - batch["goal_position"]).norm(dim=-1, keepdim=True)
    torch.testing.assert_close(batch["reward"], -away)


def test_two_behaviours_of_one_agent_each_about_its_own() -> None:
    reach = AGENTS["focus_lcp"].behaviours["reach"]
    config = replace(AGENTS["focus_lcp"], behaviours={"reach": reach, "push": replace(reach, object="distractor")})
    agent = build_agent(config, TASK, "debug")
    assert [agent.policy(name).object_index for name in ("reach", "push")] == [0, 1]
    encoded = agent.model.positional_encoder(torch.full((1, 2, 2), 0.5))
    for name, index in (("reach", 0), ("push", 1)):
        position = agent.behaviour(name).goal.position
        torch.testing.assert_close(position(torch.full((1, 2), 0.5)), UnitRMS()(encoded[:, index]))
    losses = agent.loss(random_records(TASK, 2, 3))
    assert losses["loss_push_actor"] != losses["loss_actor"]


def test_rewards_of_the_records_are_about_one_object() -> None:
    reach = AGENTS["dreamer"].behaviours["reach"]
    config = replace(AGENTS["dreamer"], behaviours={"reach": reach, "push": replace(reach, object="distractor")})
    with pytest.raises(SettingsError, match="reach, push learn the rewards of the records, which are about one object"):
        build_agent(config, TASK, "debug")
    with pytest.raises(SettingsError, match="object='ball' is not in 'reacher', which has cube, distractor"):
        about("ball")


def test_the_learner_of_recorded_rewards_decides_on_the_records() -> None:
    reach = AGENTS["dreamer_pcp"].behaviours["reach"]
    push = Behaviour(object="distractor")
    config = replace(AGENTS["dreamer"], behaviours={"reach": reach, "push": push})
    agent = build_agent(config, TASK, "debug")
    assert (agent.policy().object_index, agent.recorded_object) == (0, 1)


# With the simulator.


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EpisodeDataset]:
    settings = Collection(steps=20, workers=0)
    options = {**OPTIONS, "horizon": 10}
    with collect(tmp_path_factory.mktemp("data"), "cube_move", settings, options=options, progress=False) as dataset:
        yield dataset


@pytest.mark.parametrize("index", [0, 1])
def test_agents_for_either_of_two_cubes(
    index: int, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rewards that are learnt, scores during training and afterwards: all about the cube of the behaviour."""
    played: list[tuple[Tensor, Tensor]] = []
    run = EvaluationEnvs.run

    def note(self: EvaluationEnvs, policy: Any, goals: Tensor, *, numbers: Tensor, **settings: Any) -> Any:
        played.append((goals, numbers))
        return run(self, policy, goals, numbers=numbers, **settings)

    monkeypatch.setattr(EvaluationEnvs, "run", note)
    task = dataset.task
    agent = about(OBJECTS[index], "dreamer", task)
    training = Training(updates=2, eval_interval=2, log_interval=1, video_interval=0, checkpoint_interval=2)
    scores: list[dict[str, float]] = []
    with LandmarkEvaluation(agent, episodes=1, episode_steps=2) as evaluation:
        keep = lambda updates: scores.append(evaluation(updates)) or scores[-1]  # noqa: E731
        train_offline(agent, dataset, tmp_path, training, evaluate=keep, progress=False)
    goals, numbers = played[-1]  # of the landmark that was drawn
    with EvaluationEnvs(task, episode_steps=2, workers=0, envs=1) as envs:
        episodes = envs.run(agent.eval().policy(), goals, numbers=numbers)
    true = episodes["object_position_true"]
    assert (true[:, 0, 0] - true[:, 0, 1]).norm(dim=-1).min() > 0.02  # the cubes are at different places
    expected = [float(normalized_score(true[:, -1, one], goals).mean()) for one in (0, 1)]
    assert abs(expected[0] - expected[1]) > 1e-3
    assert scores[-1]["evaluation/final_score"] == pytest.approx(expected[index], abs=1e-5)
    away = (true[:, -1, index] - goals).norm(dim=-1)
    torch.testing.assert_close(measure(episodes, object_index=index)["final_distance"], away)


def test_goal_images_show_the_object_at_its_goal() -> None:
    with closing(gymnasium.make("ocwm/CubeMove-v0", privileged=True, **OPTIONS).unwrapped) as env:
        before, _ = env.reset(seed=0)
        goal = np.array([0.15, -0.1], np.float32)
        for index in (0, 1):
            shown = env.goal_observation(goal, index)
            assert np.abs(shown["object_position_true"][index] - goal).max() < 1e-6
            other = np.abs(shown["object_position_true"] - before["object_position_true"])[1 - index]
            assert other.max() < 1e-6
        with pytest.raises(ValueError, match="object_index must be below 2, the number of objects; got 2"):
            env.goal_observation(goal, 2)
        task = Task("cube_move", 32, OBJECTS, 19, 4, env.workspace, {**OPTIONS, "objects": OBJECTS})
        images = goal_images(task, torch.from_numpy(goal)[None], object_index=1)
        assert torch.equal(images[0], torch.from_numpy(env.goal_observation(goal, 1)["pixels"]))


def test_the_virtual_target_hides_no_object() -> None:
    with closing(gymnasium.make("ocwm/CubeMove-v0", virtual_target=9, **OPTIONS).unwrapped) as env:
        env.reset(seed=0)
        for index in (0, 1):
            shown = env.goal_observation(np.array([0.1, 0.15]), index)
            colours = shown["pixels"][:, shown["masks"][index]]
            assert shown["masks"][index].any()
            assert not (colours == np.array([[230], [40], [40]])).all(0).any()
