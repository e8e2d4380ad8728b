"""Collect a dataset with several processes."""

from __future__ import annotations

import json
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import ExitStack, closing
from functools import partial
from itertools import count, cycle
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_ocwm.data.coverage import dataset_coverage
from torchrl_ocwm.data.dataset import DatasetError, EpisodeDataset, refuse_another
from torchrl_ocwm.data.policies import POLICIES, ScriptedPolicy
from torchrl_ocwm.data.records import STORED, episode_to_records
from torchrl_ocwm.data.seeds import episode_seed
from torchrl_ocwm.data.settings import Collection
from torchrl_ocwm.envs import ScriptedAction, Task, find_environment, make_env, make_task
from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.envs.registry import recorded
from torchrl_ocwm.errors import UserError
from torchrl_ocwm.processes import Make, Worker, make_worker
from torchrl_ocwm.settings import SettingsError, differences


class CollectionError(UserError, RuntimeError):
    """One episode after the other failed, in a simulator or in a process."""


#: So many episodes in a row may fail.
MAX_FAILURES = 3


def collect(
    path: str | Path,
    environment: str,
    settings: Collection | int,
    *,
    policy: TensorDictModuleBase | None = None,
    options: dict[str, Any] | None = None,
    progress: bool = True,
    **more: Any,
) -> EpisodeDataset:
    """Collect whole episodes into a dataset until it holds at least so many environment steps.

    A folder that holds a dataset already is continued, with other random numbers and, if you like, with another
    policy; when it has enough, nothing is collected. The process may be killed at any moment: the folder then holds
    the whole episodes written so far. An episode whose simulator fails, or whose process dies or hangs, is dropped,
    and the process replaced.

    The random numbers of an episode come from the seed and the number of the episode in the dataset. So the same
    settings give the same episodes in the same order, with any number of processes, and whether or not the collection
    was interrupted.

    The index of the dataset counts the episodes of each policy (``policies``) and the failures (``failures``), and
    says how often objects move and what part of the workspace they visit (``coverage``, see
    :func:`~torchrl_ocwm.data.object_coverage`).

    Args:
        path: Folder of the dataset.
        environment: Name of the environment (:data:`~torchrl_ocwm.envs.ENVIRONMENTS`).
        settings: How much, by whom and how; or the steps, with other settings as arguments.
        policy: A module that writes ``action``: that which ``settings.policy`` names, if it is a checkpoint
            (:func:`~torchrl_ocwm.agents.collecting_policy`), or another in its place.
        options: Passed to the environment.
        progress: Show a progress bar with the rate.
        more: Fields of :class:`~torchrl_ocwm.data.Collection`, where ``settings`` is a number of steps.

    Returns:
        The dataset, opened.

    Raises:
        DatasetError: if the folder holds a dataset of another environment or other options, or cannot be written.
        SettingsError: for an unknown policy.
        MissingPackageError: if tqdm is missing, with the extra to install.
        WorkerError: if a process ends before it has begun.
        CollectionError: if one episode after the other fails, in the simulator or with its process. What fails
            otherwise is raised as a ``RuntimeError``.
    """
    with needs("a collection", "recipes"):
        from tqdm import tqdm

    if isinstance(settings, int):
        settings = Collection(steps=settings, **more)
    options = recorded(options or {})
    task = make_task(environment, **options)
    source = {"environment": task.name, "options": options, "task": task.to_dict()}
    name, module = _who_acts(settings, policy, task)
    dataset = _open_if_there(Path(path), source)
    if dataset is not None and dataset.num_steps >= settings.steps:
        with dataset:
            return with_coverage(dataset, task)
    done = dataset.num_steps if dataset is not None else 0

    make_player = partial(
        EpisodePlayer,
        partial(make_env, find_environment(environment), **{**options, "privileged": True}),
        module,
        settings.seed,
    )
    played = play_in_order(make_player, settings, first=_next_number(dataset))
    bar = tqdm(total=settings.steps, initial=done, unit="step", desc=f"collect {environment}", disable=not progress)
    with bar, ExitStack() as writing, closing(played) as episodes:
        if dataset is not None:
            writing.enter_context(dataset)
        for records, failures in episodes:
            if dataset is None:
                dataset = writing.enter_context(EpisodeDataset.create(path, example=records[0], metadata=source))
            dataset.append(records, **count_episode(dataset, name, failures), coverage=None)
            bar.update(len(records) - 1)
            if dataset.num_steps >= settings.steps:
                break
        assert dataset is not None
        return with_coverage(dataset, task)


def _who_acts(
    settings: Collection, policy: TensorDictModuleBase | None, task: Task
) -> tuple[str, TensorDictModuleBase]:
    """A policy's name in the index of a dataset, and the module that acts."""
    if policy is None:
        if settings.policy not in POLICIES:
            raise SettingsError(
                f"policy must be {', '.join(POLICIES)} or a checkpoint file, got {settings.policy!r}; that of a "
                "checkpoint is handed in as a module (torchrl_ocwm.agents.collecting_policy)"
            )
        return settings.policy, POLICIES[settings.policy](task.action)
    if settings.policy in POLICIES:
        return type(policy).__name__, policy
    return f"{settings.policy} ({settings.behaviour})" if settings.behaviour else settings.policy, policy


