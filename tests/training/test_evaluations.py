"""Evaluations that go on beside the updates, in runs."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrl_ocwm.agents import SIZES, Agent, build_agent
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.envs import make_task
from torchrl_ocwm.evaluation import LandmarkEvaluation
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import random_dataset, reacher_task
from torchrl_ocwm.training import cores
from torchrl_ocwm.training.cores import evaluates_beside, update_threads
from torchrl_ocwm.training.evaluations import EvaluationError, Later
from torchrl_ocwm.training.hooks import UpdateClock
from torchrl_ocwm.training.offline import train_offline
from torchrl_ocwm.training.settings import Training

SHORT = Training(updates=12, log_interval=2, checkpoint_interval=4, eval_interval=4)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> EpisodeDataset:
    return random_dataset(tmp_path_factory.mktemp("data") / "random", reacher_task())


def fresh() -> Agent:
    torch.manual_seed(0)
    return build_agent("dreamer_pcp", reacher_task(), "debug")


class Slow:
    """Scores that are there when they have been asked for some times: an update asks once."""

    def __init__(self, updates: int, asks: int, answer: Callable[[], None] = lambda: None) -> None:
        self.updates, self.asks, self.before = updates, asks, answer
        self.waited = 0

    def done(self) -> bool:
        self.asks -= 1
        return self.asks < 0

    def answer(self) -> dict[str, float]:
        self.waited = max(self.asks, 0)
        self.before()
        return {"evaluation/score": float(self.updates)}


def scores(folder: Path) -> list[str]:
    return (folder / "log" / "scalars" / "evaluation" / "score.csv").read_text().split()


@pytest.mark.parametrize("asks", [0, 2, 100])
def test_scores_are_logged_at_their_updates_and_not_waited_for_before_the_next(
    dataset: EpisodeDataset, tmp_path: Path, asks: int
) -> None:
    made: list[Slow] = []

    def evaluate(updates: int) -> Slow:
        assert not made or made[-1].asks <= 0 or made[-1].waited, "two at a time"
        made.append(Slow(updates, asks))
        return made[-1]

    file = train_offline(fresh(), dataset, tmp_path, SHORT, evaluate=evaluate, progress=False)
    assert file.exists()
    assert scores(tmp_path) == ["4,4.0", "8,8.0", "12,12.0"]
    assert [one.waited > 0 for one in made[:2]] == [asks == 100] * 2


def test_scores_come_while_training_goes_on(dataset: EpisodeDataset, tmp_path: Path) -> None:
    seen: list[bool] = []

    def evaluate(updates: int) -> Slow:
        slow = Slow(updates, 2)
        slow.before = lambda: seen.append(True)
        return slow

    clock = UpdateClock.__iter__
    file = tmp_path / "log" / "scalars" / "evaluation" / "score.csv"
    found: dict[int, int] = {}

    def ticks(self: UpdateClock) -> object:
        for update, tick in enumerate(clock(self)):
            found[update] = len(file.read_text().split()) if file.exists() else 0
            yield tick

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(UpdateClock, "__iter__", ticks)
        train_offline(fresh(), dataset, tmp_path, SHORT, evaluate=evaluate, progress=False)
    assert (found[6], found[7]) == (0, 1)  # asked after updates 5, 6 and 7
    assert len(seen) == 3


def fails() -> None:
    raise OSError("no display")


def bug() -> None:
    raise TypeError("a bug")


@pytest.mark.parametrize(
    ("asks", "kept"), [(0, "update 5"), (2, "update 7"), (100, "update 8")], ids=["soon", "later", "at the next"]
)
def test_one_that_fails_is_named_and_the_run_is_kept(
    dataset: EpisodeDataset, tmp_path: Path, asks: int, kept: str
) -> None:
    message = rf"evaluation after 4 updates failed \(OSError: no display\); the checkpoint of {kept} is kept"
    with pytest.raises(EvaluationError, match=message):
        train_offline(
            fresh(), dataset, tmp_path, SHORT, evaluate=lambda updates: Slow(updates, asks, fails), progress=False
        )
    resumed, through = fresh(), fresh()
    train_offline(resumed, dataset, tmp_path, SHORT, progress=False)
    train_offline(through, dataset, tmp_path / "through", SHORT, progress=False)
    for one, other in zip(resumed.state_dict().values(), through.state_dict().values(), strict=True):
        assert torch.equal(one, other)


def test_a_bug_in_one_shows_its_traceback(dataset: EpisodeDataset, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="after 4 updates failed") as raised:
        train_offline(fresh(), dataset, tmp_path, SHORT, evaluate=lambda n: Slow(n, 0, bug), progress=False)
    assert type(raised.value) is RuntimeError
    assert isinstance(raised.value.__cause__, TypeError)


@pytest.mark.parametrize("at_end", [False, True])
def test_a_signal_does_not_wait(dataset: EpisodeDataset, tmp_path: Path, at_end: bool) -> None:
    """Neither for one that is under way when the next is due, nor for the last."""

    def hang() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(600)

    training = replace(SHORT, eval_interval=12) if at_end else SHORT
    start = time.monotonic()
    train_offline(
        fresh(), dataset, tmp_path, training, evaluate=lambda updates: Slow(updates, 100, hang), progress=False
    )
    assert time.monotonic() - start < 300
    assert not (tmp_path / "log" / "scalars" / "evaluation").exists()


@pytest.mark.parametrize("killed", [False, True])
def test_a_process_that_evaluates(tmp_path: Path, killed: bool) -> None:
    """Training is as without it, and outlives it."""
    task = make_task("reacher")
    dataset = random_dataset(tmp_path / "data", task)
    training = replace(SHORT, updates=6, eval_interval=2, checkpoint_interval=100)
    alone, watched = (build_agent("focus_lcp", task, "debug") for _ in range(2))
    watched.load_state_dict(alone.state_dict())
    train_offline(alone, dataset, tmp_path / "alone", training, progress=False)
    with LandmarkEvaluation(watched, episodes=2, episode_steps=3, beside=True) as evaluation:

        def evaluate(updates: int) -> dict[str, float] | Later:
            if killed and updates == 4:
                [child] = multiprocessing.active_children()
                child.kill()
            return evaluation(updates)

        with pytest.raises(EvaluationError, match="SIGKILL") if killed else nullcontext():
            train_offline(watched, dataset, tmp_path / "watched", training, evaluate=evaluate, progress=False)
    rows = (tmp_path / "watched" / "log" / "scalars" / "evaluation" / "success.csv").read_text().split()
    assert [row.partition(",")[0] for row in rows] == (["2"] if killed else ["2", "4", "6"])
    if killed:
        train_offline(watched, dataset, tmp_path / "watched", training, progress=False)
    for one, other in zip(alone.state_dict().values(), watched.state_dict().values(), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize(("units", "threads"), [(16, 1), (128, 1), (256, 0)])
def test_small_networks_are_updated_in_one_thread(units: int, threads: int) -> None:
    size = change(SIZES["debug"], {"architecture.mlp_units": units})
    assert update_threads(Training(), size) == threads
    assert update_threads(Training(threads=3), size) == 3
    assert update_threads(Training(threads=0), size) == 0


@pytest.mark.parametrize(
    ("settings", "size", "free", "beside"),
    [
        ({}, "cpu", 2, True),
        ({}, "cpu", 1, False),
        ({"threads": 2}, "cpu", 2, False),
        ({"threads": 2}, "cpu", 4, True),
        ({}, "small", 4, False),  # PyTorch takes all cores
        ({"device": "cuda:0"}, "small", 4, True),
        ({"eval_beside": True}, "cpu", 1, True),
        ({"eval_beside": False}, "cpu", 4, False),
    ],
)
def test_evaluations_run_beside_where_a_core_is_free(
    monkeypatch: pytest.MonkeyPatch, settings: dict[str, object], size: str, free: int, beside: bool
) -> None:
    monkeypatch.setattr(cores, "_cores", lambda: free)
    monkeypatch.setattr(torch, "get_num_threads", lambda: free)
    assert evaluates_beside(Training(**settings), SIZES[size]) is beside  # type: ignore[arg-type]
