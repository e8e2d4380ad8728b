"""The same episodes, with their goals in the images."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from torchrl_ocwm.data.dataset import DatasetError, EpisodeDataset
from torchrl_ocwm.data.index import INDEX
from torchrl_ocwm.data.transformed import transform_dataset
from torchrl_ocwm.envs import DrawTarget, Task, environment_of, make_scene
from torchrl_ocwm.settings import SettingsError

_READ = ("pixels", "masks", "goal_position")


def draw_targets(dataset: EpisodeDataset, path: str | Path, diameter: int) -> EpisodeDataset:
    """Copy a dataset, with a disc at the goal of each episode in its images (paper, "Size matters!").

    Agents that see their goal, and others that do not, can then learn from the same episodes. The copy is what
    would have been recorded with the option ``virtual_target``, if nobody who acted had looked at the disc.

    A copy that is there already is opened.

    Args:
        dataset: What to copy; of an environment of this package, whose images do not show goals.
        path: Folder to make.
        diameter: Pixels, at least 1.

    Returns:
        The copy, opened to read.

    Raises:
        DatasetError: if the images show goals already, nobody knows where goals are in them, masks or goals are
            missing, or there is another dataset already.
        ModuleNotFoundError: if the simulator is missing, with what to install.
        ValueError: for a diameter below 1.

    Examples:
        >>> import tempfile
        >>> from torchrl_ocwm.data import collect
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plain = collect(folder + "/plain", "reacher", 20, options={"horizon": 20}, workers=0, progress=False)
        ...     shown = draw_targets(plain, folder + "/shown", 5)
        ...     shown.images_show_goal, bool((shown[0]["next", "pixels"] != plain[0]["next", "pixels"]).any())
        (True, True)
    """
    if diameter < 1:
        raise ValueError(f"diameter must be at least 1 pixel, got {diameter}")
    _check(dataset)
    shown = {"virtual_target": diameter}
    options = {**dataset.metadata.get("options", {}), **shown}
    task = replace(dataset.task, options={**dataset.task.options, **shown})
    if (Path(path) / INDEX).exists() and _is_of(made := EpisodeDataset.open(path), dataset, task):
        return made
    with closing(_scene(dataset)) as scene:
        keys = {name: ("next", name) for name in _READ}
        draw = DrawTarget(scene.project, diameter, **keys)
        return transform_dataset(dataset, path, draw, options=options, task=task.to_dict())


def _check(dataset: EpisodeDataset) -> None:
    if dataset.images_show_goal:
        raise DatasetError(f"{dataset.path}: its images show the goals of its episodes already (virtual_target)")
    if lacking := [name for name in _READ if name not in dataset.records["next"].keys()]:
        raise DatasetError(f"{dataset.path}: holds no {lacking[0]}, which a disc at the goal needs")


def _scene(dataset: EpisodeDataset) -> Any:
    """What knows where positions are in the images."""
    unknown = (
        f"{dataset.path}: {dataset.task.name!r} does not say where goals are in its images; transform_dataset with "
        "DrawTarget(project, diameter) takes a projection of your own"
    )
    try:
        environment = environment_of(dataset.task)
    except SettingsError as error:
        raise DatasetError(unknown) from error
    scene = make_scene(environment, **dataset.task.options)
    if not hasattr(scene, "project"):
        scene.close()
        raise DatasetError(unknown)
    return scene


def _is_of(copy: EpisodeDataset, dataset: EpisodeDataset, task: Task) -> bool:
    """Whether a dataset has the task of a copy, and the episodes of the other."""
    if copy.task != task or copy.episode_lengths != dataset.episode_lengths:
        return False
    return torch.equal(*(one.records["next", "goal_position"] for one in (copy, dataset)))
