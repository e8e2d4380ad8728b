"""HDF5 files of robomimic, and of ManiSkill's ``RecordEpisode``: a group of arrays for each episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrl_ocwm.data.formats.source import Source, SourceError, flat, in_order
from torchrl_ocwm.envs.missing import needs


class HDF5Source(Source):
    """Groups with ``actions`` in them: ``data/demo_0`` of robomimic, ``traj_0`` of ManiSkill.

    The last frame of robomimic's episodes comes from ``next_obs``, if that is there.

    Args:
        path: The file.

    Raises:
        SourceError: if it cannot be read.
        MissingPackageError: if h5py is missing, with the extra to install.
    """

    usual = {"action": "actions", "reward": "rewards", "terminated": "terminated"}  # noqa: RUF012

    def __init__(self, path: str) -> None:
        super().__init__(path)
        with needs("reading HDF5", "import"):
            import h5py
        try:
            self.file = h5py.File(path, "r")
        except OSError as error:
            raise SourceError(f"{path}: cannot be read as HDF5 ({error})") from error
        found: list[str] = []
        self.file.visititems(lambda name, item: found.append(name) if _is_episode(item) else None)
        self.episodes = in_order(found)

    def __len__(self) -> int:
        return len(self.episodes)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names of the arrays of the first episode, each with the shape of a row."""
        return {name: array.shape[1:] for name, array in self._arrays(0).items() if not name.startswith("next_obs.")}

    def read(self, episode: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Arrays of an episode."""
        arrays, read = self._arrays(episode), {}
        for name in names:
            if name not in arrays:
                raise self.lacks(episode, name)
            read[name] = arrays[name][:]
            after = arrays.get(f"next_{name}") if name.startswith("obs.") else None
            if after is not None:
                read[name] = np.concatenate([read[name], after[-1:]])
        return read

    def _arrays(self, episode: int) -> dict[str, Any]:
        return {name: array for name, array in flat(self.file[self.episodes[episode]]) if _is_array(array)}


def _is_array(item: Any) -> bool:
    return bool(item.ndim) and item.dtype.kind in "biuf"


def _is_episode(item: Any) -> bool:
    return hasattr(item, "keys") and "actions" in item and hasattr(item["actions"], "shape")
