"""Recordings in the formats of others become a dataset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import one_hot

from torchrl_ocwm.data.convert import box, images, join_images, join_vectors, masks, no_workspace, workspace_around
from torchrl_ocwm.data.dataset import DatasetError, EpisodeDataset
from torchrl_ocwm.data.draft import draft_of, refuse_what_is_there
from torchrl_ocwm.data.formats import Source, SourceError, open_source
from torchrl_ocwm.data.formats.source import Format
from torchrl_ocwm.envs.positions import hold_last_seen
from torchrl_ocwm.envs.task import ActionRange, Task
from torchrl_ocwm.envs.workspace import Workspace
from torchrl_ocwm.images import ImageSize, image_shape
from torchrl_ocwm.settings import Settings, SettingsError, setting

Names = str | tuple[str, ...] | None


@dataclass(frozen=True)
class Keys(Settings):
    """Where the keys of a dataset are in recordings of others; ``null``: under a usual name, or nowhere.

    Args:
        pixels: Images; those of several cameras are put side by side.
        masks: Masks, one array for all objects or one for each; of the first camera, if there are several.
        proprio: Joint positions and the like; several arrays are put one after the other.
        object_position: Positions of the objects, one array for all or one for each. An object is hidden where they are
            NaN.
        object_visible: Whether each object's position is known.
        goal_position: Goals.
        action: Actions; several arrays are put one after the other.
        reward: Rewards, for agents that learn those of the recordings.
        terminated: Where an episode ended by itself.
    """

    pixels: Names = None
    masks: Names = None
    proprio: Names = None
    object_position: Names = None
    object_visible: Names = None
    goal_position: Names = None
    action: Names = None
    reward: Names = None
    terminated: Names = None


@dataclass(frozen=True)
class Importing(Settings):
    """How recordings of others become a dataset.

    Args:
        name: What the environment is called afterwards; training asks for it as ``env.name``.
        format: Of the recordings: ``"hdf5"`` of robomimic and of ManiSkill's ``RecordEpisode``, ``"npz"`` for a folder
            with a file for each episode, ``"minari"``, ``"lerobot"``; ``null`` looks what is there.
        keys: Where things are in them.
        objects: Names of the objects; the first is the one to position.
        image_size: Height and width of the images, to which they are scaled; one number for both, ``null`` keeps them.
        metres: Metres of a unit of the positions, 0.001 for millimetres.
        start: The start position, in the unit of the positions; none: their origin.
        low: Lower corner of the workspace, metres from the start position; none: of all positions. Where there are
            none, :func:`~torchrl_ocwm.data.transform_dataset` fits it to those that it adds.
        high: Upper corner.
        action_low: What −1 means, one value per action; none: the smallest of the recordings, if any is beyond ±1.
        action_high: What 1 means.
        actions: Number of actions to choose from, where they are whole numbers; ``null``: as many as there are.
        episodes: Episodes to import; ``null``: all.

    Raises:
        SettingsError: for values that do not fit together.
    """

    name: str = "recorded"
    format: Format | None = None
    keys: Keys = field(default_factory=Keys)
    objects: tuple[str, ...] = ("object",)
    image_size: ImageSize | None = setting(None, at_least=1)
    metres: float = setting(1.0, above=0)
    start: tuple[float, ...] = ()
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    action_low: tuple[float, ...] = ()
    action_high: tuple[float, ...] = ()
    actions: int | None = setting(None, at_least=2)
    episodes: int | None = setting(None, at_least=1)

    def validate(self) -> None:
        """Ends come in pairs."""
        for low, high in (("low", "high"), ("action_low", "action_high")):
            if len(getattr(self, low)) != len(getattr(self, high)):
                raise SettingsError(f"{low} and {high} must have as many values, or none")


def import_dataset(source: str | Path, path: str | Path, settings: Importing | None = None) -> EpisodeDataset:
    """Make a dataset of recordings of others, or none if anything fails.

    What the contract asks for (docs/data.md) is converted: images are scaled, actions brought to −1 to 1, discrete ones
    to vectors with a 1, positions to metres from the start position.

    Args:
        source: A file, a folder, or the id of a Minari dataset.
        path: Folder of the dataset to make.
        settings: How.

    Returns:
        The dataset, opened to read.

    Raises:
        SourceError: if the recordings cannot be read, or lack what every dataset has.
        DatasetError: if there is a dataset already, the folder cannot be written, or an episode cannot be stored.
        MissingPackageError: if a package for the format is missing, with the extra to install.
    """
    settings, path = settings or Importing(), Path(path)
    refuse_what_is_there(path)  # before all recordings are read
    recordings = Recordings(open_source(str(source), settings.format), settings)
    task = recordings.task()
    metadata = {"environment": task.name, "options": {}, "task": task.to_dict()}
    with draft_of(path) as draft:
        first = recordings.records(0, task)
        with EpisodeDataset.create(draft, example=first[0], metadata=metadata) as dataset:
            dataset.append(first)
            for number in range(1, len(recordings)):
                dataset.append(recordings.records(number, task))
    return EpisodeDataset.open(path)


class Recordings:
    """Recordings of others, with our keys.

    Args:
        source: The recordings.
        settings: How they are to be read.

    Raises:
        SourceError: if they lack what every dataset has.
    """

    def __init__(self, source: Source, settings: Importing) -> None:
        self.source, self.settings = source, settings
        self.names = {one.name: self._names(one.name) for one in fields(Keys)}
        lacking = [f"keys.{key}" for key in ("pixels", "proprio", "action") if not self.names[key]]
        if lacking:
            there = ", ".join(f"{name} {shape}" for name, shape in source.shapes().items())
            raise SourceError(f"{source.path}: say what {' and '.join(lacking)} are; there are {there}")

    def __len__(self) -> int:
        return min(len(self.source), self.settings.episodes or len(self.source))

    def task(self) -> Task:
        """What an agent must know of them."""
        settings, first = self.settings, self._read(0)
        actions = [join_vectors(self._read(number, "action")["action"]) for number in range(len(self))]
        discrete = not actions[0].is_floating_point() and actions[0].shape[-1] == 1
        every = torch.cat(actions)
        height, width = self._images(first).shape[-2:]
        return Task(
            name=settings.name,
            image_size=height if height == width else (height, width),
            objects=settings.objects,
            proprio=join_vectors(first["proprio"]).shape[-1],
            action=(settings.actions or int(every.max()) + 1) if discrete else every.shape[-1],
            workspace=self._workspace(),
            action_range=None if discrete else self._action_range(every.float()),
            discrete=discrete,
        )

    def records(self, number: int, task: Task) -> TensorDictBase:
        """Records ``[T + 1]`` of an episode."""
        arrays = self._read(number)
        frames = self._frames(arrays, task)
        length = len(frames["pixels"])
        done = (torch.arange(length) == length - 1).unsqueeze(-1)
        action = _to_task(self._steps(number, "action", join_vectors(arrays["action"]), length), task)
        after = {"done": done, "terminated": torch.zeros_like(done)}
        if self.names["terminated"]:
            ended = self._steps(number, "terminated", join_vectors(arrays["terminated"]).bool(), length)
            after["terminated"] = _after_nothing(ended) & done
        if self.names["reward"]:
            reward = self._steps(number, "reward", join_vectors(arrays["reward"]).float(), length)
            after["reward"] = _after_nothing(reward)
        is_init = (torch.arange(length) == 0).unsqueeze(-1)
        next_ = TensorDict({**frames, **after}, [length])
        return TensorDict({"action": _after_nothing(action), "is_init": is_init, "next": next_}, [length])

    # What belongs to frames.

    def _frames(self, arrays: Mapping[str, list[np.ndarray]], task: Task) -> dict[str, Tensor]:
        objects = len(task.objects)
        frames = {"pixels": self._images(arrays), "proprio": join_vectors(arrays["proprio"]).float()}
        if self.names["masks"]:
            frames["masks"] = masks(arrays["masks"], objects, self._first_camera(arrays), task.image_shape)
        if self.names["object_position"]:
            position = self._metres(join_vectors(arrays["object_position"]), objects)
            visible = position.isfinite().all(-1)
            if self.names["object_visible"]:
                visible &= join_vectors(arrays["object_visible"]).bool()
            before = torch.zeros_like(position[0])
            frames["object_position"] = hold_last_seen(position.nan_to_num(), visible, before)
            frames["object_visible"] = visible
        if self.names["goal_position"]:
            frames["goal_position"] = self._metres(join_vectors(arrays["goal_position"]), 1).squeeze(-2)
        if len({len(values) for values in frames.values()}) > 1:
            rows = ", ".join(f"{len(values)} of {name}" for name, values in frames.items())
            raise SourceError(f"{self.source.path}: every frame needs all of {', '.join(frames)}; there are {rows}")
        return frames

    def _images(self, arrays: Mapping[str, list[np.ndarray]]) -> Tensor:
        return join_images([images(array, self._size()) for array in arrays["pixels"]])

    def _first_camera(self, arrays: Mapping[str, list[np.ndarray]]) -> tuple[int, int]:
        first = images(arrays["pixels"][0][:1], self._size())
        return first.shape[-2], first.shape[-1]

    def _size(self) -> tuple[int, int] | None:
        size = self.settings.image_size
        return None if size is None else image_shape(size)

    def _metres(self, position: Tensor, objects: int) -> Tensor:
        if position.shape[-1] % objects:
            raise SourceError(
                f"{self.source.path}: {position.shape[-1]} coordinates are not those of {objects} objects; name them "
                "in objects=[...]"
            )
        position = position.float().unflatten(-1, (objects, -1))
        start = self.settings.start or (0.0,) * position.shape[-1]
        if len(start) != position.shape[-1]:
            raise SourceError(f"start={list(start)} must have {position.shape[-1]} coordinates")
        return (position - torch.tensor(start)) * self.settings.metres

    def _steps(self, number: int, key: str, values: Tensor, frames: int) -> Tensor:
        """What belongs to the steps between frames; what follows the last frame is left out."""
        if len(values) not in (frames - 1, frames):
            raise SourceError(
                f"{self.source.path}: episode {number} has {frames} frames and {len(values)} rows of {key}; "
                f"there must be {frames} or {frames - 1}"
            )
        return values[: frames - 1]

    # What is known of all episodes.

    def _workspace(self) -> Workspace:
        if self.settings.low:
            return Workspace(low=self.settings.low, high=self.settings.high)
        if not self.names["object_position"]:
            return no_workspace()
        objects = len(self.settings.objects)
        read = [join_vectors(self._read(number, "object_position")["object_position"]) for number in range(len(self))]
        position = self._metres(torch.cat(read), objects)[:, 0]
        seen = position[position.isfinite().all(-1)]
        if not len(seen):
            name = self.settings.objects[0]
            raise SourceError(f"{self.source.path}: {name} is hidden in all frames; give low and high")
        return workspace_around(seen)

    def _action_range(self, actions: Tensor) -> ActionRange | None:
        if self.settings.action_low:
            return ActionRange(low=self.settings.action_low, high=self.settings.action_high)
        return None if actions.abs().max() <= 1 else ActionRange(*box(actions, least=1e-3))

    # What is read.

    def _names(self, key: str) -> tuple[str, ...]:
        given = getattr(self.settings.keys, key)
        if given is None:
            given = self.source.find(key)
        return (given,) if isinstance(given, str) else given or ()

    def _read(self, number: int, *keys: str) -> dict[str, list[np.ndarray]]:
        names = {key: self.names[key] for key in keys or self.names}
        arrays = self.source.read(number, list(dict.fromkeys(name for some in names.values() for name in some)))
        return {key: [arrays[name] for name in some] for key, some in names.items()}


def _to_task(action: Tensor, task: Task) -> Tensor:
    if task.discrete:
        if action.min() < 0 or action.max() >= task.action:
            raise DatasetError(
                f"actions={task.action}, but there are actions {int(action.min())} to {int(action.max())}"
            )
        return one_hot(action.squeeze(-1).long(), task.action).float()
    action = action.float()
    if task.action_range is None:
        return action
    normalised = task.action_range.normalise(action)
    # The ends of a range of the recordings are ends but for rounding; what is farther out is refused.
    return normalised.clamp(-1, 1) if normalised.abs().max() < 1 + 1e-4 else normalised


def _after_nothing(values: Tensor) -> Tensor:
    """Records ``[T + 1]``: the first leads from nowhere to the first frame."""
    return torch.cat([torch.zeros_like(values[:1]), values])
