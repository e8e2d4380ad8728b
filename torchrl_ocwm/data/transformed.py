"""A dataset through a transform, to another one."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from torchrl_ocwm.data.convert import no_workspace, workspace_around
from torchrl_ocwm.data.dataset import DatasetError, EpisodeDataset
from torchrl_ocwm.data.draft import draft_of
from torchrl_ocwm.envs.workspace import Workspace

_OF_THE_FILES = ("format", "version", "records", "episode_lengths", "checksums", "keys", "coverage")
_POSITION = ("next", "object_position")


def transform_dataset(
    dataset: EpisodeDataset,
    path: str | Path,
    transform: Transform,
    *,
    workspace: Workspace | None = None,
    **metadata: Any,
) -> EpisodeDataset:
    """Copy a dataset, each episode through a transform: for masks and positions that recordings lack, for instance.

    If anything fails, there is no copy.

    Recordings that were imported without positions have no workspace either. Where the transform gives them positions,
    the workspace of the copy is the box around those of the first object, with as many axes, as
    :func:`~torchrl_ocwm.data.import_dataset` makes it.

    Args:
        dataset: What to copy; it stays as it is.
        path: Folder to make.
        transform: Gets the records ``[T + 1]`` of an episode at once, with the frames under ``next``, as
            ``ColourMasks(..., pixels=("next", "pixels"), masks=("next", "masks"), ...)`` wants them.
        workspace: That of the copy, metres; ``None``: that of the dataset, or of the new positions.
        metadata: What to keep in the index of the copy, beside what that of the dataset holds.

    Returns:
        The copy, opened to read.

    Raises:
        DatasetError: if there is a dataset already, the folder cannot be written, what comes out of the transform is
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
    example = transform(dataset[0])
    fitted = workspace is None and "task" not in metadata and _adds_positions(dataset, example)
    if fitted:
        workspace = no_workspace(example[_POSITION].shape[-1])  # until all positions are known
    if workspace is not None:
        kept["task"] = _task_in(dataset, workspace)
    path, places = Path(path), []
    with (
        draft_of(path) as draft,
        EpisodeDataset.create(draft, example=example[0], metadata={**kept, **metadata}) as copy,
    ):
        for number in range(len(dataset)):
            records = transform(dataset[number])
            copy.append(records)
            if fitted:
                places.append(_seen(records))
        if places:
            copy.annotate(task=_task_in(dataset, _workspace_around(torch.cat(places), path)))
    return EpisodeDataset.open(path)


def _adds_positions(dataset: EpisodeDataset, records: TensorDictBase) -> bool:
    """Whether a transform positions what was recorded without positions, and so without a workspace."""
    if _POSITION in dataset.records.keys(True) or _POSITION not in records.keys(True) or "task" not in dataset.metadata:
        return False
    known = dataset.task.workspace
    return known == no_workspace(known.dim)


def _seen(records: TensorDictBase) -> Tensor:
    """Positions ``[N, D]`` of the first object, where it is visible."""
    return records[_POSITION][:, 0][records["next", "object_visible"][:, 0]]


def _workspace_around(position: Tensor, path: Path) -> Workspace:
    if len(position):
        return workspace_around(position)
    warnings.warn(
        f"{path}: the first object is visible in no frame, so that its workspace is unknown; look at the masks",
        stacklevel=3,
    )
    return no_workspace(position.shape[-1])


def _task_in(dataset: EpisodeDataset, workspace: Workspace) -> dict[str, Any]:
    return replace(dataset.task, workspace=workspace).to_dict()
