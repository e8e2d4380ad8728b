"""Collect a dataset with several processes."""

from __future__ import annotations

import json
import warnings
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import EnvBase
from tqdm import tqdm

from torchrl_ocwm.agents.checkpoint import load_agent
from torchrl_ocwm.data.coverage import dataset_coverage
from torchrl_ocwm.data.dataset import DatasetError, EpisodeDataset
from torchrl_ocwm.data.policies import ScriptedPolicy, SmoothRandomPolicy
from torchrl_ocwm.data.records import episode_to_records
from torchrl_ocwm.envs import ScriptedAction, Task, make_env, make_task

#: What a dataset keeps of an environment's observations.
STORED = (
    "action",
    "is_init",
    *(
        ("next", key)
        for key in (
            "pixels",
            "masks",
            "proprio",
            "object_position",
            "object_visible",
            "goal_position",
            "object_position_true",
            "reward",
            "done",
            "terminated",
        )
    ),
)


#: Policies by name; a checkpoint is the third kind.
POLICIES: dict[str, Callable[[int], TensorDictModuleBase]] = {"random": SmoothRandomPolicy, "scripted": ScriptedPolicy}
#: So many collectors in a row may fail before they have given an episode.
MAX_FAILURES = 3


def collect(
    path: str | Path,
    environment: str,
    steps: int,
    *,
    policy: str | Path | TensorDictModuleBase = "random",
    workers: int = 2,
    seed: int = 0,
    options: dict[str, Any] | None = None,
    progress: bool = True,
) -> EpisodeDataset:
    """Collect whole episodes into a dataset until it holds at least ``steps`` environment steps.

    A folder that holds a dataset already is continued, with other random numbers and, if you like, with another
    policy; when it has enough, nothing is collected. The process may be killed at any moment: the folder then holds
    the whole episodes written so far. When a simulator fails, the worker processes are replaced and the episodes that
    they were at are dropped.

    The index of the dataset counts the episodes of each policy (``policies``) and the failures (``failures``), and
    says how often objects move and what part of the workspace they visit (``coverage``, see
    :func:`~torchrl_ocwm.data.object_coverage`).

    Args:
        path: Folder of the dataset.
        environment: Name of the environment (:data:`~torchrl_ocwm.envs.ENVIRONMENTS`).
        steps: Environment steps to reach.
        policy: ``"random"`` for smooth random actions, ``"scripted"`` for scripted ones with noise
            (:class:`~torchrl_ocwm.data.ScriptedPolicy`), a checkpoint of an agent, which then explores, or a module
            that writes ``action``.
        workers: Processes that step one environment each.
        seed: Seeds environments and actions.
        options: Passed to the environment.
        progress: Show a progress bar with the rate.

    Returns:
        The dataset, opened.

    Raises:
        DatasetError: if the folder holds a dataset of another environment or other options, or cannot be written.
        ValueError: for fewer than one step or worker, an unknown policy, or a checkpoint of another task's agent.
        CheckpointError: for a file that is no checkpoint of an agent.
        RuntimeError: if the simulator fails again and again.
    """
    if steps < 1 or workers < 1:
        raise ValueError(f"steps and workers must be at least 1, got {steps} and {workers}")
    options = options or {}
    task = make_task(environment, **options)
    source = {"environment": environment, "options": options, "task": task.to_dict()}
    name, module = make_policy(policy, task)
    dataset = _open_if_there(Path(path), source)
    if dataset is not None and dataset.num_steps >= steps:
        return _with_coverage(dataset, task)
    done = dataset.num_steps if dataset is not None else 0

    def make_collector(attempt: int) -> MultiSyncCollector:
        return _make_collector(environment, options, module, workers, seed + done + attempt)

    bar = tqdm(total=steps, initial=done, unit="step", desc=f"collect {environment}", disable=not progress)
    with bar, closing(_whole_episodes(make_collector)) as episodes:
        for episode, failures in episodes:
            records = episode_to_records(episode).select(*STORED)
            if dataset is None:
                dataset = EpisodeDataset.create(path, example=records[0], metadata=source)
            dataset.append(records, **_count(dataset, name, failures), coverage=None)
            bar.update(len(records) - 1)
            if dataset.num_steps >= steps:
                break
    if dataset is None:
        raise DatasetError(f"{path}: the collector ended before the first episode was complete")
    dataset.trim()
    return _with_coverage(dataset, task)


