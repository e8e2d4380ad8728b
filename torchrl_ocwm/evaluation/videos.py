"""Videos of real and imagined rollouts."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

import imageio.v3 as imageio
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.data.dataset import EpisodeDataset
from torchrl_ocwm.errors import MissingPackageError
from torchrl_ocwm.evaluation.objects import decode_objects
from torchrl_ocwm.evaluation.open_loop import open_loop_latents
from torchrl_ocwm.evaluation.output import writing
from torchrl_ocwm.modules import ObjectWorldModel, RSSMWorldModel


class WriteVideo(Protocol):
    """:func:`write_video`, or what :func:`videos_beside` gives."""

    def __call__(self, path: str | Path, frames: Tensor, *, fps: int = 15, scale: int = 3) -> None:
        """Write a video, now or soon."""


def check_ffmpeg(setting: str) -> None:
    """Raise where no video can be written.

    Args:
        setting: Name of the setting with which there are none if it is 0.

    Raises:
        MissingPackageError: with what to install.
    """
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ModuleNotFoundError, RuntimeError) as error:
        raise MissingPackageError(
            f"videos need ffmpeg: pip install 'torchrl-ocwm[recipes]', or ask for none ({setting}=0)",
            name="imageio_ffmpeg",
        ) from error


def write_video(path: str | Path, frames: Tensor, *, fps: int = 15, scale: int = 3) -> None:
    """Write an mp4 video.

    Args:
        path: File to write.
        frames: ``[T, 3, H, W]`` uint8.
        fps: Frames per second.
        scale: Size of a pixel in the video.

    Raises:
        OutputError: if it cannot be written.
    """
    images = np.ascontiguousarray(frames.permute(0, 2, 3, 1).numpy())
    # H.264 takes even sizes only.
    filters = f"scale=iw*{scale}:ih*{scale}:flags=neighbor,pad=ceil(iw/2)*2:ceil(ih/2)*2"
    output = ["-vf", filters, "-preset", "veryfast"]
    options: dict[str, Any] = {"codec": "libx264", "macro_block_size": 1, "ffmpeg_log_level": "quiet"}
    with writing(path) as file:
        with suppress(OSError):  # FFmpeg has ended: with or without an error, see below
            imageio.imwrite(file, images, plugin="FFMPEG", fps=fps, output_params=output, **options)
        written = _frames(file)
        if written != len(images):
            raise OSError(f"ffmpeg wrote {written} of {len(images)} frames; is the disk full, or the folder not yours?")


@contextmanager
def videos_beside() -> Iterator[WriteVideo]:
    """A :func:`write_video` that returns at once, so that FFmpeg works while the next video is computed.

    At the end of the ``with`` block all of them are written.

    Raises:
        OutputError: then, if one could not be written.

    Examples:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp(), "black.mp4")
        >>> with videos_beside() as write:
        ...     write(file, torch.zeros(2, 3, 8, 8, dtype=torch.uint8))
        >>> file.exists()
        True
    """
    written: list[Future[None]] = []

    def write(path: str | Path, frames: Tensor, **options: Any) -> None:
        written.append(thread.submit(write_video, path, frames, **options))

    with ThreadPoolExecutor(1) as thread:
        yield write
    for one in written:
        one.result()


def _frames(file: Path) -> int:
    """How many frames a video has; none, if it is broken."""
    try:
        import imageio_ffmpeg  # may be missing where no videos are written

        return imageio_ffmpeg.count_frames_and_secs(file)[0]
    except RuntimeError:
        return 0


def tile(rows: list[Tensor], gap: int = 2) -> Tensor:
    """Lay videos out, one kind per row and one example per column.

    Args:
        rows: One ``[N, T, 3, H, W]`` uint8 per row.
        gap: Pixels between them.

    Returns:
        ``[T, 3, *, *]`` uint8.

    Examples:
        >>> tile([torch.zeros(2, 5, 3, 4, 4, dtype=torch.uint8)] * 3, gap=0).shape
        torch.Size([5, 3, 12, 8])
    """
    padded = [torch.nn.functional.pad(row, (0, gap, 0, gap), value=255) for row in rows]
    return torch.cat([torch.cat(list(row), -1) for row in padded], -2)


@torch.no_grad()
def open_loop_prediction(model: RSSMWorldModel, records: TensorDictBase, context: int) -> Tensor:
    """Images that a world model predicts from the first frames and the actions alone.

    Args:
        model: The world model.
        records: ``[N, T]`` records, the first of each sequence with ``is_init`` set.
        context: Frames that it sees; the others are predicted.

    Returns:
        ``[N, T, 3, H, W]`` uint8: reconstructions of the context, then predictions.
    """
    return decode_video(model, open_loop_latents(model, records, context))


@torch.no_grad()
def decode_video(model: RSSMWorldModel, latents: TensorDictBase) -> Tensor:
    """Videos ``[N, T, 3, H, W]`` uint8 of latents ``[N, T]`` with state and belief, step by step to save memory."""
    return torch.stack([to_uint8(decode_pixels(model, step)) for step in latents.unbind(1)], 1)


def decode_pixels(model: RSSMWorldModel, latent: TensorDictBase) -> Tensor:
    """Images ``[..., 3, H, W]`` float32 in [0, 1], unbounded, of latents ``{state, belief}``."""
    return model.pixels(latent["state"], latent["belief"])


def to_uint8(images: Tensor) -> Tensor:
    """Images in [0, 1] as uint8."""
    return (images.clamp(0, 1) * 255).round().to(torch.uint8)


def grey(masks: Tensor) -> Tensor:
    """Masks ``[..., H, W]`` in [0, 1] as images ``[..., 3, H, W]`` uint8: white where an object is.

    Examples:
        >>> grey(torch.tensor([[0.0, 1.0]]))[0]
        tensor([[  0, 255]], dtype=torch.uint8)
    """
    return to_uint8(masks.float()).unsqueeze(-3).expand(*masks.shape[:-2], 3, -1, -1)


class OpenLoopFilm:
    """Open-loop predictions on a few fixed sequences of a dataset: truth, model and error, one below the other.

    Below the images of an object-centric model are the masks that it predicts, one row per object.

    Args:
        agent: The agent in training.
        dataset: Where the sequences are from.
        folder: Where the videos go.
        sequences: How many.
        length: Frames of each, at most those of half of the episodes.
        context: Frames that the model sees.

    Raises:
        MissingPackageError: if there is no ffmpeg to write them with.

    Called with the number of updates; returns the file that it wrote.
    """

    def __init__(
        self,
        agent: Agent,
        dataset: EpisodeDataset,
        folder: str | Path,
        *,
        sequences: int = 6,
        length: int = 50,
        context: int = 5,
    ) -> None:
        check_ffmpeg("training.video_interval")
        self.agent, self.folder, self.context = agent, Path(folder), context
        lengths = torch.tensor(dataset.episode_lengths)
        length = min(length, int(lengths.median()))
        fitting = (lengths >= length).nonzero().flatten()
        episodes = fitting[torch.linspace(0, len(fitting) - 1, sequences).long()]
        starts = lengths.cumsum(0)[episodes] - lengths[episodes]
        self.records = dataset.records[starts[:, None] + torch.arange(length)].contiguous()

    @torch.no_grad()
    def __call__(self, updates: int) -> Path:
        """Write the video of this many updates."""
        model, device = self.agent.model, next(self.agent.parameters()).device
        latents = open_loop_latents(model, self.records.to(device), self.context)
        truth, predicted = self.records["next", "pixels"], decode_video(model, latents).cpu()
        masks: tuple[Tensor, ...] = ()
        if isinstance(model, ObjectWorldModel):
            masks = grey(decode_objects(model, latents)[1][:, :, :-1]).cpu().unbind(2)
        error = (predicted.int() - truth.int()).abs().to(torch.uint8)
        file = self.folder / f"open_loop_{updates:07d}.mp4"
        write_video(file, tile([truth, predicted, *masks, error]))
        return file


def mark(pixels: Tensor, points: Tensor) -> Tensor:
    """Draw a cross at a point of each video.

    Args:
        pixels: ``[N, T, 3, H, W]`` uint8.
        points: ``[N, 2]`` pixels, (column, row).
    """
    marked = pixels.clone()
    height, width = pixels.shape[-2:]
    for video, (column, row) in zip(marked, points.round().long().tolist(), strict=True):
        for x, y in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
            if 0 <= row + y < height and 0 <= column + x < width:
                video[:, :, row + y, column + x] = torch.tensor([230, 40, 40], dtype=torch.uint8)
    return marked
