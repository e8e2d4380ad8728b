"""A disc in the image where the goal is (paper, "Size matters!")."""

from __future__ import annotations

import numpy as np

TARGET_COLOUR = (230, 40, 40)


def draw_target(pixels: np.ndarray, centre: np.ndarray, diameter: float, *, behind: np.ndarray) -> np.ndarray:
    """Draw a disc into an image, at least the pixel that its middle is nearest to.

    Args:
        pixels: (H, W, 3) uint8, drawn into.
        centre: (2,) pixels, as (column, row).
        diameter: Pixels.
        behind: (H, W) bool, what hides the disc.

    Returns:
        ``pixels``.

    Examples:
        >>> nothing = np.zeros((5, 5), bool)
        >>> draw_target(np.zeros((5, 5, 3), np.uint8), np.array([2.5, 1.5]), 3, behind=nothing)[..., 0]
        array([[  0, 230, 230, 230,   0],
               [  0, 230, 230, 230,   0],
               [  0, 230, 230, 230,   0],
               [  0,   0,   0,   0,   0],
               [  0,   0,   0,   0,   0]], dtype=uint8)
    """
    rows, columns = np.ogrid[: len(pixels), : pixels.shape[1]]
    distance = np.hypot(columns + 0.5 - centre[0], rows + 0.5 - centre[1])
    disc = (distance <= diameter / 2) | (distance == distance.min())
    pixels[disc & ~behind] = TARGET_COLOUR
    return pixels
