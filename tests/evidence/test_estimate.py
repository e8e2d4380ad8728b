"""How long runs take: as others of their kind did here, or by a short timing."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.devices import DeviceError
from torchrl_ocwm.evidence import (
    Collected,
    Drawn,
    Evaluated,
    Explored,
    Machine,
    Record,
    Run,
    Trained,
    estimate,
    forecast,
    table,
)
from torchrl_ocwm.evidence.estimate import Forecast, Paces
from torchrl_ocwm.origin import machine
from torchrl_ocwm.settings import to_dict
from torchrl_ocwm.testing import reacher_task
from torchrl_ocwm.training.stepper import Stepper

TINY = {"image_size": 16, "horizon": 20}
DATA = Collected(env="reacher", options=TINY, policies={"random": 100})
TRAINED = Trained(data=DATA, agent="dreamer", size="debug", seed=0, updates=50)
EVALUATED = Evaluated(trained=TRAINED, goals=4, episode_steps=5)
RUNS = (DATA, TRAINED, EVALUATED)


def keep(run: Run, root: Path, seconds: float, *, done: bool = True, where: str | None = None) -> None:
    where = machine() if where is None else where
    record = Record(content=to_dict(run.content), pace=run.pace, work=run.work, machine=where)
    replace(record, seconds=seconds, done=done).write(root / run.name)


@pytest.fixture
def no_timing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Paces, "_measure", lambda self, run: 1.0)


@pytest.mark.usefixtures("no_timing")
def test_what_others_took_counts(tmp_path: Path) -> None:
    """The median of those that are done, by the work of each; only on this machine."""
    for seed, seconds in ((1, 100.0), (2, 200.0), (3, 1e6)):
        keep(replace(TRAINED, seed=seed), tmp_path, seconds)
    keep(replace(TRAINED, seed=4), tmp_path, 1.0, done=False)
    keep(replace(TRAINED, seed=5), tmp_path, 1.0, where="another")
    [longer] = forecast([replace(TRAINED, updates=500)], tmp_path, Machine())
    assert longer == Forecast(longer.run, "to do", pytest.approx(2010), False)
    [changed] = forecast([replace(TRAINED, changes={"world_model.lambda_proprio": 2})], tmp_path, Machine())
    assert changed.seconds == pytest.approx(210)
    for other in ({"agent": "focus"}, {"size": "cpu"}, {"data": replace(DATA, options={})}):
        [unlike] = forecast([replace(TRAINED, **other)], tmp_path, Machine())
        assert unlike.seconds == pytest.approx(60)


@pytest.mark.usefixtures("no_timing")
def test_what_others_took_on_a_gpu_counts_on_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert machine("cuda") == machine()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "a GPU")
    keep(replace(TRAINED, seed=1), tmp_path, 100.0, where=machine("cuda"))
    for device, seconds in (("cpu", 60), ("cuda", 110)):
        [found] = forecast([TRAINED], tmp_path, Machine(device=device))
        assert found.seconds == pytest.approx(seconds)


def test_there_must_be_such_a_device(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match=r"device 'gpu' cannot be used"):
        forecast([TRAINED], tmp_path, Machine(device="gpu"))


@pytest.mark.usefixtures("no_timing")
def test_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep(DATA, tmp_path, 200.0)
    monkeypatch.setattr(Trained, "reached", lambda self, root: 20)
    monkeypatch.setattr(Collected, "reached", lambda self, root: self.work)
    found = forecast(RUNS, tmp_path, Machine())
    assert [(one.state, one.seconds, one.done) for one in found] == [
        ("done", 200, True),
        ("20 of 50", 40, False),
        ("to do", 30, False),
    ]
    lines = table(found, 1, {TRAINED.name: "dreamer, weights 1"}).splitlines()
    assert lines[2] == f"| {DATA.name} | all | done | 3 min |"
    assert lines[3] == f"| {TRAINED.name} | dreamer, weights 1 | 20 of 50 | 40 s |"
    assert lines[-1] == "2 of 3 runs to do, 1 at a time: about 70 s here."
    assert table(found, 2, {}).endswith("2 at a time: about 40 s here.")  # the longest takes its time
    assert table(found[:1], 2, {}).endswith("All 1 runs are done.")


@pytest.mark.parametrize("agent", ["dreamer", "lexa_temporal"])
def test_a_short_timing(agent: str, tmp_path: Path) -> None:
    trained = replace(TRAINED, agent=agent)
    explored = Explored(env="reacher", options=TINY, explorer="plan2explore", size="debug", steps=100)
    paces = Paces(tmp_path, Machine())
    drawn = Drawn(env="reacher", options={**TINY, "virtual_target": 5}, plain=DATA)
    for run in (DATA, drawn, explored, trained, replace(EVALUATED, trained=trained)):
        start = time.perf_counter()
        pace = paces[run]
        took = time.perf_counter() - start  # however busy the machine is
        assert 1e-5 < pace <= took * max(1.0, trained.steps_played / trained.updates)
        assert paces[run] == pace  # timed once


def test_an_explorer_plays_and_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of an update per step."""
    monkeypatch.setattr(estimate, "seconds_of_a_step", lambda run: 2.0)
    monkeypatch.setattr(estimate, "seconds_of_an_update", lambda agent, how: 10.0)
    explored = Explored(env="reacher", options=TINY, explorer="plan2explore", size="debug", steps=100)
    assert Paces(tmp_path, Machine())[explored] == 3.0


def test_updates_are_timed_with_the_threads_of_the_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(estimate, "_seconds", lambda function, times: torch.get_num_threads())
    before, agent = torch.get_num_threads(), build_agent("dreamer", reacher_task(16), "debug")
    assert estimate.seconds_of_an_update(agent, Machine(threads=before + 1)) == before + 1
    assert torch.get_num_threads() == before


def test_updates_that_a_gpu_captures_are_captured_first(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []
    monkeypatch.setattr(Stepper, "resolve", lambda self, device: (False, True))
    monkeypatch.setattr(Stepper, "warmup", lambda self, sample: seen.append("warmup"))
    monkeypatch.setattr(Stepper, "step", lambda self, trainer, sample: seen.append("step"))
    estimate.seconds_of_an_update(build_agent("dreamer", reacher_task(16), "debug"), Machine())
    assert seen[:2] == ["warmup", "step"]


def test_episodes_that_are_played_meanwhile_take_their_time(tmp_path: Path) -> None:
    """With long ones most of the time is theirs."""
    short, long = (replace(TRAINED, updates=10, episode_steps=steps) for steps in (1, 100_000))
    assert (short.steps_played, long.steps_played) == (50, 5_000_000)
    assert Paces(tmp_path, Machine())[long] > 10 * Paces(tmp_path, Machine())[short]
