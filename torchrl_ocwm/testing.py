"""Small inputs for doctests, tests and benchmarks; no simulator needed."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch.nn.functional import one_hot

from torchrl_ocwm.data.dataset import EpisodeDataset
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.envs.workspace import Workspace
from torchrl_ocwm.images import ImageSize

#: Changes to the size ``debug`` for each style.
STYLES = {
    "dreamer_v3": {},
    "dreamer_v2": {
        "architecture.style": "dreamer_v2",
        "architecture.cnn_mults": (1, 2, 4, 8),
        "architecture.gru_blocks": 8,
    },
}


def reacher_task(image_size: ImageSize = 64) -> Task:
    """The shapes of Reacher."""
    workspace = Workspace(low=(-0.24, -0.24), high=(0.24, 0.24), reach=(0.042, 0.24))
    return Task("reacher", image_size, ("finger",), 5, 2, workspace)


def random_records(task: Task, batch: int, time: int, *, seed: int = 0) -> TensorDict:
    """Random records ``[batch, time]`` of a task, the first of each sequence with ``is_init`` set."""
    generator = torch.Generator().manual_seed(seed)
    shape, size, objects = (batch, time), task.image_shape, len(task.objects)

    def uniform(*features: int) -> torch.Tensor:
        return torch.rand(*shape, *features, generator=generator)

    is_init = torch.zeros(*shape, 1, dtype=torch.bool)
    is_init[:, 0] = True
    position = torch.stack([task.workspace.sample(shape, generator) for _ in range(objects)], -2)
    goal = task.workspace.sample((batch, 1), generator).expand(*shape, -1).clone()
    done = torch.zeros(*shape, 1, dtype=torch.bool)
    return TensorDict(
        {
            "action": _action(task, uniform(task.action)),
            "is_init": is_init,
            "next": {
                "pixels": (256 * uniform(3, *size)).to(torch.uint8),
                "masks": uniform(objects, *size) > 0.9,
                "proprio": uniform(task.proprio),
                "object_position": position,
                "object_visible": torch.ones(*shape, objects, dtype=torch.bool),
                "goal_position": goal,
                "reward": -(position[..., 0, :] - goal).norm(dim=-1, keepdim=True),
                "done": done,
                "terminated": done.clone(),
            },
        },
        shape,
    )


def _action(task: Task, drawn: torch.Tensor) -> torch.Tensor:
    """Actions ``[..., A]`` of numbers in [0, 1]."""
    return one_hot(drawn.argmax(-1), task.action).float() if task.discrete else 2 * drawn - 1


def random_dataset(path: str | Path, task: Task, *, episodes: int = 4, length: int = 20) -> EpisodeDataset:
    """A dataset of random episodes of ``length`` records each."""
    metadata = {"environment": task.name, "options": task.options, "task": task.to_dict()}
    with EpisodeDataset.create(path, example=random_records(task, 1, 1)[0, 0], metadata=metadata) as dataset:
        for seed in range(episodes):
            records = random_records(task, 1, length, seed=seed)[0]
            records["action"][0] = 0
            records["next", "done"][-1] = True
            dataset.append(records)
    return dataset
