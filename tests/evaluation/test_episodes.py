from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.data import Collection, SmoothRandomPolicy, collect
from torchrl_ocwm.envs import Task, make_task
from torchrl_ocwm.evaluation import (
    EvaluationEnvs,
    Footage,
    LandmarkEvaluation,
    ReconstructionError,
    episode_records,
    episodes,
    goal_images,
    transition,
)
from torchrl_ocwm.evaluation.episodes import SteppedEnvs
from torchrl_ocwm.evaluation.landmarks import LandmarkEpisodes
from torchrl_ocwm.processes import LocalWorker, WorkerError
from torchrl_ocwm.settings import SettingsError
from torchrl_ocwm.testing import random_records, reacher_task


def still(tensordict: TensorDictBase) -> TensorDictBase:
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 2))


def push(tensordict: TensorDictBase) -> TensorDictBase:
    return tensordict.set("action", torch.ones(*tensordict.batch_size, 2))


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("reacher")


@pytest.fixture(scope="module")
def envs(task: Task) -> Iterator[EvaluationEnvs]:
    with EvaluationEnvs(task, episode_steps=5, workers=0, envs=4) as envs:
        yield envs


class Drawing(SmoothRandomPolicy):
    """Acts by random numbers, and says how it explores."""

    def __init__(self) -> None:
        super().__init__(2)
        self.seen: set[Any] = set()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.seen.add(exploration_type())
        return super().forward(tensordict)


def goals(task: Task, number: int) -> Tensor:
    return task.workspace.grid(4).flatten(0, 1)[:number]


@pytest.mark.parametrize("number", [1, 4, 6])
def test_one_episode_per_goal(envs: EvaluationEnvs, task: Task, number: int) -> None:
    episodes = envs.run(push, goals(task, number))
    assert episodes.shape == (number, 5)
    torch.testing.assert_close(episodes["goal_position"], goals(task, number).unsqueeze(1).expand(-1, 5, -1))
    distance = (episodes["object_position"][:, :, 0] - episodes["goal_position"]).norm(dim=-1, keepdim=True)
    torch.testing.assert_close(episodes["reward"], -distance)


def test_seed_decides(envs: EvaluationEnvs, task: Task) -> None:
    first, second, other = (envs.run(push, goals(task, 6), seed=seed) for seed in (3, 3, 4))
    torch.testing.assert_close(first["object_position_true"], second["object_position_true"], rtol=0, atol=0)
    assert not torch.equal(first["object_position_true"], other["object_position_true"])


@pytest.mark.parametrize(("workers", "number"), [(0, 2), (2, 2)])
def test_episodes_do_not_depend_on_the_layout(envs: EvaluationEnvs, task: Task, workers: int, number: int) -> None:
    """Neither starts nor random actions, nor the states that a world model draws."""
    agent = build_agent("focus_lcp", task, "debug")
    torch.manual_seed(1)
    expected = [envs.run(policy, goals(task, 5), seed=3) for policy in (Drawing(), agent.policy())]
    with EvaluationEnvs(task, episode_steps=5, workers=workers, envs=number) as other:
        drawn, acted = (other.run(policy, goals(task, 5), seed=3) for policy in (Drawing(), agent.policy()))
    torch.testing.assert_close(drawn["object_position_true"], expected[0]["object_position_true"], rtol=0, atol=0)
    torch.testing.assert_close(acted["object_position_true"], expected[1]["object_position_true"], rtol=0, atol=1e-6)


def test_some_goals_again(envs: EvaluationEnvs, task: Task) -> None:
    """A film of some goals shows the episodes that were scored."""
    all_of_them = envs.run(Drawing(), goals(task, 6), seed=3)
    chosen = torch.tensor([1, 4])
    again = envs.run(Drawing(), goals(task, 6)[chosen], seed=3, numbers=chosen)
    torch.testing.assert_close(again["object_position_true"], all_of_them["object_position_true"][chosen])


