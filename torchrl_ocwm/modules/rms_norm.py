"""RMS normalisation in a few operations, in place of PyTorch's, which a CPU decomposes into many."""

from __future__ import annotations

from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import silu
from torchrl.modules.models import model_based

Module = TypeVar("Module", bound=nn.Module)


class RMSNorm(nn.Module):
    """Values by their root mean square over the last dimension, times a learnt weight.

    Args:
        weight: ``[C]``.
        eps: Added to the mean square.

    Called with ``[..., C]``; returns the same shape and dtype. It calculates in float32 at least.

    Examples:
        >>> RMSNorm(nn.Parameter(torch.ones(2)))(torch.tensor([[3.0, 4.0]]))
        tensor([[0.8485, 1.1314]], grad_fn=<_RMSNormBackward>)
    """

    eps: Tensor

    def __init__(self, weight: nn.Parameter, eps: float = 1e-4) -> None:
        super().__init__()
        self.weight = weight
        self.register_buffer("eps", torch.tensor(eps, device=weight.device), persistent=False)

    def forward(self, value: Tensor) -> Tensor:
        """Normalise."""
        return _RMSNorm.apply(value, self.weight, self.eps)


class ChannelRMSNormSiLU(RMSNorm):
    """SiLU of the channels ``[..., C, H, W]`` of images, normalised as :class:`RMSNorm` does it.

    Both at once keep one copy of an image for the backward pass instead of three.

    Examples:
        >>> channels = torch.tensor([3.0, 4.0]).reshape(2, 1, 1)
        >>> ChannelRMSNormSiLU(nn.Parameter(torch.ones(2)))(channels).detach().flatten()
        tensor([0.5942, 0.8554])
    """

    def forward(self, value: Tensor) -> Tensor:
        """Normalise and activate."""
        last = value.movedim(-3, -1).contiguous()  # channels last, which convolutions are faster with, too
        return _RMSNormSiLU.apply(last, self.weight, self.eps).movedim(-1, -3)


class _RMSNorm(torch.autograd.Function):
    """y = x r w with r = (mean x² + ε)^−½, over the last dimension."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, weight: Tensor, eps: Tensor) -> Tensor:
        x = _precise(value)
        scale = _scale(x, eps)
        unit = x * scale
        ctx.save_for_backward(unit, scale, weight)
        return (unit * weight).to(value.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        unit, scale, weight = ctx.saved_tensors
        of_unit = _precise(gradient)
        along, of_weight = _gradients(of_unit, unit, weight)
        of_unit = of_unit * weight
        return of_unit.addcmul_(unit, along, value=-1 / len(weight)).mul_(scale).to(gradient.dtype), of_weight, None


class _RMSNormSiLU(torch.autograd.Function):
    """z σ(z) of z = x r w."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, weight: Tensor, eps: Tensor) -> Tensor:
        x = _precise(value)
        scale = _scale(x, eps)
        ctx.save_for_backward(value, scale, weight)
        return silu((x * scale).mul_(weight), inplace=True).to(value.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        value, scale, weight = ctx.saved_tensors
        unit = _precise(value) * scale
        inner = torch.ops.aten.silu_backward(_precise(gradient), unit * weight)
        along, of_weight = _gradients(inner, unit, weight)
        of_unit = inner.mul_(weight)  # in place: images are large
        return of_unit.addcmul_(unit, along, value=-1 / len(weight)).mul_(scale).to(gradient.dtype), of_weight, None


def _precise(value: Tensor) -> Tensor:
    return value if value.dtype == torch.float64 else value.float()


def _scale(x: Tensor, eps: Tensor) -> Tensor:
    """The scale r ``[..., 1]`` of values ``[..., C]``."""
    norm = torch.linalg.vector_norm(x, dim=-1, keepdim=True)  # in one pass: |x|² = C · mean x²
    return torch.addcmul(eps, norm, norm, value=1 / x.shape[-1]).rsqrt_()


def _gradients(gradient: Tensor, unit: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """From the gradient of y = u w with u = x r: w · g u ``[..., 1]``, and that of w ``[C]``."""
    rows = torch.atleast_2d(gradient * unit).flatten(0, -2)
    return (rows @ weight).view(*unit.shape[:-1], 1), rows.sum(0)


def fast_norms(module: Module) -> Module:
    """Replace TorchRL's RMS normalisations inside a module, those of channels with the SiLU that follows them.

    Parameters, their names and results stay what they are.
    """
    normalised = False
    for name, child in list(module.named_children()):
        if isinstance(child, model_based._DreamerV3RMSNorm):
            setattr(module, name, RMSNorm(child.weight, child.eps))
        elif isinstance(child, model_based._DreamerV3ChannelRMSNorm):
            setattr(module, name, ChannelRMSNormSiLU(child.weight, child.eps))
        elif normalised and isinstance(child, nn.SiLU):
            setattr(module, name, nn.Identity())
        else:
            fast_norms(child)
        normalised = isinstance(child, model_based._DreamerV3ChannelRMSNorm)
    return module