class EpisodePlayer:
    """Plays whole episodes, each with random numbers of its own; actions are explored, whatever the context.

    Args:
        make: Makes the environment.
        policy: Acts in it.
        seed: Seed of the collection.
        alive: Called after each step.
    """

    def __init__(
        self, make: Callable[[], EnvBase], policy: TensorDictModuleBase, seed: int, alive: Callable[[], None]
    ) -> None:
        self.env, self.policy, self.seed, self.alive = make(), policy, seed, alive
        if isinstance(policy, ScriptedPolicy):
            self.env = self.env.append_transform(ScriptedAction())

    @torch.no_grad()
    def play(self, number: int) -> TensorDictBase:
        """The records ``[T + 1]`` of an episode."""
        seed = episode_seed("collect", self.seed, number)
        with torch.random.fork_rng(devices=[]), set_exploration_type(ExplorationType.RANDOM):
            torch.manual_seed(seed)
            episode = self.env.rollout(
                sys.maxsize,
                self.policy,
                callback=lambda *_: self.alive(),
                auto_reset=False,
                break_when_any_done=True,
                tensordict=self.env.reset(seed=seed),
            )
        return episode_to_records(episode).select(*STORED)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def play_in_order(
    make_player: Make, settings: Collection, *, first: int
) -> Generator[tuple[TensorDictBase, int], None, None]:
    """Episodes in the order of their numbers, each with the number of failures since the one before.

    Args:
        make_player: Makes an :class:`EpisodePlayer`.
        settings: Workers and timeout.
        first: Number of the first episode.

    Raises:
        WorkerError: if a process ends before it has begun.
        CollectionError: if one episode after the other fails, in the simulator or with its process. What fails
            otherwise is raised as a ``RuntimeError``.
    """
    begin = partial(make_worker, make_player, process=settings.workers > 0, timeout=settings.timeout)
    numbers, failures = count(first), 0
    players: list[Worker] = []
    try:
        for _ in range(max(settings.workers, 1)):
            players.append(begin())
        for player in players:
            player.ready()
            player.request("play", next(numbers))
        for turn in cycle(range(len(players))):
            episode = None
            try:
                episode = players[turn].answer()
            except RuntimeError as error:  # of the simulator, or of a process that died or hangs
                failures += 1
                check_failures(failures, error)
                players[turn].close()
                players[turn] = begin()
                players[turn].ready()
            players[turn].request("play", next(numbers))
            if episode is not None:
                yield episode, failures
                failures = 0
    finally:
        for player in players:
            player.close()


def check_failures(failures: int, error: RuntimeError) -> None:
    """Warn of an episode that failed, or raise if too many did so in a row."""
    if isinstance(error, NotImplementedError):
        raise error
    if failures > MAX_FAILURES:
        kind = CollectionError if isinstance(error, UserError) else RuntimeError
        raise kind(f"{failures} episodes failed in a row, the last one with: {error}") from error
    warnings.warn(f"an episode failed ({error}) and is left out; a new process goes on", RuntimeWarning, stacklevel=2)


def _next_number(dataset: EpisodeDataset | None) -> int:
    """Episodes that were played so far, those that failed included."""
    return 0 if dataset is None else len(dataset.episode_lengths) + dataset.metadata.get("failures", 0)


def count_episode(dataset: EpisodeDataset, policy: str, failures: int) -> dict[str, Any]:
    """The index's counts with one more episode."""
    counts = Counter(dataset.metadata.get("policies", {}))
    counts[policy] += 1
    return {"policies": dict(counts), "failures": dataset.metadata.get("failures", 0) + failures}


def with_coverage(dataset: EpisodeDataset, task: Task) -> EpisodeDataset:
    """The dataset, which is open for writing, with the coverage of its episodes in its index."""
    if dataset.metadata.get("coverage") is None:
        coverage = dataset_coverage(dataset, task.objects, task.workspace)
        dataset.annotate(coverage={name: seen._asdict() for name, seen in coverage.items()})
    return dataset


def _open_if_there(path: Path, source: dict[str, Any]) -> EpisodeDataset | None:
    """The dataset in a folder that can be written to; ``None`` if there is none yet, and the folder can be made."""
    try:
        TemporaryFile(dir=next(one for one in (path, *path.parents) if one.exists())).close()
    except OSError as error:
        raise DatasetError(f"{path}: cannot write a dataset here ({error.strerror or error})") from error
    if not (path / "dataset.json").exists():
        refuse_another(path)
        return None
    dataset = EpisodeDataset.open(path, write=True)  # it may have been killed before the first episode
    with ExitStack() as opened:
        opened.callback(dataset.close)
        if different := _different(dataset, source):
            raise DatasetError(f"{path}: holds a dataset {different}; choose another folder")
        opened.pop_all()
    return dataset


def _different(dataset: EpisodeDataset, source: dict[str, Any]) -> str:
    """Of what else a dataset is; nothing, if episodes of the same environment can be added."""
    index, here = dataset.metadata, json.loads(json.dumps(source))
    if any(index.get(key) != here[key] for key in ("environment", "options")):
        return (
            f"of {index.get('environment')!r} with options {index.get('options')}, not of {here['environment']!r} with "
            f"{here['options']}"
        )
    there = dataset.task  # with the defaults of what was added to tasks later
    if there == (task := Task.from_dict(here["task"])):
        return ""
    return f"of another task ({differences(there, task, 'there', 'here')})"
