"""What the records of a task look like (docs/data.md): converted exactly, or refused by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot

from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.errors import UserError

#: Keys that a dataset of a task may be without.
OPTIONAL = (
    *("next/masks", "next/depth", "next/object_position", "next/object_visible", "next/object_position_true"),
    *("next/goal_position", "next/reward", "next/truncated"),
)
_POSITIONS = ("next/object_position", "next/goal_position", "next/object_position_true")
#: So many sides of the workspace a position may lie outside of it: an object that falls, not one in millimetres.
_FAR = 10


class DatasetError(UserError, ValueError):
    """A dataset cannot be read or written; the message names the file and the reason."""


def record_keys(task: Task) -> dict[str, list[Any]]:
    """Shape and dtype of each key of a task's records, as the index of a dataset has them.

    Examples:
        >>> from torchrl_ocwm.testing import reacher_task
        >>> record_keys(reacher_task())["next/pixels"]
        [[3, 64, 64], 'uint8']
    """
    objects, dim, size = len(task.objects), task.workspace.dim, task.image_shape
    return {
        "action": [[task.action], "float32"],
        "is_init": [[1], "bool"],
        "next/pixels": [[3, *size], "uint8"],
        "next/masks": [[objects, *size], "bool"],
        "next/depth": [[1, *size], "float32"],
        "next/proprio": [[task.proprio], "float32"],
        "next/object_position": [[objects, dim], "float32"],
        "next/object_visible": [[objects], "bool"],
        "next/goal_position": [[dim], "float32"],
        "next/object_position_true": [[objects, dim], "float32"],
        "next/reward": [[1], "float32"],
        "next/done": [[1], "bool"],
        "next/terminated": [[1], "bool"],
        "next/truncated": [[1], "bool"],
    }


def check_keys(keys: dict[str, Any], task: Task) -> None:
    """Check the keys of an index against those of a task.

    Raises:
        DatasetError: naming what is missing or different.
    """
    expected = record_keys(task)
    missing = [name for name in expected if name not in keys and name not in OPTIONAL]
    if missing:
        raise DatasetError(f"keys lack {', '.join(missing)}, which the records of a task have (docs/data.md)")
    for name in expected:
        if keys.get(name, expected[name]) != expected[name]:
            raise DatasetError(f"keys.{name}: {keys[name]}, the task says {expected[name]}")


def conform(records: TensorDictBase, task: Task, where: str = "") -> TensorDictBase:
    """Give records the dtypes of a task's: bools of 0 and 1 or 0 and 255, float32 numbers, images of bytes.

    Args:
        records: Records, of any batch size.
        task: The task.
        where: What the message of an error begins with.

    Raises:
        DatasetError: for a key that is missing, has another shape, or cannot be converted without loss.

    Discrete actions may be whole numbers ``[..., 1]``.

    Examples:
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> records = random_records(reacher_task(), 1, 5)[0]
        >>> records["next", "pixels"] = records["next", "pixels"] / 255
        >>> conform(records, reacher_task())["next", "pixels"].dtype
        torch.uint8
    """
    expected, there = record_keys(task), records.flatten_keys("/")
    missing = [name for name in expected if name not in there.keys() and name not in OPTIONAL]
    if "next/object_position" in there.keys() and "next/object_visible" not in there.keys():
        missing.append("next/object_visible")
    if missing:
        raise DatasetError(f"{where}records lack {', '.join(missing)}; docs/data.md has the keys and what they mean")
    converted = records.copy()
    if task.discrete and not there["action"].is_floating_point():
        there["action"] = _one_hot(f"{where}action", there["action"], task.action)
    for name in expected.keys() & set(there.keys()):
        shape, dtype = expected[name]
        _check_shape(f"{where}{name}", there[name].shape[records.ndim :], shape)
        converted[tuple(name.split("/"))] = _CONVERT[dtype](f"{where}{name}", there[name])
    return converted


def check_values(records: TensorDictBase, episode_lengths: Sequence[int], task: Task, where: str = "") -> None:
    """Check what the records ``[N]`` of whole episodes of a task hold.

    Args:
        records: The records, with the dtypes of the task's.
        episode_lengths: Records of each episode.
        task: The task.
        where: What the message of an error begins with.

    Raises:
        DatasetError: for actions beyond ±1, positions that cannot be metres, images that are all black, and episodes
            that do not end at their last record and only there.
    """
    most = records["action"].abs().max()
    if most > 1:
        raise DatasetError(
            f"{where}action: {most:g} is beyond ±1; scale actions to what the robot takes at most "
            "(ActionRange(low, high).normalise)"
        )
    if task.discrete:
        _check_choices(f"{where}action", records)
    for name in _POSITIONS:
        if tuple(name.split("/")) in records.keys(True):
            _check_metres(f"{where}{name}", records[tuple(name.split("/"))], task)
    _check_ends(records["next"], episode_lengths, where)
    last = torch.tensor(episode_lengths).cumsum(0) - 1
    first = last + 1 - torch.tensor(episode_lengths)
    seen = [(records["next", "pixels"][frames] != 0).flatten(1).any(1) for frames in (first, (first + last) // 2, last)]
    black = (~torch.stack(seen).any(0)).nonzero().flatten().tolist()
    if black:
        raise DatasetError(f"{where}next/pixels: the images of episode {black[0]} are black; the frames were lost")


def _check_shape(name: str, shape: torch.Size, expected: list[int]) -> None:
    if [*shape] == expected:
        return
    if len(expected) == 3 and [*shape] == [*expected[1:], expected[0]]:
        raise DatasetError(f"{name}: has shape {(*shape,)}, channels last; the contract is {(*expected,)}, permute it")
    axes = f" ({expected[-1]} axes, as its workspace has)" if name.endswith(_POSITIONS) else ""
    raise DatasetError(f"{name}: has shape {(*shape,)} per record, the task says {(*expected,)}{axes}")


def _one_hot(name: str, choice: Tensor, actions: int) -> Tensor:
    """Whole numbers ``[..., 1]``."""
    least, most = int(choice.min()), int(choice.max())
    if choice.shape[-1:] != (1,) or least < 0 or most >= actions:
        raise DatasetError(
            f"{name}: the task has actions 0 to {actions - 1}, as one whole number each, got {least} to {most} of "
            f"shape {(*choice.shape,)}"
        )
    return one_hot(choice.squeeze(-1).long(), actions).float()


def _to_float(name: str, value: Tensor) -> Tensor:
    if not value.is_floating_point():
        raise DatasetError(f"{name}: expected float32, got {value.dtype}; convert it with .float() if that is meant")
    return value.float()


def _to_bool(name: str, value: Tensor) -> Tensor:
    if value.dtype == torch.bool:
        return value
    most = value.max()
    if not ((value == 0) | (value == most)).all() or most not in (0, 1, 255):
        raise DatasetError(
            f"{name}: {value.dtype} with values up to {most:g}; expected bool, or only 0 and 1 or 0 and 255"
        )
    return value > 0


def _to_bytes(name: str, value: Tensor) -> Tensor:
    if value.dtype == torch.uint8:
        return value
    if not value.is_floating_point() or value.dtype == torch.bfloat16:
        raise DatasetError(f"{name}: expected uint8 images of 0 to 255, got {value.dtype}")
    if not ((value >= 0) & (value <= 1)).all():
        raise DatasetError(
            f"{name}: {value.dtype} with values from {value.min():g} to {value.max():g}; floating images lie in "
            "[0, 1], images of 0 to 255 are uint8"
        )
    scaled = 255 * value
    if ((scaled - scaled.round()).abs() > 255 * torch.finfo(value.dtype).eps).any():
        raise DatasetError(
            f"{name}: floating images that are not multiples of 1/255 cannot be stored exactly; round them yourself, "
            "(255 * images).round().to(torch.uint8)"
        )
    return scaled.round().to(torch.uint8)


_CONVERT = {"float32": _to_float, "bool": _to_bool, "uint8": _to_bytes}


def _check_metres(name: str, position: Tensor, task: Task) -> None:
    low, high = torch.tensor(task.workspace.low), torch.tensor(task.workspace.high)
    outside = torch.maximum(low - position, position - high).max()
    if outside > _FAR * (high - low).max():
        raise DatasetError(
            f"{name}: {position.abs().max():g} is far outside the workspace, {task.workspace.low} to "
            f"{task.workspace.high}; positions are metres from the start position"
        )


def _check_choices(name: str, records: TensorDictBase) -> None:
    action = records["action"][~records["is_init"].squeeze(-1)]
    if not torch.equal(action, one_hot(action.argmax(-1), action.shape[-1]).to(action)):
        raise DatasetError(
            f"{name}: the task's actions are discrete; each is a whole number, or 1 at one place and 0 elsewhere"
        )


def _check_ends(frames: TensorDictBase, episode_lengths: Sequence[int], where: str) -> None:
    last = torch.tensor(episode_lengths).cumsum(0) - 1
    if not torch.equal(frames["done"].flatten().nonzero().flatten(), last):
        raise DatasetError(f"{where}next/done: must be set at the last record of an episode and only there")
    for name in ("terminated", "truncated"):
        if name in frames.keys() and (frames[name] & ~frames["done"]).any():
            raise DatasetError(f"{where}next/{name}: is set where next/done is not")
