"""Rays of pinhole cameras: what lies behind a pixel, through a lens, and where the rays of several cameras meet."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad

_ROUNDS = 20  # each brings the error down by a factor; real lenses are exact after five to ten


def undistort(pixels: Tensor, intrinsics: Tensor, distortion: Tensor) -> Tensor:
    """Where pixels would be if the lens were without distortion.

    Args:
        pixels: ``[..., N, 2]`` as (column, row).
        intrinsics: ``[..., 3, 3]`` pinhole matrix without skew, pixels.
        distortion: ``[..., K]`` OpenCV's coefficients (k1, k2, p1, p2[, k3[, k4, k5, k6]]): K is 4, 5 or 8. Fisheye
            lenses have another model.

    Returns:
        ``[..., N, 2]``, seen by the same pinhole.

    Raises:
        ValueError: for another number of coefficients.

    Examples:
        >>> intrinsics = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
        >>> barrel = torch.tensor([-0.2, 0.0, 0.0, 0.0])
        >>> undistort(torch.tensor([[50.0, 50.0], [98.0, 50.0]]), intrinsics, barrel)
        tensor([[ 50.0000,  50.0000],
                [100.5895,  50.0000]])
    """
    check_distortion(distortion)
    k1, k2, p1, p2, k3, k4, k5, k6 = pad(distortion, (0, 8 - distortion.shape[-1])).unsqueeze(-2).unbind(-1)
    focal, centre = intrinsics.diagonal(dim1=-2, dim2=-1)[..., None, :2], intrinsics[..., None, :2, 2]
    seen = (pixels - centre) / focal
    x, y = seen.unbind(-1)
    for _ in range(_ROUNDS):
        square = x * x + y * y
        shrink = (1 + square * (k4 + square * (k5 + square * k6))) / (1 + square * (k1 + square * (k2 + square * k3)))
        shift_x = 2 * p1 * x * y + p2 * (square + 2 * x * x)
        shift_y = p1 * (square + 2 * y * y) + 2 * p2 * x * y
        x, y = (seen[..., 0] - shift_x) * shrink, (seen[..., 1] - shift_y) * shrink
    return torch.stack([x, y], -1) * focal + centre


def check_distortion(distortion: Tensor) -> None:
    """Whether :func:`undistort` knows the model.

    Raises:
        ValueError: for another number of coefficients than 4, 5 or 8.
    """
    if distortion.shape[-1:] not in ((4,), (5,), (8,)):
        raise ValueError(
            f"distortion must be 4, 5 or 8 of OpenCV's coefficients (k1, k2, p1, p2[, k3[, k4, k5, k6]]), got shape "
            f"{(*distortion.shape,)}; calibrate without CALIB_THIN_PRISM_MODEL and CALIB_TILTED_MODEL"
        )


def pixel_rays(pixels: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """The rays on which the things behind pixels lie.

    Args:
        pixels: ``[..., N, 2]`` as (column, row).
        intrinsics: ``[..., 3, 3]`` pinhole matrix without skew, pixels.
        extrinsics: ``[..., 4, 4]`` camera-to-world matrix (x right, y down, z into the scene), metres.

    Returns:
        Origins ``[..., 1, 3]`` and directions ``[..., N, 3]`` in the world; along the optical axis a direction is
        1 long.

    Examples:
        >>> intrinsics = torch.tensor([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]])
        >>> pixel_rays(torch.tensor([[6.0, 5.0]]), intrinsics, torch.eye(4))[1]
        tensor([[0.1000, 0.0000, 1.0000]])
    """
    focal = intrinsics.diagonal(dim1=-2, dim2=-1)[..., None, :2]
    in_camera = (pixels - intrinsics[..., None, :2, 2]) / focal
    rotation, origin = extrinsics[..., :3, :3], extrinsics[..., None, :3, 3]
    return origin, in_camera @ rotation[..., :2].mT + rotation[..., None, :, 2]


def intersect_rays(origins: Tensor, directions: Tensor) -> Tensor:
    """The points nearest to rays that should meet: least squares of their distances.

    Args:
        origins: ``[R, ..., 3]`` of R rays, metres.
        directions: ``[R, ..., 3]``, of any length.

    Returns:
        ``[..., 3]``; not a number where the rays are parallel, or a point lies behind a camera.

    Examples:
        >>> origins = torch.tensor([[0.0, 0, 0], [2, 0, 0]])
        >>> intersect_rays(origins, torch.tensor([[1.0, 1, 0], [-1, 1, 0]]))
        tensor([1.0000, 1.0000, 0.0000])
    """
    unit = normalize(directions, dim=-1)
    across = torch.eye(3, device=unit.device, dtype=unit.dtype) - unit.unsqueeze(-1) * unit.unsqueeze(-2)
    point, failed = torch.linalg.solve_ex(across.sum(0), (across @ origins.unsqueeze(-1)).sum(0))
    point = point.squeeze(-1)
    ahead = ((point - origins) * unit).sum(-1) > 0
    meet = ahead.all(0) & (failed == 0) & (_spread(unit) > 1e-6)
    return torch.where(meet.unsqueeze(-1), point, torch.nan)


def _spread(unit: Tensor) -> Tensor:
    """The square of the sine of the largest angle between the first ray and another one."""
    return torch.linalg.cross(unit[:1].expand_as(unit), unit, dim=-1).square().sum(-1).amax(0)
