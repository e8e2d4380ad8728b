"""A transposed convolution with few output channels, as a plain one: it fills the vectors of a processor better."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import conv2d, pad

# Two neighbours as one number, to move them at once.
_PAIR = {torch.float64: torch.complex128, torch.float32: torch.float64}
_PAIR |= dict.fromkeys((torch.bfloat16, torch.float16), torch.float32)


def upsample(image: Tensor, layer: nn.ConvTranspose2d, shift: float = 0.0) -> Tensor:
    """What a transposed convolution that doubles an image makes of it.

    Each pixel becomes 2 x 2 of them. A convolution of stride 1 gives these as channels, of which there are four times
    as many; then they are put in their places.

    Args:
        image: ``[N, I, H, W]``.
        layer: With a kernel of 5 x 5, stride 2, padding 2 and output padding 1.
        shift: Added to its bias.

    Returns:
        ``[N, O, 2H, 2W]``.

    Examples:
        >>> layer, image = nn.ConvTranspose2d(3, 2, 5, 2, 2, 1), torch.rand(4, 3, 6, 5)
        >>> torch.allclose(upsample(image, layer, 0.5), layer(image) + 0.5, atol=1e-6)
        True
    """
    if torch.compiler.is_compiling() or image.device.type != "cpu":
        return layer(image) + shift  # nothing to fill there, and Inductor has no code for some views (PyTorch 2.11)
    into, out = layer.weight.shape[:2]
    # Row 2m + s of the result is made of rows m - 1, m and m + 1 by the rows 4 + s, 2 + s and s of the kernel.
    rows = pad(layer.weight, (0, 1, 0, 1)).view(into, out, 3, 2, 3, 2).flip(2, 4)
    kernel = rows.permute(1, 3, 5, 0, 2, 4).reshape(4 * out, into, 3, 3)
    assert layer.bias is not None
    return _Interleave.apply(conv2d(image, kernel, (layer.bias + shift).repeat_interleave(4), padding=1))


class _Interleave(torch.autograd.Function):
    """``[N, O * 4, H, W]``, channels, rows and columns of what each pixel becomes, to ``[N, O, 2H, 2W]``."""

    @staticmethod
    def forward(ctx: Any, parts: Tensor) -> Tensor:  # noqa: ARG004
        pairs = parts.movedim(1, -1).contiguous().view(_PAIR[parts.dtype]).unflatten(-1, (-1, 2))
        return pairs.permute(0, 3, 1, 4, 2).contiguous().view(parts.dtype).flatten(2, 3)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:  # noqa: ARG004
        count, out, height, width = gradient.shape
        pairs = gradient.contiguous().view(_PAIR[gradient.dtype]).view(count, out, height // 2, 2, width // 2)
        rows = pairs.transpose(1, 2).flatten(2, 3)  # in two turns, which is faster than one
        return rows.transpose(2, 3).contiguous().view(gradient.dtype).movedim(-1, 1)
