"""Train an agent on a dataset that it adds to."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import BaseCollector
from torchrl.trainers.algorithms import DreamerV3UpdateRatio

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.agents.checkpoint import collecting_policy, describe, rebuild
from torchrl_ocwm.data import STORED, Collection, EpisodeDataset, collect, episode_to_records, position_reward
from torchrl_ocwm.data.collect import check_failures, count_episode
from torchrl_ocwm.devices import usable_device
from torchrl_ocwm.envs import find_environment, make_env
from torchrl_ocwm.settings import from_dict
from torchrl_ocwm.training.collectors import NUMBER, Turns, end, make_collector, next_episodes, send_weights
from torchrl_ocwm.training.evaluations import Evaluate
from torchrl_ocwm.training.hooks import ProgressBar, StopOnSignals, UpdateClock
from torchrl_ocwm.training.run import CHECKPOINT, SHOWN, Film, Run, check_task, own
from torchrl_ocwm.training.settings import Online, Training

_NEXT = "next_online_episode"
_CHUNK = 100  # steps that a process plays before it reports, where an environment has no horizon


def collect_seed_steps(
    path: str | Path,
    environment: str,
    online: Online,
    *,
    seed: int = 0,
    options: dict[str, Any] | None = None,
    progress: bool = True,
) -> EpisodeDataset:
    """Collect the seed steps of an online run (:func:`~torchrl_ocwm.data.collect`), or what is left of them.

    Args:
        path: Folder of the dataset.
        environment: Name of the environment.
        online: Who collects how many.
        seed: Seed of the run.
        options: Passed to the environment.
        progress: Show a progress bar with the rate.

    Returns:
        The dataset, open for writing.

    Raises:
        DatasetError: if the folder holds a dataset of another environment or other options, or cannot be written.
        ValueError: for an unknown policy, or a checkpoint of another task's agent.
    """
    shared = Collection(seed=seed, workers=online.workers, timeout=online.timeout)
    for policy, steps in zip(online.seed_policy, accumulate(online.seed_steps), strict=True):
        settings = replace(shared, policy=policy, steps=steps)
        acts = collecting_policy(settings, environment, options)
        collect(path, environment, settings, policy=acts, options=options, progress=progress)
    return EpisodeDataset.open(path, write=True)


def train_online(
    agent: Agent,
    dataset: EpisodeDataset,
    folder: str | Path,
    training: Training,
    online: Online,
    *,
    evaluate: Evaluate | None = None,
    film: Film | None = None,
    on_start: Callable[[], object] | None = None,
    progress: bool = True,
) -> Path:
    """Train an agent on a dataset while it adds to it; continue from the folder's checkpoint if it has one.

    The run ends after ``training.updates``. Between updates, whenever ``online.update_ratio`` says so
    (:class:`~torchrl.trainers.algorithms.DreamerV3UpdateRatio`), the agent plays a round of episodes with the weights
    of that moment, and the next update can have them. Actions are drawn, as in every collection.

    The run may be killed at any moment: the dataset then holds the whole episodes played so far, and a run that goes
    on makes up for the updates since its last checkpoint. SIGTERM and Ctrl-C end it at once, with a checkpoint. With
    ``collector="sync"`` a run that they stopped while it updated goes on like one that never stopped.

    Args:
        agent: The agent, with fresh weights.
        dataset: Open for writing, with the first episodes (:func:`collect_seed_steps`).
        folder: Where checkpoint and logs go. One run at a time writes to it.
        training: The settings of training.
        online: How it collects.
        evaluate: As in :func:`~torchrl_ocwm.training.offline.train_offline`.
        film: As there.
        on_start: Called once, when nothing stands against the run and before its first update.
        progress: Show a progress bar.

    Returns:
        The checkpoint.

    Raises:
        CollectionError: if one episode after the other fails.
        MissingPackageError: if Ray is asked for and missing.
        Exception: what :func:`~torchrl_ocwm.training.offline.train_offline` raises.
    """
    folder = Path(folder)
    training = replace(training, device=str(usable_device(training.device)))
    bar = ProgressBar(SHOWN, disable=not progress)
    check_task(agent, dataset)
    player = Player(agent, dataset, online, seed=training.seed)
    clock = CollectingClock(player, online)
    with own(folder):
        try:
            run = Run(agent, dataset, folder / CHECKPOINT, training, bar, clock=clock, grows=True)
            run.trainer.register_op("post_steps_log", player.log)
            player.stop = run.stop
            return run.go(evaluate, film, on_start)
        finally:
            player.close()


class CollectingClock(UpdateClock):
    """Ticks for each update that is due, and has a round of episodes played when none is.

    Args:
        player: Plays them.
        online: When updates are due.
    """

    def __init__(self, player: Player, online: Online) -> None:
        self.player, self.online = player, online
        self._ratio = DreamerV3UpdateRatio(online.update_ratio)
        self._due = online.seed_updates - 1  # the ratio begins with one

    def __iter__(self) -> Iterator[TensorDictBase]:
        while True:
            dataset = self.player.dataset
            self._due += self._ratio(dataset.num_steps)
            while self._due <= 0 and dataset.num_steps < self.online.steps:
                self.player.play_round()
                if self.player.stop.stopped:
                    return
                self._due += self._ratio(dataset.num_steps)
            self._due -= 1
            yield TensorDict({}, [1])

    def state_dict(self) -> dict[str, Any]:
        """Updates that are due, and the steps that they were counted up to."""
        return {"due": self._due, "counted": self._ratio.state_dict()["previous"]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on counting, with the ratio of now; that of an offline run is empty, and counting begins."""
        if state_dict:
            self._due = state_dict["due"]
            self._ratio.load_state_dict({"ratio": self.online.update_ratio, "previous": state_dict["counted"]})


