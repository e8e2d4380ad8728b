"""Collect a dataset with several processes."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import MultiSyncCollector
from tqdm import tqdm

from torchrl_ocwm.data.dataset import DatasetError, EpisodeDataset
from torchrl_ocwm.data.policies import SmoothRandomPolicy
from torchrl_ocwm.data.records import episode_to_records
from torchrl_ocwm.envs import make_env, make_task

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


def collect(
    path: str | Path,
    environment: str,
    steps: int,
    *,
    policy: TensorDictModuleBase | None = None,
    workers: int = 2,
    seed: int = 0,
    options: dict[str, Any] | None = None,
    progress: bool = True,
) -> EpisodeDataset:
    """Collect whole episodes into a dataset until it holds at least ``steps`` environment steps.

    A folder that holds a dataset already is continued, with other random numbers; when it has enough, nothing is
    collected. The process may be killed at any moment: the folder then holds the whole episodes written so far.

    Args:
        path: Folder of the dataset.
        environment: Name of the environment (:data:`~torchrl_ocwm.envs.ENVIRONMENTS`).
        steps: Environment steps to reach.
        policy: Policy that acts; smooth random actions by default.
        workers: Processes that step one environment each.
        seed: Seeds environments and actions.
        options: Passed to the environment.
        progress: Show a progress bar with the rate.

    Returns:
        The dataset, opened.

    Raises:
        DatasetError: if the folder holds a dataset of another environment or other options, or cannot be written.
        ValueError: for fewer than one step or worker.
    """
    if steps < 1 or workers < 1:
        raise ValueError(f"steps and workers must be at least 1, got {steps} and {workers}")
    options = options or {}
    task = make_task(environment, **options)
    source = {"environment": environment, "options": options, "task": task.to_dict()}
    dataset = _open_if_there(Path(path), source)
    if dataset is not None and dataset.num_steps >= steps:
        return dataset
    done = dataset.num_steps if dataset is not None else 0
    torch.manual_seed(seed + done)
    # The collector resets its environments before it can be seeded, so they bring their first seeds along.
    first_seeds = torch.randint(2**31, (workers,)).tolist()
    collector = MultiSyncCollector(
        [partial(make_env, environment, seed=first_seed, **options) for first_seed in first_seeds],
        policy or SmoothRandomPolicy(task.action),
        frames_per_batch=workers * 100,
        total_frames=-1,
        trajs_per_batch=1,
        traj_format="cat",
        use_buffers=False,
    )
    try:
        collector.set_seed(seed + done)
        with tqdm(total=steps, initial=done, unit="step", desc=f"collect {environment}", disable=not progress) as bar:
            for batch in collector:
                records = episode_to_records(batch.reshape(-1)).select(*STORED)
                if dataset is None:
                    dataset = EpisodeDataset.create(path, example=records[0], metadata=source)
                dataset.append(records)
                bar.update(len(records) - 1)
                if dataset.num_steps >= steps:
                    break
    finally:
        collector.shutdown()
    if dataset is None:
        raise DatasetError(f"{path}: the collector ended before the first episode was complete")
    dataset.trim()
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
