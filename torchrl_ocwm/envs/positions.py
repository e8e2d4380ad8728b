"""From segmentation masks to positions in the world (paper, section "Object Positioning Tasks")."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from torchrl_ocwm.envs.rays import pixel_rays, undistort


def mask_centroid(masks: Tensor) -> tuple[Tensor, Tensor]:
    """Centroids of masks in pixel coordinates; the centre of the first pixel is (0.5, 0.5).

    Args:
        masks: ``[..., H, W]`` bool.

    Returns:
        Centroids ``[..., 2]`` float32 as (column, row), zero for an empty mask, and ``[..., 1]`` float32 pixel counts.

    Examples:
        >>> mask = torch.zeros(4, 4, dtype=torch.bool)
        >>> mask[1, 2:4] = True
        >>> mask_centroid(mask)[0]
        tensor([3.0000, 1.5000])
    """
    height, width = masks.shape[-2:]
    sums = masks.flatten(-2).float() @ _pixel_sums(height, width, masks.device)
    count = sums[..., 2:]
    return sums[..., :2] / count.clamp_min(1), count


@lru_cache(maxsize=32)
def _pixel_sums(height: int, width: int, device: torch.device) -> Tensor:
    """``[H * W, 3]``: column, row and 1 of each pixel, so that one product sums all three over a mask."""
    rows, columns = torch.meshgrid(torch.arange(0.5, height), torch.arange(0.5, width), indexing="ij")
    return torch.stack([columns, rows, torch.ones_like(rows)], -1).flatten(0, 1).to(device)


def pixels_to_world(
    pixels: Tensor,
    intrinsics: Tensor,
    extrinsics: Tensor,
    *,
    depth: Tensor | None = None,
    plane: Tensor | None = None,
) -> Tensor:
    """Points in the world behind pixels: along the pixel's ray, at a depth or where the ray meets a plane.

    Args:
        pixels: ``[..., N, 2]`` as (column, row).
        intrinsics: ``[..., 3, 3]`` pinhole matrix without skew, pixels.
        extrinsics: ``[..., 4, 4]`` camera-to-world matrix (x right, y down, z into the scene), metres.
        depth: ``[..., N]`` metres along the optical axis.
        plane: ``[4]`` plane (n, d) with n · x = d in world coordinates, used when there is no depth.

    Returns:
        ``[..., N, 3]`` metres, world frame; not a number where the ray misses the plane or the depth is no positive
        finite number.

    Raises:
        ValueError: unless exactly one of ``depth`` and ``plane`` is given.

    Examples:
        >>> intrinsics = torch.tensor([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]])
        >>> pixels_to_world(torch.tensor([[6.0, 5.0]]), intrinsics, torch.eye(4), depth=torch.tensor([2.0]))
        tensor([[0.2000, 0.0000, 2.0000]])
    """
    if (depth is None) == (plane is None):
        raise ValueError("give either the depth of the pixels or the plane that they lie on")
    origin, rays = pixel_rays(pixels, intrinsics, extrinsics)
    if depth is None:
        assert plane is not None
        normal, offset = plane[:3], plane[3]
        depth = (offset - origin @ normal) / (rays @ normal)
    depth = torch.where(_is_valid(depth), depth, torch.nan)
    return origin + rays * depth.unsqueeze(-1)


def _is_valid(depth: Tensor) -> Tensor:
    return depth.isfinite() & (depth > 0)


def masks_to_positions(
    masks: Tensor,
    intrinsics: Tensor,
    extrinsics: Tensor,
    *,
    distortion: Tensor | None = None,
    depth: Tensor | None = None,
    plane: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """World positions of segmented objects: centroid of the mask → ray of the camera → depth or plane.

    Pixels without a valid depth (zero, negative, infinite, not a number) count as no part of any mask.

    Args:
        masks: ``[..., O, H, W]`` bool, one mask per object; of integers, all but 0 belong to the object.
        intrinsics: ``[..., 3, 3]``, pixels.
        extrinsics: ``[..., 4, 4]`` camera to world, metres.
        distortion: ``[K]`` OpenCV's coefficients of the lens (:func:`~torchrl_ocwm.envs.undistort`).
        depth: ``[..., 1, H, W]`` metres, of any floating-point type; the mean over the mask is taken.
        plane: ``[4]`` plane (n, d) that the objects move on, if there is no depth.

    Returns:
        Positions ``[..., O, 3]`` float32 metres, and ``[..., O]`` bool: false, and the position zero, where nothing of
        a mask can be used or its ray misses the plane.

    Raises:
        ValueError: for masks of probabilities, depth of integers, and shapes that do not fit each other.

    Examples:
        >>> masks = torch.zeros(1, 10, 10, dtype=torch.bool)
        >>> masks[0, 5, 6:8] = True
        >>> intrinsics = torch.tensor([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]])
        >>> above = torch.diag(torch.tensor([1.0, -1, -1, 1]))
        >>> above[2, 3] = 2.0
        >>> masks_to_positions(masks, intrinsics, above, plane=torch.tensor([0.0, 0, 1, 0]))
        (tensor([[ 0.4000, -0.1000,  0.0000]]), tensor([True]))
    """
    _check_images(masks, depth)
    with torch.autocast(masks.device.type, enabled=False):  # half precision does not count pixels
        masks = masks.bool()
        if depth is not None:
            depth = depth.float()
            masks = masks & _is_valid(depth)
        centroid, count = mask_centroid(masks)
        if depth is not None:
            depth = torch.where(masks, depth, 0).sum((-1, -2)) / count.squeeze(-1)
        if distortion is not None:
            centroid = undistort(centroid, intrinsics.float(), distortion.float())
        position = pixels_to_world(centroid, intrinsics.float(), extrinsics.float(), depth=depth, plane=plane)
        visible = (count.squeeze(-1) > 0) & position.isfinite().all(-1)
    return torch.where(visible.unsqueeze(-1), position, 0), visible


def _check_images(masks: Tensor, depth: Tensor | None) -> None:
    if masks.is_floating_point():
        raise ValueError(f"masks must be bool, got {masks.dtype}; for probabilities give masks > 0.5")
    if depth is None:
        return
    if not depth.is_floating_point():
        raise ValueError(
            f"depth must be in metres as float, got {depth.dtype}; for millimetres give depth.float() / 1000"
        )
    if depth.ndim != masks.ndim or depth.shape[-3] != 1 or depth.shape[-2:] != masks.shape[-2:]:
        raise ValueError(
            f"masks [..., O, H, W] need depth [..., 1, H, W], got {tuple(masks.shape)} and {tuple(depth.shape)}"
        )


def hold_last_seen(position: Tensor, visible: Tensor, before: Tensor, is_init: Tensor | None = None) -> Tensor:
    """Replace the positions of hidden objects by where they were last seen.

    Args:
        position: ``[T, ..., O, D]``.
        visible: ``[T, ..., O]`` bool.
        before: ``[..., O, D]``, what to use until an object is seen for the first time.
        is_init: ``[T, ..., 1]`` bool, true where an episode starts, in which nothing has been seen.

    Examples:
        >>> position, visible = torch.tensor([[[1.0]], [[9.0]]]), torch.tensor([[True], [False]])
        >>> hold_last_seen(position, visible, before=torch.zeros(1, 1)).flatten()
        tensor([1., 1.])
    """
    time = torch.arange(1, len(position) + 1, device=position.device).reshape(-1, *[1] * (visible.ndim - 1))
    last = (time * visible).cummax(0).values
    if is_init is not None:
        last = last * (last >= (time * is_init).cummax(0).values)
    return torch.cat([before.unsqueeze(0), position]).gather(0, last.unsqueeze(-1).expand_as(position))