def make_policy(policy: str | Path | TensorDictModuleBase, task: Task) -> tuple[str, TensorDictModuleBase]:
    """A policy's name in the index of a dataset, and the module that acts.

    Raises:
        ValueError: for an unknown name, or a checkpoint of another task's agent.
        CheckpointError: for a file that is no checkpoint of an agent.
    """
    if isinstance(policy, TensorDictModuleBase):
        return type(policy).__name__, policy
    if policy in POLICIES:
        return str(policy), POLICIES[str(policy)](task.action)
    if not Path(policy).is_file():
        raise ValueError(f"unknown policy {str(policy)!r}; there are {', '.join(POLICIES)} and checkpoint files")
    loaded = load_agent(policy)
    if loaded.agent.task != task:
        raise ValueError(
            f"{policy}: the agent was trained for {loaded.agent.task.name!r} with options "
            f"{loaded.agent.task.options}, not for {task.name!r} with {task.options}"
        )
    return str(policy), loaded


def _make_collector(
    environment: str, options: dict[str, Any], policy: TensorDictModuleBase, workers: int, seed: int
) -> MultiSyncCollector:
    torch.manual_seed(seed)
    # The collector resets its environments before it can be seeded, so they bring their first seeds along.
    first_seeds = torch.randint(2**31, (workers,)).tolist()
    make = _scripted_env if isinstance(policy, ScriptedPolicy) else make_env
    collector = MultiSyncCollector(
        [partial(make, environment, seed=first_seed, **{**options, "privileged": True}) for first_seed in first_seeds],
        policy,
        frames_per_batch=workers * 100,
        total_frames=-1,
        trajs_per_batch=1,
        traj_format="cat",
        use_buffers=False,
    )
    collector.set_seed(seed)
    return collector


def _scripted_env(environment: str, **options: Any) -> EnvBase:
    return make_env(environment, **options).append_transform(ScriptedAction())


def _whole_episodes(
    make_collector: Callable[[int], MultiSyncCollector],
) -> Generator[tuple[TensorDictBase, int], None, None]:
    """Episodes ``[T]``, each with the number of failures since the one before; a collector that fails is replaced."""
    attempt = failures = 0
    while True:
        collector = None
        try:
            collector = make_collector(attempt)
            for batch in collector:
                yield batch.reshape(-1), failures
                failures = 0
            return
        except RuntimeError as error:  # what the collector raises for a process that died
            attempt, failures = attempt + 1, failures + 1
            if failures > MAX_FAILURES:
                raise RuntimeError(f"the simulator failed {failures} times without an episode: {error}") from error
            warnings.warn(
                f"the simulator failed ({error}); its processes are replaced, failure {attempt} of this run",
                RuntimeWarning,
                stacklevel=2,
            )
        finally:
            if collector is not None:
                collector.shutdown(raise_on_error=False)


def _count(dataset: EpisodeDataset, policy: str, failures: int) -> dict[str, Any]:
    """The index's counts with one more episode."""
    counts = Counter(dataset.metadata.get("policies", {}))
    counts[policy] += 1
    return {"policies": dict(counts), "failures": dataset.metadata.get("failures", 0) + failures}


def _with_coverage(dataset: EpisodeDataset, task: Task) -> EpisodeDataset:
    if dataset.metadata.get("coverage") is None:
        coverage = dataset_coverage(dataset, task.objects, task.workspace)
        dataset.annotate(coverage={name: seen._asdict() for name, seen in coverage.items()})
    return dataset


def _open_if_there(path: Path, source: dict[str, Any]) -> EpisodeDataset | None:
    if not (path / "dataset.json").exists():
        return None
    dataset = EpisodeDataset.open(path, allow_empty=True)  # it may have been killed before the first episode
    there = {key: dataset.metadata.get(key) for key in source}
    if there != json.loads(json.dumps(source)):
        raise DatasetError(
            f"{path}: holds a dataset of {there['environment']!r} with options {there['options']}, not of "
            f"{source['environment']!r} with {source['options']}; choose another folder"
        )
    return dataset