def test_blind_episodes_are_the_same_and_nothing_is_rendered(
    envs: EvaluationEnvs, task: Task, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeing = envs.run(Drawing(), goals(task, 6), seed=3)
    with monkeypatch.context() as patch:
        patch.delattr("torchrl_ocwm.envs.Camera.render")
        blind = envs.run(Drawing(), goals(task, 6), seed=3, blind=True)
    assert set(blind.keys()) == {"object_position_true", "goal_position"}
    torch.testing.assert_close(blind["object_position_true"], seeing["object_position_true"], rtol=0, atol=0)
    again = envs.run(Drawing(), goals(task, 6), seed=3, keep=("pixels",))  # it is not blind for ever
    assert again["pixels"].flatten(1).any(1).all()


@pytest.mark.parametrize("workers", [0, 2])
def test_goals_are_spread_over_all_processes(task: Task, workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also when one of them had room for all."""
    counts: list[int] = []
    monkeypatch.setattr(episodes, "make_worker", lambda make, **_: LocalWorker(make))
    reset = SteppedEnvs.reset

    def note(self: SteppedEnvs, starts: list[Any], blind: bool = False) -> TensorDictBase:
        counts.append(len(starts))
        return reset(self, starts, blind)

    monkeypatch.setattr(SteppedEnvs, "reset", note)
    with EvaluationEnvs(task, episode_steps=1, workers=workers, envs=4) as envs:
        envs.run(push, goals(task, 3))
    assert counts == ([2, 1] if workers else [3])


def test_footage_is_of_the_episodes_that_are_run(envs: EvaluationEnvs, task: Task) -> None:
    """Of goals in different batches, and in the order of the goals."""
    agent, chosen = build_agent("focus_lcp", task, "debug"), torch.tensor([1, 2, 5])
    footage, steps = Footage(chosen), []

    def inspect(step: TensorDictBase) -> dict[str, Any]:
        footage(step)
        steps.append(step["latent"].clone())
        return transition(step)

    played = envs.run(agent.policy(), goals(task, 6), seed=3, inspect=inspect)
    kept = footage.episodes()
    assert kept.shape == (3, 5)
    for key in ("pixels", ("next", "pixels"), ("next", "object_position")):
        assert torch.equal(kept["transition"][key], played["transition"][key][chosen])
    states = torch.cat([torch.stack([one["state"] for one in batch], 1) for batch in (steps[:5], steps[5:])])
    assert torch.equal(kept["latent", "state"], states[chosen])


def test_starts_are_not_those_of_collecting(task: Task, tmp_path: Path) -> None:
    options = {"horizon": 5}
    collected = collect(tmp_path / "d", "reacher", Collection(steps=30, workers=0), options=options, progress=False)
    starts = collected.records["next", "proprio"][collected.records["is_init"].squeeze(-1)]
    with EvaluationEnvs(task, episode_steps=1, workers=0, envs=6) as envs:
        episodes = envs.run(push, goals(task, 6), inspect=transition)
    here = episodes["transition", "proprio"][:, 0]
    assert torch.cdist(here, starts).min() > 1e-3


def test_evaluation_does_not_explore_whatever_the_context(envs: EvaluationEnvs, task: Task) -> None:
    policy = Drawing()
    with set_exploration_type(ExplorationType.RANDOM):
        envs.run(policy, goals(task, 1))
    assert policy.seen == {ExplorationType.DETERMINISTIC}


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_process_that_dies_or_hangs_ends_the_evaluation(task: Task, number: signal.Signals) -> None:
    def act(tensordict: TensorDictBase) -> TensorDictBase:
        [child] = multiprocessing.active_children()
        os.kill(child.pid, number)  # type: ignore[arg-type]
        return push(tensordict)

    message = "has ended .signal SIGKILL" if number == signal.SIGKILL else "no sign of life for 15 seconds"
    with EvaluationEnvs(task, episode_steps=5, workers=1, envs=1, timeout=15) as envs:
        envs.run(push, goals(task, 1))
        with pytest.raises(WorkerError, match=message):
            envs.run(act, goals(task, 1))
    assert not multiprocessing.active_children()


def test_closing_closes_every_environment() -> None:
    closed = []

    class Stub:
        def reset(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
            return {"observation": np.zeros(1)}, {}

        def close(self) -> None:
            closed.append(self)

    envs = SteppedEnvs(Stub, lambda: None)
    assert envs.reset([{}, {}]).shape == (2,)
    made = list(envs.envs)
    envs.close()
    assert len(closed) == 2
    assert set(closed) == set(made)


def test_evaluations_leave_no_descriptors(task: Task) -> None:
    def evaluate(workers: int) -> int:
        with EvaluationEnvs(task, episode_steps=2, workers=workers, envs=2) as envs:
            envs.run(push, goals(task, 3))
        goal_images(task, goals(task, 1))
        return len(os.listdir("/proc/self/fd"))

    first = evaluate(1), evaluate(0)  # what is opened once and for all
    assert [evaluate(workers) for workers in (0, 0, 0, 1)] == [first[1]] * 4


def test_episodes_move_with_the_policy(envs: EvaluationEnvs, task: Task) -> None:
    def travelled(policy: Any) -> float:
        position = envs.run(policy, goals(task, 4))["object_position_true"][:, :, 0]
        return float((position[:, -1] - position[:, 0]).norm(dim=-1).mean())

    assert travelled(still) < 1e-6
    assert travelled(push) > 1e-3


def test_records_are_those_of_a_dataset(envs: EvaluationEnvs, task: Task) -> None:
    """One more than steps: the first frame too, and with each frame the action that led to it."""
    episodes = envs.run(push, goals(task, 3), inspect=transition)
    records = episode_records(episodes)
    assert records.shape == (3, 6)
    assert records["is_init"].squeeze(-1).nonzero()[:, 1].tolist() == [0, 0, 0]
    torch.testing.assert_close(records["action"][:, :, 0], torch.tensor([0.0, 1, 1, 1, 1, 1]).expand(3, 6))
    seen = records["next", "object_position"]
    torch.testing.assert_close(seen[:, 1:], episodes["object_position"])
    assert not torch.equal(seen[:, 0], seen[:, 1])
    assert records["next", "masks"].flatten(2).any(-1).all()
    kept = set(random_records(task, 1, 2)["next"].keys())
    assert kept - set(records["next"].keys()) <= {"object_position_true"}


def test_goals_reach_the_environments_of_every_process(task: Task) -> None:
    with EvaluationEnvs(task, episode_steps=5, workers=2, envs=2) as parallel:
        episodes = parallel.run(push, goals(task, 4), keep=("pixels",))
    assert episodes["pixels"].shape == (4, 5, 3, 64, 64)
    distance = (episodes["object_position"][:, -1, 0] - goals(task, 4)).norm(dim=-1)
    torch.testing.assert_close(episodes["reward"][:, -1, 0], -distance)  # each environment had its own goal


@pytest.mark.parametrize("workers", [0, 2])
def test_each_environment_keeps_its_goal_image(task: Task, workers: int) -> None:
    places = goals(task, 3)
    images = goal_images(task, places)
    seen = []

    def look(tensordict: TensorDictBase) -> TensorDictBase:
        seen.append(tensordict["goal", "pixels"].clone())
        return push(tensordict)

    with EvaluationEnvs(task, episode_steps=3, workers=workers, envs=2) as envs:
        envs.run(look, places, images=images)
    chunks = images.split(max(workers, 1) * 2)
    for step, given in enumerate(seen):
        torch.testing.assert_close(given, chunks[step // 3], rtol=0, atol=0)


def test_goal_images_show_the_object_at_the_goal(task: Task) -> None:
    places = goals(task, 3)
    with gymnasium.make("ocwm/Reacher-v0", privileged=True) as env:
        env.reset(seed=5)
        for place, image in zip(places, goal_images(task, places), strict=True):
            there = env.unwrapped.goal_observation(place.numpy())
            assert np.linalg.norm(there["object_position_true"][0] - place.numpy()) < 0.005
            np.testing.assert_array_equal(there["pixels"], image)


def test_goals_are_checked(envs: EvaluationEnvs) -> None:
    with pytest.raises(ValueError, match="lies outside the workspace"):
        envs.run(still, torch.tensor([[0.5, 0.0]]))
    with pytest.raises(ValueError, match="has 2 coordinates"):
        envs.run(still, torch.zeros(3, 3))


def test_reconstruction_error_by_hand(make_agent: Any) -> None:
    agent = make_agent("dreamer")
    decoders = agent.model.vector_decoders
    decoders["object_position"] = Constant([0.5, 0.0])  # units of 0.24 m
    decoders["goal_position"] = Constant([0.0, 1.0])
    latent = TensorDict({"state": torch.zeros(3, agent.model.state), "belief": torch.zeros(3, agent.model.belief)}, [3])
    step = TensorDict(
        {
            "latent": latent,
            "object_position_true": torch.tensor([[[0.12, 0.05]]]).expand(3, 1, 2),
            "goal_position": torch.tensor([[0.1, 0.24]]).expand(3, 2),
        },
        [3],
    )
    errors = ReconstructionError(agent)(step)
    torch.testing.assert_close(errors["entity_error"], torch.full((3,), 0.05))
    torch.testing.assert_close(errors["goal_error"], torch.full((3,), 0.1))
    assert "goal_error" not in ReconstructionError(make_agent("dreamer_pcp"))(step)


def test_reconstruction_error_of_the_object_in_question() -> None:
    agent = build_agent("dreamer", replace(reacher_task(), objects=("finger", "thumb")), "debug")
    agent.model.vector_decoders["object_position"] = Constant([0.5, 0.0, 0.0, 0.25])  # units of 0.24 m
    latent = TensorDict({"state": torch.zeros(1, agent.model.state), "belief": torch.zeros(1, agent.model.belief)}, [1])
    true, goal = torch.tensor([[[0.12, 0.0], [0.0, 0.11]]]), torch.zeros(1, 2)
    step = TensorDict({"latent": latent, "object_position_true": true, "goal_position": goal}, [1])
    for index, error in enumerate((0.0, 0.05)):
        found = ReconstructionError(agent, object_index=index)(step)["entity_error"]
        torch.testing.assert_close(found, torch.tensor([error]), atol=1e-6, rtol=0)


class Constant(torch.nn.Module):
    def __init__(self, value: list[float]) -> None:
        super().__init__()
        self.value = torch.tensor(value)

    def forward(self, state: Tensor, belief: Tensor) -> Tensor:
        return self.value.expand(*state.shape[:-1], -1)


def test_landmarks(task: Task) -> None:
    agent = build_agent("dreamer_pcp", task, "debug")
    with LandmarkEvaluation(agent, episodes=2, episode_steps=3) as evaluation:
        scores, again = evaluation(0), evaluation(0)
    assert set(scores) == {f"evaluation/{name}" for name in ("final_score", "mean_score", "success", "final_distance")}
    assert scores == again  # the same episodes after as many updates
    assert 0 < scores["evaluation/final_score"] < 1
    with pytest.raises(SettingsError, match="eval_episodes=11, but reacher has 10 landmark goals"):
        LandmarkEvaluation(agent, episodes=11, episode_steps=3)


@pytest.mark.parametrize("name", ["dreamer_pcp", "lexa_temporal"])
def test_landmarks_beside_training(task: Task, name: str) -> None:
    """A copy of the weights of that moment; the same scores, and no random number of training is drawn."""
    agent = build_agent(name, task, "debug")
    with (
        LandmarkEvaluation(agent, episodes=2, episode_steps=3, beside=True) as beside,
        LandmarkEvaluation(agent, episodes=2, episode_steps=3) as here,
    ):
        before = torch.random.get_rng_state()
        first = here(0)
        later: Any = beside(0)
        torch.nn.init.normal_(next(agent.actor.parameters()))  # an update
        assert later.answer() == first
        assert here(1) != first
        torch.random.set_rng_state(before)
        assert beside(1).answer() == here(1)  # type: ignore[union-attr]
        assert torch.equal(torch.random.get_rng_state(), before)
    assert not multiprocessing.active_children()


def test_landmarks_are_drawn_anew_each_time(task: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    played = []
    run = EvaluationEnvs.run

    def note(self: EvaluationEnvs, policy: Any, goals: Tensor, **settings: Any) -> Any:
        played.append((goals, settings["numbers"]))
        return run(self, policy, goals, **settings)

    monkeypatch.setattr(EvaluationEnvs, "run", note)
    landmarks = torch.tensor(task.workspace.landmarks)
    with LandmarkEvaluation(build_agent("dreamer_pcp", task, "debug"), episodes=3, episode_steps=1) as evaluation:
        for updates in range(6):
            evaluation(updates)
    for goals, numbers in played:  # a landmark's episode starts as it did before
        torch.testing.assert_close(goals, landmarks[numbers])
        assert len(numbers.unique()) == 3
    assert len({tuple(numbers.tolist()) for _, numbers in played}) > 3


def test_landmarks_are_played_where_the_environment_is(task: Task) -> None:
    """An agent of another dtype stands for one on a GPU: observations do not go through its own weights."""
    agent = build_agent("dreamer_pcp", task, "debug")
    with LandmarkEvaluation(agent, episodes=2, episode_steps=3) as evaluation:
        scores = evaluation(0)
        agent.double()
        assert evaluation(0) == scores


def test_landmarks_are_given_as_images_to_agents_that_take_nothing_else(
    task: Task, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, seen, act = build_agent("lexa_temporal", task, size="debug"), [], LandmarkEpisodes._act
    noted = lambda self, step: seen.append(step["goal", "pixels"]) or act(self, step)  # noqa: E731
    monkeypatch.setattr(LandmarkEpisodes, "_act", noted)
    with LandmarkEvaluation(agent, episodes=2, episode_steps=2) as evaluation:
        scores = evaluation(0)
        chosen = torch.randperm(10, generator=torch.Generator().manual_seed(0))[:2].sort().values
        expected = goal_images(task, evaluation.goals[chosen])
    assert set(scores) >= {"evaluation/final_score"}
    assert len(seen) == 2
    for images in seen:
        assert torch.equal(images, expected)


def test_the_test_task_is_reachers(task: Task) -> None:
    """What tests and doctests use without a simulator has the simulator's shapes."""
    workspace = replace(task.workspace, landmarks=reacher_task().workspace.landmarks, reach=(0.042, 0.24))
    assert replace(task, workspace=workspace) == reacher_task()
    assert task.workspace.reach == pytest.approx((0.042, 0.24), abs=1e-3)
