"""Arrays of others, as the data contract has them (docs/data.md)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from torchrl_ocwm.data.formats import SourceError
from torchrl_ocwm.envs.workspace import Workspace


def images(array: np.ndarray, size: tuple[int, int] | None) -> Tensor:
    """Images ``[T, 3, H, W]`` uint8.

    Args:
        array: ``[T, H, W, 3]`` or ``[T, 3, H, W]``; or grey, with one channel or none. Bytes, or numbers in [0, 1].
        size: Height and width to scale to; ``None``: as they are.

    Raises:
        SourceError: for what is no image.

    Examples:
        >>> images(np.ones((5, 48, 64, 3), np.float32), (12, 16)).shape
        torch.Size([5, 3, 12, 16])
    """
    frames = torch.from_numpy(np.ascontiguousarray(array))
    if frames.ndim == 3:
        frames = frames.unsqueeze(-1)
    if frames.ndim == 4 and frames.shape[-1] in (1, 3):
        frames = frames.movedim(-1, -3)
    if frames.ndim != 4 or frames.shape[-3] not in (1, 3):
        raise SourceError(f"images have 3 channels or 1, got an array of shape {array.shape}")
    if frames.is_floating_point():
        if not ((frames >= 0) & (frames <= 1)).all():
            raise SourceError(f"floating images lie in [0, 1], got {frames.min():g} to {frames.max():g}")
        frames = (255 * frames).round().to(torch.uint8)
    if frames.dtype != torch.uint8:
        raise SourceError(f"images are bytes or numbers in [0, 1], got {array.dtype}")
    if size is not None and frames.shape[-2:] != size:
        frames = (
            interpolate(frames.float(), size, mode="bilinear", antialias=True).round().clamp(0, 255).to(torch.uint8)
        )
    return frames.expand(-1, 3, -1, -1).contiguous()


def join_images(cameras: Sequence[Tensor]) -> Tensor:
    """Images of several cameras ``[T, 3, H, W]`` side by side, the lower ones filled with black below.

    Examples:
        >>> join_images([torch.ones(2, 3, 8, 8), torch.ones(2, 3, 4, 6)]).shape
        torch.Size([2, 3, 8, 14])
    """
    height = max(camera.shape[-2] for camera in cameras)
    return torch.cat([pad(camera, (0, 0, 0, height - camera.shape[-2])) for camera in cameras], -1)


def masks(arrays: Sequence[np.ndarray], objects: int, camera: tuple[int, int], shape: tuple[int, int]) -> Tensor:
    """Masks ``[T, O, H, W]`` bool.

    Args:
        arrays: ``[T, O, H, W]``, or ``[T, H, W]`` for each object; true, or not zero, where the object is.
        objects: Number of objects O.
        camera: Height and width of the images that they belong to, to which they are scaled.
        shape: Height and width of the images of all cameras; the others have no masks.

    Raises:
        SourceError: if there are not as many as objects.
    """
    each = [torch.from_numpy(np.ascontiguousarray(array)) for array in arrays]
    each = [mask.unsqueeze(1) if mask.ndim == 3 else mask for mask in each]
    there = torch.cat([mask.squeeze(-1).unsqueeze(1) if mask.shape[-1] == 1 else mask for mask in each], 1) != 0
    if there.ndim != 4 or there.shape[1] != objects:
        raise SourceError(f"masks have shape {(*there.shape,)}; expected one for each of {objects} objects")
    scaled = interpolate(there.float(), camera, mode="nearest-exact") > 0
    return pad(scaled, (0, shape[1] - camera[1], 0, shape[0] - camera[0]))


def box(values: Tensor, *, least: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Lower and upper corner of the smallest box around values ``[N, D]``, no side shorter than ``2 * least``.

    Examples:
        >>> box(torch.tensor([[1.0, 0.0], [3.0, 0.0]]), least=0.5)
        ((1.0, -0.5), (3.0, 0.5))
    """
    middle, half = (values.amax(0) + values.amin(0)) / 2, (values.amax(0) - values.amin(0)) / 2
    half = half.clamp_min(least)
    return tuple((middle - half).tolist()), tuple((middle + half).tolist())


def workspace_around(position: Tensor) -> Workspace:
    """The workspace of recordings in which an object is at positions ``[N, D]``, metres.

    Examples:
        >>> workspace_around(torch.tensor([[0.25, -0.5], [0.5, 0.5]]))
        Workspace(low=(0.25, -0.5), high=(0.5, 0.5), reach=None, landmarks=())
    """
    return Workspace(*box(position, least=0.01))


def no_workspace(dim: int = 2) -> Workspace:
    """The workspace of recordings without positions, ±1 on each axis: none is known."""
    return Workspace((-1.0,) * dim, (1.0,) * dim)


def join_vectors(arrays: Sequence[np.ndarray]) -> Tensor:
    """Arrays ``[T, ...]`` one after the other, ``[T, F]``.

    Examples:
        >>> join_vectors([np.zeros((5, 2, 3)), np.zeros(5)]).shape
        torch.Size([5, 7])
    """
    each = [torch.from_numpy(np.ascontiguousarray(array)) for array in arrays]
    return torch.cat([values.reshape(len(values), -1) for values in each], -1)
