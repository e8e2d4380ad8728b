"""Frames of videos."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchrl_ocwm.data.formats.source import SourceError
from torchrl_ocwm.envs.missing import needs


def read_video(file: Path, start: float = 0.0, frames: int | None = None) -> np.ndarray:
    """Frames ``[T, H, W, 3]`` uint8 of a video.

    Args:
        file: The video.
        start: Seconds into it.
        frames: How many T; ``None``: to its end.

    Raises:
        SourceError: if it cannot be read, or has fewer.
        MissingPackageError: if imageio is missing, with the extra to install.
    """
    read: list[np.ndarray] = []
    with _open(file, start) as reader:
        for frame in reader:
            if len(read) == frames:
                break
            read.append(np.asarray(frame))
    if not read or (frames is not None and len(read) < frames):
        raise SourceError(f"{file}: has {len(read)} frames from second {start:g} on, not {frames or 'one'}")
    return np.stack(read)


def video_shape(file: Path) -> tuple[int, int, int]:
    """Height, width and channels."""
    with _open(file) as reader:
        width, height = reader.get_meta_data()["size"]
    return height, width, 3


def _open(file: Path, start: float = 0.0) -> Any:
    with needs("reading videos", "import"):
        import imageio.v2
    try:
        return imageio.v2.get_reader(file, "FFMPEG", input_params=["-ss", f"{start:.6f}"] if start else [])
    except (OSError, ValueError) as error:
        raise SourceError(f"{file}: cannot be read as a video ({error})") from error
