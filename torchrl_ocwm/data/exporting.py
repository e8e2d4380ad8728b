"""A dataset in the formats of others."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ocwm.data.dataset import DatasetError, EpisodeDataset
from torchrl_ocwm.data.formats.source import Format
from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.settings import read

#: What belongs to steps, and not to frames.
_STEPS = ("reward", "terminated")
Arrays = dict[str, np.ndarray]


def export_dataset(
    dataset: EpisodeDataset,
    destination: str | Path,
    format: Format,  # noqa: A002
    *,
    fps: int = 10,
) -> None:
    """Write the episodes of a dataset in a format of others; :func:`~torchrl_ocwm.data.import_dataset` reads it again.

    Images become height × width × 3, actions get the robot's units again (:class:`~torchrl_ocwm.envs.ActionRange`), and
    discrete ones their numbers.

    Args:
        dataset: The dataset, with a task.
        destination: For ``"hdf5"`` a file as robomimic has it, for ``"npz"`` a folder, for ``"lerobot"`` a folder that
            LeRobot's own library writes, for ``"minari"`` the id of a dataset, such as ``"my_arm/demos-v0"``, which
            Minari's library keeps where ``MINARI_DATASETS_PATH`` says.
        format: The format.
        fps: Frames per second, for ``"lerobot"``; datasets do not know theirs.

    Raises:
        DatasetError: if the dataset has no task, something is there already, or an id is none that Minari takes.
        MissingPackageError: if a package for the format is missing, with the extra to install.
    """
    read(Format, format, "format")
    task = dataset.task
    if format != "minari" and Path(destination).exists():
        raise DatasetError(f"{destination}: is there already; choose another place")
    if format == "lerobot":
        _write_lerobot(dataset, Path(destination), task, fps)
    else:
        _WRITERS[format](str(destination), task, (_arrays(records, task) for records in dataset))


def _arrays(records: Any, task: Task) -> Arrays:
    """Frames ``[T + 1, ...]`` and steps ``[T, ...]`` of an episode."""
    arrays = {name: value for name, value in records["next"].items() if name not in ("done", "truncated")}
    arrays["pixels"] = arrays["pixels"].movedim(-3, -1)
    action = task.to_robot(records["action"][1:])
    steps = {name: arrays[name][1:].squeeze(-1) for name in _STEPS if name in arrays}
    return {name: value.numpy() for name, value in {**arrays, **steps, "action": action}.items()}


def _frames(arrays: Arrays) -> Arrays:
    return {name: array for name, array in arrays.items() if name not in (*_STEPS, "action")}


def _reward(arrays: Arrays) -> np.ndarray:
    return arrays.get("reward", np.zeros(len(arrays["action"]), np.float32))


def _write_npz(destination: str, task: Task, episodes: Iterator[Arrays]) -> None:  # noqa: ARG001
    Path(destination).mkdir(parents=True)
    for number, arrays in enumerate(episodes):
        np.savez_compressed(Path(destination, f"episode_{number:06d}.npz"), **arrays)  # type: ignore[arg-type]


def _write_hdf5(destination: str, task: Task, episodes: Iterator[Arrays]) -> None:
    with needs("writing HDF5", "import"):
        import h5py
    Path(destination).parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(destination, "w") as file:
        data, total = file.create_group("data"), 0
        for number, arrays in enumerate(episodes):
            demo, steps = data.create_group(f"demo_{number}"), len(arrays["action"])
            demo.attrs["num_samples"] = steps
            demo["actions"], demo["rewards"] = arrays["action"], _reward(arrays)
            demo["dones"] = (np.arange(steps) == steps - 1).astype(np.int64)
            demo["terminated"] = arrays["terminated"]
            for name, array in _frames(arrays).items():
                demo[f"obs/{name}"], demo[f"next_obs/{name}"] = array[:-1], array[1:]
            total += steps
        data.attrs["total"] = total
        data.attrs["env_args"] = json.dumps({"env_name": task.name, "type": 2, "env_kwargs": {}})


def _write_minari(destination: str, task: Task, episodes: Iterator[Arrays]) -> None:
    with needs("writing a Minari dataset", "import"):
        import minari
        from gymnasium import spaces
        from minari.data_collector import EpisodeBuffer
    _check_minari_id(destination)
    buffers, first = [], None
    for number, arrays in enumerate(episodes):
        arrays["pixels"] = np.moveaxis(arrays["pixels"], -1, -3)  # as images Minari would compress them, with losses
        first = first or arrays
        steps = len(arrays["action"])
        last = np.arange(steps) == steps - 1
        buffers.append(
            EpisodeBuffer(
                id=number,
                observations=_frames(arrays),
                actions=arrays["action"],
                rewards=list(_reward(arrays)),
                terminations=list(arrays["terminated"]),
                truncations=list(last & ~arrays["terminated"]),
            )
        )
    assert first is not None
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=UserWarning, module="minari")  # of what a dataset does not know
        minari.create_dataset_from_buffers(
            destination,
            buffers,
            observation_space=spaces.Dict({name: _space(spaces, array) for name, array in _frames(first).items()}),
            action_space=spaces.Discrete(task.action) if task.discrete else _space(spaces, first["action"]),
            description=f"Exported from torchrl_ocwm, environment {task.name}",
        )


def _check_minari_id(name: str) -> None:
    import minari
    from minari.dataset.minari_dataset import parse_dataset_id

    try:
        parse_dataset_id(name)
    except (TypeError, ValueError):  # without a version, or another form
        raise DatasetError(
            f"{name!r} is no id of a Minari dataset; it is a name with a version, as in demos-v0 or my_arm/demos-v0"
        ) from None
    if name in minari.list_local_datasets():
        raise DatasetError(f"{name}: is there already; choose another name or version")


def _space(spaces: Any, array: np.ndarray) -> Any:
    low, high = {"u": (0, 255), "b": (0, 1)}.get(array.dtype.kind, (-np.inf, np.inf))
    return spaces.Box(low, high, array.shape[1:], array.dtype.type)


def _write_lerobot(dataset: EpisodeDataset, destination: Path, task: Task, fps: int) -> None:
    with needs("writing a LeRobot dataset", ""):
        from lerobot.datasets.lerobot_dataset import LeRobotDataset
    names = {"pixels": "observation.images.camera", "proprio": "observation.state", "action": "action"}
    written = None
    for records in dataset:
        arrays = _arrays(records, task)
        arrays["action"] = arrays["action"].reshape(len(arrays["action"]), -1)
        steps = len(arrays["action"])
        named = {names.get(name, f"observation.{name}"): array for name, array in _frames(arrays).items()}
        named |= {"action": arrays["action"], "next.reward": _reward(arrays).reshape(-1, 1)}
        if written is None:
            features = {
                name: {
                    "dtype": "image" if name == names["pixels"] else str(array.dtype),
                    "shape": array.shape[1:],
                    "names": ["height", "width", "channels"] if name == names["pixels"] else None,
                }
                for name, array in named.items()
            }
            written = LeRobotDataset.create(task.name, fps, features, root=destination, use_videos=False)
        for step in range(steps):
            written.add_frame({name: array[step] for name, array in named.items()} | {"task": task.name})
        written.save_episode()
    if written is not None and hasattr(written, "finalize"):
        written.finalize()


_WRITERS: dict[Format, Callable[[str, Task, Iterator[Arrays]], None]] = {
    "hdf5": _write_hdf5,
    "minari": _write_minari,
    "npz": _write_npz,
}