class Player:
    """Plays episodes with the weights that an agent has, and appends them to a dataset.

    Collectors that fail are replaced, and their unfinished episodes left out. They are started when they are needed.

    Args:
        agent: The agent, in training.
        dataset: The dataset, open for writing.
        online: Which collector, and who acts.
        seed: Seed of the run.

    Attributes:
        stop: Breaks a round off when a signal comes.

    Raises:
        ValueError: for a behaviour that the agent does not have.
    """

    stop: StopOnSignals

    def __init__(self, agent: Agent, dataset: EpisodeDataset, online: Online, *, seed: int) -> None:
        self.dataset, self.online = dataset, online
        self.behaviours = online.behaviours or tuple(agent.behaviours)
        self._objects = [agent.policy(name).object_index for name in self.behaviours]
        self._learning = Turns(agent, self.behaviours, seed=seed)
        copy = rebuild(describe(agent)).eval().requires_grad_(False)
        self._acting = Turns(copy, self.behaviours, seed=seed)
        self._collector: BaseCollector | None = None
        self._batches: Iterator[TensorDictBase] = iter(())
        self._sent = False
        self._failures = 0
        self._played: dict[str, float] = {}

    def play_round(self) -> None:
        """Play at least ``round_episodes`` episodes, or what is left of ``steps``.

        Raises:
            CollectionError: if one episode after the other fails.
        """
        self._acting.load_state_dict(self._learning.state_dict())
        self._sent = False
        rewards: list[float] = []
        while self._wants_more(len(rewards)) and not self.stop.stopped:
            for episode in self.stop.look(self._next_episodes) or ():
                self._append(episode)
                rewards.append(self._mean_reward(episode))
        if rewards:
            mean = sum(rewards) / len(rewards)
            self._played = {"collected/steps": float(self.dataset.num_steps), "collected/reward": mean}

    def log(self, batch: TensorDictBase) -> dict[str, float] | None:  # noqa: ARG002
        """What there is to log since the last call: steps of the dataset, mean reward of the round."""
        played, self._played = self._played, {}
        return played or None

    def close(self) -> None:
        """End the collector."""
        if self._collector is not None:
            end(self._collector)
        self._collector = None

    def _wants_more(self, played: int) -> bool:
        return played < self.online.round_episodes and self.dataset.num_steps < self.online.steps

    def _next_episodes(self) -> list[TensorDictBase]:
        try:
            if self._collector is None:
                self._start()
            assert self._collector is not None
            if not self._sent:
                send_weights(self._collector, self.online.timeout)
                self._sent = True
            return next_episodes(self._batches, self._collector, self.online.timeout)
        except RuntimeError as error:  # of a simulator, or of a process that died or hangs
            self._failures += 1
            check_failures(self._failures, error)
            self.close()
            return []

    def _start(self) -> None:
        index = self.dataset.metadata
        environment, options = find_environment(index["environment"]), index["options"]
        make = partial(make_env, environment, **{**options, "privileged": True})
        chunk = getattr(from_dict(environment.options, options), "horizon", _CHUNK)
        # Numbers of episodes that failed are not tried again: they may fail again.
        first = index.get(_NEXT, 0) + self._failures * max(self.online.workers, 1)
        self._collector = make_collector(make, self._acting, self.online, first=first, chunk=chunk)
        self._batches, self._sent = iter(self._collector), False

    def _mean_reward(self, episode: TensorDictBase) -> float:
        """Of the object that whoever played the episode is about."""
        seen, index = episode["next"], self._objects[int(episode[NUMBER][0]) % len(self._objects)]
        return float(position_reward(seen["object_position"], seen["goal_position"], index).mean())

    def _append(self, episode: TensorDictBase) -> None:
        number = int(episode[NUMBER][0])
        behaviour = self.behaviours[number % len(self.behaviours)]
        counts = count_episode(self.dataset, behaviour, self._failures)
        following = max(number + 1, self.dataset.metadata.get(_NEXT, 0))
        records = episode_to_records(episode.to("cpu")).select(*STORED)
        self.dataset.append(records, **counts, **{_NEXT: following}, coverage=None)
        self._failures = 0
