from __future__ import annotations

import errno
import json
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl.checkpoint import Checkpoint, CheckpointError

import torchrl_ocwm
from torchrl_ocwm.agents import SIZES, Agent, build_agent
from torchrl_ocwm.agents.checkpoint import describe, rebuild
from torchrl_ocwm.data import DatasetError, EpisodeDataset
from torchrl_ocwm.testing import random_dataset, reacher_task
from torchrl_ocwm.training.offline import train_offline
from torchrl_ocwm.training.settings import Training

SHORT = Training(updates=12, log_interval=2, checkpoint_interval=4, eval_interval=2)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> EpisodeDataset:
    return random_dataset(tmp_path_factory.mktemp("data") / "random", reacher_task())


def fresh(name: str = "dreamer_pcp") -> Agent:
    torch.manual_seed(0)
    return build_agent(name, reacher_task(), "debug")


def train(agent: Agent, dataset: EpisodeDataset, folder: Path, training: Training = SHORT, **kwargs: Any) -> Path:
    return train_offline(agent, dataset, folder, training, progress=False, **kwargs)


def same(first: Agent, second: Agent) -> bool:
    pairs = zip(first.state_dict().items(), second.state_dict().items(), strict=True)
    return all(name == other and torch.equal(value, there) for (name, value), (other, there) in pairs)


def signal_at(updates: int, number: int) -> Callable[[int], dict[str, float]]:
    def evaluate(now: int) -> dict[str, float]:
        if now == updates:
            os.kill(os.getpid(), number)
        return {}

    return evaluate


