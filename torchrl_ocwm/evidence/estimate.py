"""How long runs will take here."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchrl_ocwm.agents import AGENTS, SIZES, Agent, build_agent
from torchrl_ocwm.devices import usable_device
from torchrl_ocwm.envs import DrawTarget, Task, make_env, make_task
from torchrl_ocwm.evaluation.episodes import EvaluationEnvs
from torchrl_ocwm.evidence.datasets import Collected, Data, Drawn, Explored
from torchrl_ocwm.evidence.queue import to_do
from torchrl_ocwm.evidence.records import RECORD, Record
from torchrl_ocwm.evidence.run import Run
from torchrl_ocwm.evidence.settings import Machine
from torchrl_ocwm.evidence.trainings import Evaluated, Trained
from torchrl_ocwm.origin import machine
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import random_records
from torchrl_ocwm.training import Training, make_stepper

_UPDATES, _STEPS = 2, 10  # that are timed
_START = 10.0  # seconds that a process takes before it begins


@dataclass(frozen=True)
class Forecast:
    """What is left of a run.

    Args:
        run: The run.
        state: ``done``, how far it is, or ``to do``.
        seconds: Seconds that it will take, or has taken if it is done.
        done: Whether it is done.
    """

    run: Run
    state: str
    seconds: float
    done: bool


def forecast(runs: Sequence[Run], root: Path, how: Machine) -> list[Forecast]:
    """How far each run is, and how long it will take: as long as others of its kind did here, or by a short timing."""
    paces = Paces(root, how)
    names = to_do(runs, root)
    return [_forecast(run, root, paces, done=run.name not in names) for run in runs]


def _forecast(run: Run, root: Path, paces: Paces, *, done: bool) -> Forecast:
    if done:
        return Forecast(run, "done", Record.of(run, root).seconds, True)
    reached = run.reached(root)
    seconds = _START + paces[run] * max(0, run.work - reached)
    return Forecast(run, f"{reached:,} of {run.work:,}" if reached else "to do", seconds, False)


def table(forecasts: Sequence[Forecast], slots: int, rows: Mapping[str, str]) -> str:
    """The runs, their states and times, and the time for all.

    Args:
        forecasts: Of the runs.
        slots: How many are done at a time.
        rows: Names of runs → rows of the figure that they are for.
    """
    lines = ["| run | for | state | time |", "|---|---|---|---|"]
    for one in forecasts:
        row, time_there = rows.get(one.run.name, "all"), in_words(one.seconds)
        lines.append(f"| {one.run.name} | {row} | {one.state} | {time_there} |")
    left = [one.seconds for one in forecasts if not one.done]
    if not left:
        return "\n".join([*lines, "", f"All {len(forecasts)} runs are done."])
    # The longest run takes its time, however many there are room for.
    seconds = max(sum(left) / slots, max(left))
    total = f"{len(left)} of {len(forecasts)} runs to do, {slots} at a time: about {in_words(seconds)} here."
    return "\n".join([*lines, "", total])


def in_words(seconds: float) -> str:
    """A time as people say it.

    Examples:
        >>> in_words(4), in_words(200), in_words(9000)
        ('4 s', '3 min', '2.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class Paces:
    """Seconds for a step or an update of a run.

    Args:
        root: Folder of all runs, whose records are asked first.
        how: How runs go.
    """

    def __init__(self, root: Path, how: Machine) -> None:
        self.how = how
        known: dict[str, list[float]] = {}
        here = machine(how.device)
        for file in root.glob(f"*/*/{RECORD}"):
            record = Record.read(file)
            if record.done and record.machine == here:
                known.setdefault(record.pace, []).append(record.seconds / record.work)
        self._known = {pace: statistics.median(seconds) for pace, seconds in known.items()}

    def __getitem__(self, run: Run) -> float:
        if run.pace not in self._known:
            self._known[run.pace] = self._measure(run)
        return self._known[run.pace]

    def _measure(self, run: Run) -> float:
        if isinstance(run, Collected):
            return seconds_of_a_step(run)
        if isinstance(run, Drawn):
            return seconds_of_a_drawing(make_task(run.env, **run.options))
        if isinstance(run, Explored):
            agent = _agent(make_task(run.env, **run.options), run.explorer, run.size)
            return seconds_of_a_step(run) + run.updates / run.steps * seconds_of_an_update(agent, self.how)
        assert isinstance(run, (Trained, Evaluated))
        trained = run.trained if isinstance(run, Evaluated) else run
        task = make_task(trained.data.env, **trained.data.options)
        acting = seconds_of_acting(_agent(task, trained.agent, trained.size, trained.changes))
        if isinstance(run, Evaluated):
            return acting
        agent = _agent(task, trained.agent, trained.size, trained.changes)
        return seconds_of_an_update(agent, self.how) + acting * run.steps_played / run.updates


def seconds_of_an_update(agent: Agent, how: Machine) -> float:
    """Of an agent, on random records; the first update is not counted.

    Raises:
        DeviceError: if there is no such device here.
    """
    device, threads = usable_device(how.device), torch.get_num_threads()
    torch.set_num_threads(how.threads)
    try:
        stepper = make_stepper(agent.to(device).train(), Training(device=how.device))
        learning = agent.size.learning
        batch = random_records(agent.task, learning.batch_size, learning.slice_len).to(device)
        if any(stepper.resolve(device)):
            stepper.warmup(batch.copy())
        stepper.step(None, batch.copy())
        return _seconds(lambda: [stepper.step(None, batch.copy()) for _ in range(_UPDATES)], _UPDATES)
    finally:
        torch.set_num_threads(threads)


def seconds_of_a_step(run: Data) -> float:
    """Of the environment of a dataset, with random actions."""
    with closing(make_env(run.env, **run.options)) as env:
        env.rollout(1)
        return _seconds(lambda: env.rollout(_STEPS), _STEPS)


def seconds_of_a_drawing(task: Task) -> float:
    """Of a target in the image of a frame."""
    frames = random_records(task, 1, _STEPS)[0]["next"]
    draw = DrawTarget(lambda goals: goals[:, :2], 5)
    return _seconds(lambda: draw(frames), _STEPS)


def seconds_of_acting(agent: Agent) -> float:
    """Of a step of an agent that has learnt nothing yet, of several that act at the same time."""
    task, policy = agent.task, agent.policy()
    goals = task.workspace.grid(2).flatten(0, 1)
    images = torch.zeros(len(goals), 3, *task.image_shape, dtype=torch.uint8)
    given = None if policy.takes_positions else images
    with EvaluationEnvs(task, episode_steps=_STEPS, workers=0, envs=len(goals)) as envs:
        envs.run(policy, goals, images=given)
        return _seconds(lambda: envs.run(policy, goals, images=given), _STEPS * len(goals))


def _agent(task: Task, agent: str, size: str, changes: Mapping[str, Any] = {}) -> Agent:
    return build_agent(change(AGENTS[agent], changes), task, SIZES[size])


def _seconds(function: Callable[[], object], times: int) -> float:
    """Of one of so many parts of what a function does."""
    start = time.perf_counter()
    function()
    return (time.perf_counter() - start) / times
