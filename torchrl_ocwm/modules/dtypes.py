"""What images and flags mean in whatever dtype they were recorded."""

from __future__ import annotations

from torch import Tensor


def unit_image(pixels: Tensor) -> Tensor:
    """An image in [0, 1]. The dtype alone decides: integers are divided by 255, floating point is taken as it is.

    Args:
        pixels: ``[..., C, H, W]``, integers in 0…255 or floating point in [0, 1].

    Returns:
        ``[..., C, H, W]`` float32.

    Examples:
        >>> import torch
        >>> unit_image(torch.tensor([0, 51, 255], dtype=torch.uint8)), unit_image(torch.tensor([0.0, 0.2, 1.0]))
        (tensor([0.0000, 0.2000, 1.0000]), tensor([0.0000, 0.2000, 1.0000]))
    """
    return pixels.float() if pixels.is_floating_point() else pixels.float() / 255


def flags(values: Tensor, name: str) -> Tensor:
    """Masks and other flags as bool: integers are false where they are 0, so that 0/1 and 0/255 mean the same.

    Args:
        values: Any shape, bool or integers.
        name: What they are, for the message.

    Raises:
        TypeError: for floating point, of which nobody knows where it begins to be true.

    Examples:
        >>> import torch
        >>> flags(torch.tensor([0, 1, 255], dtype=torch.uint8), "masks")
        tensor([False,  True,  True])
    """
    if values.is_floating_point():
        raise TypeError(f"{name} must be bool, or integers that are 0 for false; got {values.dtype}, use {name} > 0.5")
    return values.bool()
