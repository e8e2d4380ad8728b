"""How large images are."""

from __future__ import annotations

#: Pixels of each side, or height and width.
ImageSize = int | tuple[int, int]


def image_shape(size: ImageSize) -> tuple[int, int]:
    """Height and width, pixels.

    Examples:
        >>> image_shape(64), image_shape((48, 80))
        ((64, 64), (48, 80))
    """
    return (size, size) if isinstance(size, int) else size
