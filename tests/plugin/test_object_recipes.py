"""Recipes with an agent that is about the second object: all that they show is about that one."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from other_package import plugin  # noqa: F401
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_ocwm import load_agent, make_task
from torchrl_ocwm.agents import AGENTS, build_agent, save_agent
from torchrl_ocwm.data import SmoothRandomPolicy
from torchrl_ocwm.envs import Task
from torchrl_ocwm.evaluation import (
    EvaluationEnvs,
    LandmarkEvaluation,
    ReconstructionError,
    goal_images,
    imagined_distance,
    landmarks,
    latent_pairs,
)
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import random_dataset
from torchrl_ocwm.training import Online, Training, collect_seed_steps, train_online

STEPS, GOALS = 3, 4


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("dots", image_size=16)


@pytest.fixture
def agent(task: Task, tmp_path: Path) -> Callable[..., Path]:
    """The file of an agent whose task behaviour is about the second dot."""

    def make(row: str, **changes: Any) -> Path:
        torch.manual_seed(0)
        config = change(AGENTS[row], {"behaviours.reach.object": "blue", **changes})
        return save_agent(build_agent(config, task, "debug"), tmp_path / f"{row}.zip")

    return make


@pytest.fixture(scope="module")
def envs(task: Task) -> Iterator[EvaluationEnvs]:
    with EvaluationEnvs(task, episode_steps=STEPS, workers=0, envs=GOALS) as envs:
        yield envs


@pytest.fixture
def evaluate(command: Callable[..., str], tmp_path: Path) -> Callable[..., tuple[Tensor, dict[str, Any]]]:
    """The goals, and what was found for each of them in every row, in their order."""

    def run(file: Path, *more: str) -> tuple[Tensor, dict[str, Any]]:
        small = (f"goals={GOALS}", f"episode_steps={STEPS}", "workers=0", f"envs={GOALS}", "video_goals=0")
        command("evaluate", f"checkpoint={file}", *small, "image_goals=true", "output=out", *more)
        results = json.loads((tmp_path / "out" / "results.json").read_text())
        rows = {name: row["per_goal"][0] for name, row in results["agents"].items()}
        return torch.tensor(results["goals"]), rows

    return run


def test_scores_and_errors(evaluate: Callable[..., Any], agent: Callable[..., Path], envs: EvaluationEnvs) -> None:
    """With random actions, goals as positions, and goals as images."""
    goals, rows = evaluate(file := agent("focus_lcp"))
    policy, images = load_agent(file), goal_images(envs.task, goals, object_index=1)
    errors = ReconstructionError(policy.agent, object_index=1)

    def inspect(step: TensorDictBase) -> dict[str, Any]:
        return {**errors(step), "latent": step["latent"].select("state", "belief", "goal")}

    played = [envs.run(SmoothRandomPolicy(4), goals, blind=True)]
    played += [envs.run(policy, goals, images=given, inspect=inspect) for given in (None, images)]
    for name, end, episodes in zip(rows, ("random", ")", ", image goals"), played, strict=True):
        assert name.endswith(end)
        away = (episodes["object_position_true"][:, -1] - goals.unsqueeze(1)).norm(dim=-1)
        assert (away[:, 0] - away[:, 1]).abs().min() > 1e-4
        assert rows[name]["final_distance"] == pytest.approx(away[:, 1].tolist(), abs=1e-5)
        if name != "random":
            assert rows[name]["entity_error"] == pytest.approx(episodes["entity_error"].mean(1).tolist(), abs=1e-5)
            imagined = imagined_distance(policy.behaviour, episodes["latent"][:, 0], goals, STEPS, object_index=1)
            assert rows[name]["imagined_distance"] == pytest.approx(imagined.tolist(), abs=1e-5)


def test_scores_of_another_behaviour(
    evaluate: Callable[..., Any], agent: Callable[..., Path], envs: EvaluationEnvs
) -> None:
    file = agent("focus_lcp", **{"behaviours.other": AGENTS["focus_lcp"].behaviours["reach"]})
    goals, rows = evaluate(file, "behaviour=other")
    (row,) = (row for name, row in rows.items() if name.endswith(", other"))
    both = [envs.run(load_agent(file, behaviour=name), goals)["object_position_true"] for name in ("other", "reach")]
    other, reach = ((positions[:, -1, 0] - goals).norm(dim=-1) for positions in both)
    assert (other - reach).abs().min() > 1e-4
    assert row["final_distance"] == pytest.approx(other.tolist(), abs=1e-5)


def test_the_return_beside_that_which_is_predicted(
    evaluate: Callable[..., Any], agent: Callable[..., Path], envs: EvaluationEnvs
) -> None:
    goals, rows = evaluate(file := agent("dreamer"))
    policy = load_agent(file)
    episodes = envs.run(policy, goals)
    away = (episodes["object_position"] - goals[:, None, None]).norm(dim=-1)
    discount = policy.agent.size.learning.gamma ** torch.arange(STEPS)
    first, second = (-away * discount[:, None]).sum(1).unbind(-1)
    assert (first - second).abs().min() > 1e-4
    (row,) = (row for name, row in rows.items() if name != "random")
    assert row["obtained_return"] == pytest.approx(second.tolist(), abs=1e-5)


def test_goal_images_of_evaluations_in_training(
    task: Task, agent: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Tensor] = []
    monkeypatch.setattr(
        landmarks, "goal_images", lambda *given, **about: shown.append(goal_images(*given, **about)) or shown[-1]
    )
    with LandmarkEvaluation(load_agent(agent("lexa_cosine")).agent, episodes=1, episode_steps=1) as evaluation:
        first, second = (goal_images(task, evaluation.goals, object_index=index) for index in (0, 1))
    assert not torch.equal(first, second)
    assert torch.equal(shown[0], second)


@pytest.mark.parametrize(("arguments", "index"), [((), 1), (("behaviour=reach",), 1), (("behaviour=other",), 0)])
def test_goal_latents(
    command: Callable[..., str],
    scripts: dict[str, ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    agent: Callable[..., Path],
    task: Task,
    tmp_path: Path,
    arguments: tuple[str, ...],
    index: int,
) -> None:
    """Of the behaviour that acts, or of another, about the first dot."""
    file = agent("focus_lcp", **{"behaviours.other": AGENTS["focus_lcp"].behaviours["reach"]})
    looked: list[tuple[Tensor, Tensor]] = []

    def note(model: Any, records: TensorDictBase, **settings: Any) -> Any:
        pairs, places = latent_pairs(model, records, **settings)
        looked.append((places, records["next", "object_position"]))
        return pairs, places

    monkeypatch.setattr(scripts["diagnose"], "latent_pairs", note)
    small = ("sequences=2", "length=6", "context=2", "frames=8", "video_sequences=0")
    with random_dataset(tmp_path / "data", task, episodes=2, length=8) as dataset:
        command("diagnose", f"checkpoint={file}", f"dataset={dataset.path}", *small, *arguments)
    ((places, positions),) = looked
    off = torch.cdist(places, positions[..., index, :].flatten(0, 1)).min(1).values
    assert off.max() < 1e-6


def test_rewards_of_rounds(task: Task, tmp_path: Path) -> None:
    """Of the dot that whoever plays an episode is about: in turn the second and the first."""
    row = AGENTS["dreamer_pcp"].and_behaviours(other=AGENTS["dreamer_pcp"].behaviours["reach"])
    made = build_agent(change(row, {"behaviours.reach.object": "blue"}), task, "debug")
    online = Online(seed_steps=(18,), seed_updates=1, update_ratio=0.1, round_episodes=2, workers=0)
    training = Training(updates=2, log_interval=1, checkpoint_interval=100, eval_interval=0, video_interval=0)
    options = {"image_size": 16, "horizon": 9}
    with collect_seed_steps(tmp_path / "data", "dots", online, options=options, progress=False) as dataset:
        train_online(made, dataset, tmp_path / "run", training, online, progress=False)
        played = dataset.records["next"].reshape(-1, 10)[2:, 1:]  # without the seed steps and first frames
        away = (played["object_position"] - played["goal_position"].unsqueeze(-2)).norm(dim=-1).mean(1)
    assert dataset.metadata["policies"] == {"random": 2, "reach": 1, "other": 1}
    logged = (tmp_path / "run" / "log" / "scalars" / "collected" / "reward.csv").read_text().splitlines()[0]
    assert float(logged.split(",")[1]) == pytest.approx(-float(away[0, 1] + away[1, 0]) / 2, abs=1e-5)