class TestResume:
    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
    def test_stopped_and_continued_is_as_never_stopped(
        self, dataset: EpisodeDataset, tmp_path: Path, number: int
    ) -> None:
        """Bit for bit: parameters, slow critic, return statistics."""
        through = fresh()
        train(through, dataset, tmp_path / "through")
        for stop in (4, 10):
            part = fresh()
            train(part, dataset, tmp_path / "parts", evaluate=signal_at(stop, number))
            assert not same(part, through)
        last = fresh()
        train(last, dataset, tmp_path / "parts")
        assert same(last, through)

    def test_training_changes_everything(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        before, after = fresh(), fresh()
        train(after, dataset, tmp_path)
        parts = {"model": [], "actor": [], "loss": []}
        for (name, old), new in zip(before.named_parameters(), after.parameters(), strict=True):
            parts[name.split(".")[0]].append(not torch.equal(old, new))
        for part in ("model", "actor"):
            assert all(parts[part])

    def test_a_finished_run_is_left_alone(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        file = train(fresh(), dataset, tmp_path)
        before = file.read_bytes()
        again = fresh()
        train(again, dataset, tmp_path)
        assert file.read_bytes() == before
        assert not same(again, fresh())  # it was loaded

    def test_looking_changes_nothing(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        watched, alone = fresh(), fresh()
        train(watched, dataset, tmp_path / "watched", evaluate=lambda updates: {"noise": float(torch.rand(1))})
        train(alone, dataset, tmp_path / "alone")
        assert same(watched, alone)

    def test_seed_changes_the_run(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        first, second = fresh(), fresh()
        train(first, dataset, tmp_path / "first")
        train(second, dataset, tmp_path / "second", replace(SHORT, seed=1))
        assert not same(first, second)


class TestLogs:
    def test_csv(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        train(fresh(), dataset, tmp_path, evaluate=lambda updates: {"evaluation/score": float(updates)})
        scalars = tmp_path / "log" / "scalars"
        assert (scalars / "evaluation" / "score.csv").read_text().split() == [
            f"{n},{float(n)}" for n in (2, 4, 6, 8, 10, 12)
        ]
        assert len((scalars / "loss_actor.csv").read_text().split()) == 6


class TestLoadAgent:
    def test_acts_like_the_trained_agent(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        agent = fresh()
        policy = torchrl_ocwm.load_agent(train(agent, dataset, tmp_path))
        step = dataset.records["next"][:3].exclude("reward", "done", "terminated").clone()
        step["is_init"] = torch.ones(3, 1, dtype=torch.bool)
        actions = []
        for one in (policy, agent.policy()):
            torch.manual_seed(1)
            actions.append(one(step.clone())["action"])
        torch.testing.assert_close(*actions, rtol=0, atol=0)
        assert not any(parameter.requires_grad for parameter in policy.parameters())

    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(CheckpointError, match="no such checkpoint"):
            torchrl_ocwm.load_agent(tmp_path / "none.zip")

    def test_not_a_checkpoint(self, tmp_path: Path) -> None:
        (tmp_path / "x.zip").write_text("hello")
        with pytest.raises(CheckpointError, match=r"x\.zip: not a checkpoint of TorchRL"):
            torchrl_ocwm.load_agent(tmp_path / "x.zip")

    def test_foreign(self, tmp_path: Path) -> None:
        Checkpoint(format="archive", loss_module=torch.nn.Linear(1, 1)).save(tmp_path / "x.zip")
        with pytest.raises(CheckpointError, match="not of an agent of torchrl_ocwm"):
            torchrl_ocwm.load_agent(tmp_path / "x.zip")


class TestOtherReleases:
    """Descriptions in checkpoints, with settings that this release does not have or that are not there yet."""

    def description(self) -> dict[str, Any]:
        return json.loads(json.dumps(describe(fresh("focus_lcp"))))

    def test_settings_that_came_later_take_their_defaults(self) -> None:
        description = self.description()
        del description["agent"]["lambda_positional"], description["size"]["gamma"]
        agent = rebuild(description)
        assert (agent.config.lambda_positional, agent.size.gamma) == (1.0, 0.99)

    def test_settings_that_are_gone(self) -> None:
        description = self.description()
        description["agent"]["colour"] = "red"
        del description["size"]["belief"]
        with pytest.raises(CheckpointError, match=r"another release: AgentConfig differs in \['colour'\]"):
            rebuild(description)
        del description["agent"]["colour"]
        with pytest.raises(CheckpointError, match=r"another release: Size differs in \['belief'\]"):
            rebuild(description)


class TestBadInput:
    def test_checkpoint_of_another_agent(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        file = train(fresh("dreamer"), dataset, tmp_path)
        before = file.read_bytes()
        with pytest.raises(CheckpointError, match=r"another agent \(agent\.goal: none there, position here"):
            train(fresh(), dataset, tmp_path)
        assert file.read_bytes() == before

    def test_dataset_of_another_task(self, tmp_path: Path) -> None:
        other = random_dataset(tmp_path / "data", reacher_task(32))
        with pytest.raises(DatasetError, match="but the agent was built for"):
            train(fresh(), other, tmp_path / "run")

    def test_sequences_longer_than_episodes(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        agent = build_agent("dreamer_pcp", reacher_task(), replace(SIZES["debug"], slice_len=21))
        with pytest.raises(DatasetError, match="cannot cut sequences of 21 frames, the longest episode has 20"):
            train(agent, dataset, tmp_path)

    def test_folder_that_cannot_be_written(self, dataset: EpisodeDataset, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(CheckpointError, match="cannot write here .* choose another output folder"):
            train(fresh(), dataset, tmp_path / "file" / "run")

    def test_full_disk_keeps_the_checkpoint_before(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        file = train(fresh(), dataset, tmp_path, evaluate=signal_at(4, signal.SIGTERM))
        before = file.read_bytes()

        def full(*args: Any, **kwargs: Any) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        with monkeypatch.context() as patch:
            patch.setattr(Checkpoint, "save", full)
            with pytest.raises(CheckpointError, match="No space left on device.*before it is kept"):
                train(fresh(), dataset, tmp_path)
        assert file.read_bytes() == before
        resumed, through = fresh(), fresh()
        train(resumed, dataset, tmp_path)
        train(through, dataset, tmp_path / "through")
        assert same(resumed, through)

    def test_a_write_that_breaks_off_leaves_the_checkpoint_before(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The new checkpoint takes the old one's place in one step, when it is whole."""
        file = train(fresh(), dataset, tmp_path, evaluate=signal_at(4, signal.SIGTERM))
        before = file.read_bytes()

        def broken(*args: Any, **kwargs: Any) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", broken)
            with pytest.raises(CheckpointError, match="before it is kept"):
                train(fresh(), dataset, tmp_path)
        assert file.read_bytes() == before

    def test_losses_that_are_not_finite(
        self, dataset: EpisodeDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        file = train(fresh(), dataset, tmp_path, evaluate=signal_at(4, signal.SIGTERM))
        before = file.read_bytes()
        from torchrl_ocwm.data import RelabelGoals

        relabel = RelabelGoals.forward

        def spoiled(self: Any, batch: Any) -> Any:
            batch = relabel(self, batch)
            batch["next", "proprio"] = torch.full_like(batch["next", "proprio"], torch.nan)
            return batch

        monkeypatch.setattr(RelabelGoals, "forward", spoiled)
        with pytest.raises(FloatingPointError, match=r"after 6 updates .*loss_model_proprio.* is not finite"):
            train(fresh(), dataset, tmp_path)
        assert file.read_bytes() == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"updates": 0}, "updates must be at least 1"),
        ({"updates": 75}, "multiple of log_interval, got 75 and 50"),
        ({"goals": "mine"}, "goals must be one of 'uniform', 'stored', got 'mine'"),
        ({"loggers": ("paper",)}, "loggers must be one of 'tensorboard', 'wandb', got 'paper'"),
    ],
)
def test_bad_settings(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Training(**changes)
