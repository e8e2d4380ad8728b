"""What the settings of a training run do, in a run; what looks at the agent is replaced by stubs."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from rows import shows
from tensordict import TensorDict, TensorDictBase
from torchrl.checkpoint import CheckpointError
from torchrl.record.loggers import CSVLogger

from torchrl_ocwm.agents import AGENTS, EXPLORERS, SIZES, Agent, build_agent
from torchrl_ocwm.agents.archive import Archive
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.devices import DeviceError
from torchrl_ocwm.envs import Workspace
from torchrl_ocwm.evaluation import landmarks
from torchrl_ocwm.recipes import landmarks as evaluations
from torchrl_ocwm.settings import change, to_dict
from torchrl_ocwm.testing import random_dataset, random_records, reacher_task
from torchrl_ocwm.training import run as runs
from torchrl_ocwm.training.offline import train_offline
from torchrl_ocwm.training.settings import Training
from torchrl_ocwm.training.stepper import Stepper, make_stepper

TASK = reacher_task(16)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> EpisodeDataset:
    return random_dataset(tmp_path_factory.mktemp("data") / "random", TASK)


class Run(SimpleNamespace):
    """What happened in a run, with the number of updates at which it did."""

    agent: Agent
    batches: list[TensorDictBase]
    threads: list[int]
    saved: list[int]
    logged: list[int]
    evaluated: list[int]
    filmed: list[int]
    rates: list[float]


@pytest.fixture
def run(dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    """Train with some settings, four updates unless told otherwise, in a folder of its own unless one is given."""
    numbers = iter(range(100))

    def train(folder: Path | None = None, size: Any = None, **settings: Any) -> Run:
        torch.manual_seed(0)
        agent = build_agent("dreamer_pcp", TASK, change(SIZES["debug"], size or {}))
        seen = Run(agent=agent, batches=[], threads=[], saved=[], logged=[], evaluated=[], filmed=[], rates=[])

        def look(module: Any, arguments: tuple[TensorDictBase]) -> None:
            seen.batches.append(arguments[0].clone())
            seen.threads.append(torch.get_num_threads())

        agent.loss.model_loss.register_forward_pre_hook(look)
        save, log, schedule = Archive.save, CSVLogger.log_scalar, runs.make_schedule

        def note_save(self: Archive, *arguments: Any, **options: Any) -> Path:
            seen.saved.append(len(seen.batches))
            return save(self, *arguments, **options)

        def note_log(self: CSVLogger, name: str, value: float, step: int) -> None:
            if name.endswith("loss_actor"):
                seen.logged.append(step)
            log(self, name, value, step)

        def note_rates(optimizer: torch.optim.Optimizer, training: Training) -> Any:
            made = schedule(optimizer, training)
            agent.loss.model_loss.register_forward_hook(lambda *_: seen.rates.append(made.get_last_lr()[0]) and None)
            return made

        def film(updates: int) -> Path:
            seen.filmed.append(updates)
            return tmp_path / "film.mp4"

        def evaluate(updates: int) -> dict[str, float]:
            seen.evaluated.append(updates)
            return {}

        with monkeypatch.context() as patch:
            patch.setattr(Archive, "save", note_save)
            patch.setattr(CSVLogger, "log_scalar", note_log)
            patch.setattr(runs, "make_schedule", note_rates)
            training = Training(**{"updates": 4, "eval_interval": 0, "video_interval": 0, **settings})
            folder = folder or tmp_path / f"run_{next(numbers)}"
            train_offline(agent, dataset, folder, training, evaluate=evaluate, film=film, progress=False)
        return seen

    return train


def weights(run: Run) -> torch.Tensor:
    return torch.cat([parameter.detach().flatten() for parameter in run.agent.parameters()])


@shows("Training.updates")
def test_updates(run: Callable[..., Run]) -> None:
    assert len(run(updates=3).batches) == 3


@shows("Training.seed")
def test_seed(run: Callable[..., Run]) -> None:
    first, again, other = (run(updates=2, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(weights(first), weights(again))
    assert not torch.equal(first.batches[0]["action"], other.batches[0]["action"])


@shows("Learning.batch_size", "Learning.slice_len")
def test_the_shape_of_a_batch(run: Callable[..., Run]) -> None:
    assert run(updates=1, size={"learning.batch_size": 3, "learning.slice_len": 5}).batches[0].shape == (3, 5)


@shows("Training.device")
def test_device(run: Callable[..., Run], monkeypatch: pytest.MonkeyPatch) -> None:
    """All of it is where it is said to be; there is no other device here, but one without values."""
    with pytest.raises(DeviceError, match="device 'cuda:99' cannot be used"):
        run(device="cuda:99")
    places: list[Any] = []
    to = TensorDict.to
    monkeypatch.setattr(TensorDict, "to", lambda self, place, *more: places.append(place) or to(self, place, *more))
    monkeypatch.setattr(Agent, "to", lambda self, place: places.append(place) or self)
    run(device="cpu", updates=2)
    assert places == ["cpu"] * 3


@shows("Training.threads")
def test_threads(run: Callable[..., Run]) -> None:
    before = torch.get_num_threads()
    try:
        assert run(updates=1, threads=3).threads == [3]
        assert run(updates=1, threads=0).threads == [3]  # as it was
        assert run(updates=1).threads == [1]  # as small networks have it
    finally:
        torch.set_num_threads(before)


@shows("Training.log_interval", "Training.checkpoint_interval", "Training.eval_interval", "Training.video_interval")
def test_intervals(run: Callable[..., Run]) -> None:
    seen = run(updates=7, log_interval=3, checkpoint_interval=4, eval_interval=2, video_interval=5)
    assert sorted(set(seen.logged)) == [3, 6, 7]
    assert seen.saved == [4, 7]
    assert seen.evaluated == [2, 4, 6]
    assert seen.filmed == [5]
    seen = run(updates=4, eval_interval=0, video_interval=0)
    assert seen.evaluated == seen.filmed == []


@shows("Training.goals")
@pytest.mark.parametrize("goals", ["stored", "uniform", "auto"])
def test_goals(run: Callable[..., Run], dataset: EpisodeDataset, goals: str) -> None:
    torch.manual_seed(0)
    stored = {tuple(goal) for goal in dataset.records["next", "goal_position"].tolist()}
    agent = build_agent("dreamer", TASK, "debug")
    sample = runs.TrainingBatches(agent, dataset, Training(goals=goals))  # type: ignore[arg-type]
    seen = {tuple(goal) for goal in sample()["next", "goal_position"].flatten(0, 1).tolist()}
    assert (seen <= stored) == (goals == "stored")
    assert (seen & stored == set()) == (goals != "stored")


@shows("Training.compile", "Training.cudagraph")
def test_compiled_or_captured(monkeypatch: pytest.MonkeyPatch, run: Callable[..., Run]) -> None:
    """Before the first update: compiled where it is asked for, captured there or on a GPU."""
    warm: list[bool] = []
    monkeypatch.setattr(Stepper, "warmup", lambda self, sample: warm.append(True))
    for settings, expected in (({}, 0), ({"compile": True}, 1), ({"compile": False}, 0), ({"cudagraph": True}, 1)):
        agent = build_agent("dreamer_pcp", TASK, "debug")
        stepper = make_stepper(agent, Training(**settings))
        cpu, cuda = (stepper.resolve(torch.device(place)) for place in ("cpu", "cuda"))
        assert cpu == (settings.get("compile", False), settings.get("cudagraph", False))
        assert cuda == (settings.get("compile", False), settings.get("cudagraph", True))
        monkeypatch.setattr(Stepper, "step", lambda self, trainer, batch: TensorDict({"loss_actor": torch.zeros(())}))
        warm.clear()
        run(updates=1, **settings)
        assert len(warm) == expected


@shows("Training.mixed_precision")
def test_mixed_precision(run: Callable[..., Run], monkeypatch: pytest.MonkeyPatch) -> None:
    seen: set[bool] = set()
    forward = Stepper._forward_backward

    def look(self: Stepper, sample: TensorDictBase) -> TensorDictBase:
        handle = self.loss_module.model_loss.register_forward_pre_hook(
            lambda *_: seen.add(torch.is_autocast_enabled("cpu"))
        )
        try:
            return forward(self, sample)
        finally:
            handle.remove()

    monkeypatch.setattr(Stepper, "_forward_backward", look)
    for mixed in (True, False):
        seen.clear()
        run(updates=1, mixed_precision=mixed)
        assert seen == {mixed}


@shows("Training.final_lr")
def test_learning_rates_fall(run: Callable[..., Run]) -> None:
    rate = SIZES["debug"].learning.model_lr
    assert run(updates=4, final_lr=0.2).rates == pytest.approx([rate, 0.8 * rate, 0.6 * rate, 0.4 * rate])
    assert run(updates=4, final_lr=1).rates == pytest.approx([rate] * 4)


@shows("Training.target_rate")
@pytest.mark.parametrize("rate", [0.02, 0.5, 1.0])
def test_the_slow_critic_of_each_behaviour_follows(rate: float) -> None:
    row = AGENTS["dreamer_pcp"].and_behaviours(explore=EXPLORERS["plan2explore"])
    agent = build_agent(row, TASK, change(SIZES["debug"], {"learning.value_lr": 1.0}))
    critics = [agent.behaviour(name).loss.value_loss for name in agent.behaviours]
    stepper = make_stepper(agent, Training(target_rate=rate))
    befores = [critic.target_value_model_params.clone() for critic in critics]
    stepper.step(None, random_records(TASK, 2, 5))
    for critic, before in zip(critics, befores, strict=True):
        moved = 0.0
        for key, slow in critic.target_value_model_params.items(True, True):
            if isinstance(slow, torch.Tensor) and slow.is_floating_point():
                new = critic.value_model_params[key].detach()
                torch.testing.assert_close(slow, (1 - rate) * before[key] + rate * new)
                moved = max(moved, float((new - before[key]).abs().max()))
        assert moved > 0.01


@shows("Training.loggers")
def test_loggers(run: Callable[..., Run], tmp_path: Path) -> None:
    run(tmp_path / "plain", updates=1)
    run(tmp_path / "board", updates=1, loggers=("tensorboard",))
    assert not (tmp_path / "plain" / "tensorboard").exists()
    assert list((tmp_path / "board" / "tensorboard").rglob("events*"))


@shows("Training.changed")
def test_changed(run: Callable[..., Run], tmp_path: Path) -> None:
    run(tmp_path / "run", updates=1)
    with pytest.raises(CheckpointError, match=r"training\.final_lr: 0\.1 there, 0\.5 here"):
        run(tmp_path / "run", updates=2, final_lr=0.5)
    assert len(run(tmp_path / "run", updates=2, final_lr=0.5, changed=("final_lr",)).batches) == 1


# The recipe.


@pytest.fixture
def episodes(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """What evaluations were made of; they are not simulated."""
    seen: list[dict[str, Any]] = []

    class Envs:
        def __init__(self, task: Any, **settings: Any) -> None:
            self.settings = {"task": task, **settings}

        def run(self, policy: Any, goals: torch.Tensor, **images: Any) -> TensorDict:
            seen.append({**self.settings, "goals": goals})
            place = torch.zeros(len(goals), 2, 1, 2)
            return TensorDict({"object_position_true": place, "goal_position": torch.zeros(len(goals), 2, 2)})

        def close(self) -> None:
            pass

    monkeypatch.setattr(landmarks, "EvaluationEnvs", Envs)
    return seen


POINTS = ((0.1, 0.0), (0.0, 0.1), (-0.1, 0.0), (0.0, -0.1))


@pytest.fixture
def train(command: Callable[..., str], tmp_path: Path, dataset: EpisodeDataset) -> Callable[..., str]:
    """The recipe with few updates, on a task with landmarks."""
    task = reacher_task(16)
    object.__setattr__(task, "workspace", Workspace(low=(-0.24, -0.24), high=(0.24, 0.24), landmarks=POINTS))
    path = random_dataset(tmp_path / "data", task).path
    short = ("training.updates=2", "training.eval_interval=0", "training.video_interval=0", "size=debug")
    return lambda *arguments: command("train_offline", *short, f"dataset={path}", *arguments)


@shows("Training.eval_episodes", "Training.eval_steps", "Workspace.landmarks")
def test_evaluations_while_training(train: Callable[..., str], episodes: list[dict[str, Any]]) -> None:
    settings = ("training.eval_interval=1", "training.eval_episodes=3", "training.eval_steps=7")
    settings += ("training.eval_beside=false",)
    assert "checkpoint: run/checkpoint.zip" in train(*settings, "output=run")
    assert len(episodes) == 2
    assert episodes[0]["episode_steps"] == 7
    goals = [tuple(round(x, 6) for x in goal) for goal in episodes[0]["goals"].tolist()]
    assert len(set(goals)) == 3
    assert set(goals) <= set(POINTS)


def test_without_landmarks_it_trains_and_says_once_that_there_is_nothing_to_score(
    command: Callable[..., str], dataset: EpisodeDataset, recwarn: pytest.WarningsRecorder
) -> None:
    short = ("training.updates=2", "training.video_interval=0", "size=debug", f"dataset={dataset.path}", "output=run")
    assert "checkpoint: run/checkpoint.zip" in command("train_offline", *short, "training.eval_interval=1")
    [told] = [str(one.message) for one in recwarn if "evaluations" in str(one.message)]
    assert told.startswith(
        "no evaluations during training: the workspace of 'reacher' has no landmark goals; ocwm eval"
    )
    recwarn.clear()
    command("train_offline", *short, "training.eval_interval=0", "training.updates=3")
    assert not [one for one in recwarn if "evaluations" in str(one.message)]


@shows("Training.eval_beside")
@pytest.mark.parametrize("beside", ["true", "false"])
@pytest.mark.parametrize("script", ["train_offline", "train_online"])
def test_evaluations_beside_training(
    command: Callable[..., str],
    scripts: dict[str, ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    beside: str,
    script: str,
) -> None:
    task = replace(TASK, workspace=replace(TASK.workspace, landmarks=POINTS))
    dataset = random_dataset(tmp_path / "data", task)
    seen: list[Any] = []

    def note(agent: Agent, **settings: Any) -> nullcontext[None]:
        seen.append(settings["beside"])
        return nullcontext()

    monkeypatch.setattr(evaluations, "LandmarkEvaluation", note)
    monkeypatch.setattr(scripts[script], script, lambda *_, **__: Path("run", "checkpoint.zip"))
    if script == "train_online":
        monkeypatch.setattr(scripts[script], "collect_seed_steps", lambda *_, **__: dataset)
        monkeypatch.setattr(scripts[script], "make_task", lambda *_, **__: task)
        monkeypatch.setattr(scripts[script], "with_coverage", lambda *_: None)
    else:
        monkeypatch.setattr(EpisodeDataset, "open", lambda *_, **__: dataset)
    command(script, f"training.eval_beside={beside}", "training.video_interval=0", "size=debug", "output=run")
    assert seen == [beside == "true"]


@shows(
    "TrainOffline.agent", "TrainOffline.size", "TrainOffline.training", "TrainOffline.dataset", "TrainOffline.output"
)
def test_the_recipe_trains_what_it_is_told(
    train: Callable[..., str], scripts: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: dict[str, Any] = {}

    def stub(agent: Agent, dataset: EpisodeDataset, folder: Path, training: Training, **rest: Any) -> Path:
        seen.update(agent=agent, dataset=dataset, folder=folder, training=training)
        return folder / "checkpoint.zip"

    monkeypatch.setattr(scripts["train_offline"], "train_offline", stub)
    printed = train("agent=focus", "size.learning.gamma=0.5", "training.seed=3", "output=there")
    assert "checkpoint: there/checkpoint.zip" in printed
    assert seen["agent"].config == AGENTS["focus"]
    assert seen["agent"].size == change(SIZES["debug"], {"learning.gamma": 0.5})
    assert (seen["dataset"].path, seen["folder"]) == (tmp_path / "data", Path("there"))
    assert (seen["training"].seed, seen["training"].updates) == (3, 2)
    first = torch.cat([parameter.flatten() for parameter in seen["agent"].parameters()])
    train("agent=focus", "training.seed=4", "output=there")
    assert not torch.equal(first, torch.cat([parameter.flatten() for parameter in seen["agent"].parameters()]))


@shows("TrainOffline.env")
def test_the_dataset_is_of_that_environment(train: Callable[..., str], tmp_path: Path) -> None:
    said = f"DatasetError: {tmp_path}/data: holds reacher, not env=cube_move; give env.name=reacher"
    assert train("env=cube_move", "output=run") == said
    kept = to_dict(EpisodeDataset.open(tmp_path / "data").metadata["options"])
    train("env.options.horizon=3", "output=run")
    assert f"options: {kept}" in (tmp_path / "run" / "config.yaml").read_text()  # what the dataset was made with
