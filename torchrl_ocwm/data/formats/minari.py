"""Datasets of Minari."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ocwm.data.formats.source import Source, SourceError, flat
from torchrl_ocwm.envs.missing import needs

_PARTS = ("observations", "actions", "rewards", "terminations", "infos")


class MinariSource(Source):
    """Observations, actions, rewards, terminations and infos of a Minari dataset that is on this machine.

    Args:
        path: Its id, or its folder.

    Raises:
        SourceError: if there is none.
        MissingPackageError: if Minari is missing, with the extra to install.
    """

    usual = {"action": "actions", "reward": "rewards", "terminated": "terminations"}  # noqa: RUF012

    def __init__(self, path: str) -> None:
        super().__init__(path)
        with needs("a Minari dataset", "import"):
            import minari
        folder = Path(path, "data")
        try:
            self.dataset: Any = minari.MinariDataset(folder) if folder.exists() else minari.load_dataset(path)
        except (OSError, ValueError) as error:
            raise SourceError(
                f"{path}: no such file or folder, and no Minari dataset on this machine ({error}); "
                f"`minari download {path}` gets one of Minari's"
            ) from error

    def __len__(self) -> int:
        return self.dataset.total_episodes

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names of the arrays of the first episode, each with the shape of a row."""
        return {name: array.shape[1:] for name, array in self._arrays(0).items()}

    def read(self, episode: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Arrays of an episode."""
        arrays = self._arrays(episode)
        for name in names:
            if name not in arrays:
                raise self.lacks(episode, name)
        return {name: arrays[name] for name in names}

    def _arrays(self, episode: int) -> dict[str, np.ndarray]:
        data = self.dataset[episode]
        leaves = flat({part: getattr(data, part) for part in _PARTS})
        return {name: array for name, array in leaves if _is_read(array)}


def _is_read(array: Any) -> bool:
    """Not the texts, and not the images of less than 32 pixels, which Minari compresses but does not decompress."""
    return isinstance(array, np.ndarray) and array.ndim > 0 and array.dtype.kind in "biuf"
