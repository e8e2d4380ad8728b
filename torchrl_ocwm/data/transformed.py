"""A dataset through a transform, to another one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl.envs import Transform

from torchrl_ocwm.data.dataset import DatasetError, EpisodeDataset

_OF_THE_FILES = ("format", "version", "records", "episode_lengths", "checksums", "keys", "coverage")


def transform_dataset(
    dataset: EpisodeDataset, path: str | Path, transform: Transform, **metadata: Any
) -> EpisodeDataset:
    """Copy a dataset, each episode through a transform: for masks and positions that recordings lack, for instance.

    Args:
        dataset: What to copy; it stays as it is.
        path: Folder to make.
        transform: Gets the records ``[T + 1]`` of an episode at once, with the frames under ``next``, as
            ``ColourMasks(..., pixels=("next", "pixels"), masks=("next", "masks"), ...)`` wants them.
        metadata: What to keep in the index of the copy, beside what that of the dataset holds.

    Returns:
        The copy, opened.

    Raises:
        DatasetError: if there is a dataset already, the folder cannot be written, or what comes out of the transform is
            not as the data contract says.

    Examples:
        >>> import tempfile
        >>> from torchrl_ocwm.testing import random_dataset, reacher_task
        >>> from torchrl_ocwm.envs import ColourMasks
        >>> names = {name: ("next", name) for name in ("pixels", "masks", "object_visible")}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     recorded = random_dataset(folder + "/recorded", reacher_task(), episodes=2)
        ...     found = transform_dataset(recorded, folder + "/found", ColourMasks(1, **names))
        ...     len(found), bool(found[0]["next", "masks"].any())  # it has learnt no colours yet
        (2, False)
    """
    if not len(dataset):
        raise DatasetError(f"{dataset.path}: no episode has been stored yet; there is nothing to copy")
    kept = {name: value for name, value in dataset.metadata.items() if name not in _OF_THE_FILES}
    first = transform(dataset[0])
    with EpisodeDataset.create(path, example=first[0], metadata={**kept, **metadata}) as copy:
        for number in range(len(dataset)):
            copy.append(transform(dataset[number]))
    return copy
