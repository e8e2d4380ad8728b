"""From places in the world to points of an image, and back."""

from __future__ import annotations

import numpy as np


def project(world: np.ndarray, intrinsics: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Where places appear in an image of a pinhole camera.

    Args:
        world: (..., 3) metres.
        intrinsics: (3, 3), pixels.
        pose: (4, 4), from the camera's axes to those of the world; it looks along its z.

    Returns:
        (..., 2) pixels, as (column, row).

    Examples:
        >>> intrinsics = np.array([[50.0, 0, 32], [0, 50, 32], [0, 0, 1]])
        >>> project(np.array([0.2, 0.0, 1.0]), intrinsics, np.eye(4))
        array([42., 32.])
    """
    in_camera = (world - pose[:3, 3]) @ pose[:3, :3]
    in_image = in_camera @ intrinsics.T
    return in_image[..., :2] / in_image[..., 2:]


def unproject(point: np.ndarray, intrinsics: np.ndarray, pose: np.ndarray, axis: int, level: float) -> np.ndarray:
    """Which places of a plane across an axis of the world appear at points of an image; :func:`project` backwards.

    Args:
        point: (..., 2) pixels, as (column, row).
        intrinsics: (3, 3), pixels.
        pose: (4, 4), from the camera's axes to those of the world.
        axis: The axis that the plane is across.
        level: Where the plane cuts it, metres.

    Returns:
        (..., 3) float64 metres.

    Raises:
        ValueError: for a point where the camera does not see the plane.

    Examples:
        >>> intrinsics = np.array([[50.0, 0, 32], [0, 50, 32], [0, 0, 1]])
        >>> unproject(np.array([42.0, 32.0]), intrinsics, np.eye(4), axis=2, level=1.0)
        array([0.2, 0. , 1. ])
    """
    point, pose = np.asarray(point, np.float64), pose.astype(np.float64)
    pixels = np.concatenate([point, np.ones((*point.shape[:-1], 1))], -1)
    rays = pixels @ np.linalg.inv(intrinsics.astype(np.float64)).T @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (level - pose[axis, 3]) / rays[..., axis]
    if not (np.isfinite(far) & (far > 0)).all():
        raise ValueError(f"the camera does not see the plane of the goals at {point.tolist()} (column, row)")
    return pose[:3, 3] + far[..., None] * rays
