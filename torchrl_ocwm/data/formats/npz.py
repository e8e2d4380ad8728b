"""A folder with one ``.npz`` file per episode, and perhaps a video beside it, as a recording wrapper writes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchrl_ocwm.data.formats.source import Source, SourceError, in_order
from torchrl_ocwm.data.formats.video import read_video, video_shape

VIDEO = "video"


class NpzSource(Source):
    """The arrays of each file; a video of the same name (``episode_0.npz``, ``episode_0.mp4``) is called ``video``.

    Args:
        path: The folder.
    """

    usual = {"pixels": VIDEO}  # noqa: RUF012

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.files = [Path(path, name) for name in in_order(file.name for file in Path(path).glob("*.npz"))]

    def __len__(self) -> int:
        return len(self.files)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names of the arrays of the first episode, each with the shape of a row."""
        with self._open(0) as arrays:
            shapes = {name: arrays[name].shape[1:] for name in arrays.files if arrays[name].ndim}
        video = self._video(0)
        return shapes if video is None else {**shapes, VIDEO: video_shape(video)}

    def read(self, episode: int, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Arrays of an episode."""
        read, video = {}, self._video(episode)
        with self._open(episode) as arrays:
            for name in names:
                if name in arrays.files:
                    read[name] = arrays[name]
                elif name == VIDEO and video is not None:
                    read[name] = read_video(video)
                else:
                    raise self.lacks(episode, name)
        return read

    def _open(self, episode: int) -> np.lib.npyio.NpzFile:
        try:
            return np.load(self.files[episode], allow_pickle=False)
        except (OSError, ValueError) as error:
            raise SourceError(f"{self.files[episode]}: cannot be read ({error})") from error

    def _video(self, episode: int) -> Path | None:
        file = self.files[episode].with_suffix(".mp4")
        return file if file.exists() else None
