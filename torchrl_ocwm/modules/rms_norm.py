"""RMS normalisation in a few operations, in place of PyTorch's, which a CPU decomposes into many."""

from __future__ import annotations

from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torchrl.modules.models import model_based

Module = TypeVar("Module", bound=nn.Module)


class RMSNorm(nn.Module):
    """Values by their root mean square over one dimension, times a learnt weight.

    Args:
        weight: ``[C]``.
        eps: Added to the mean square.
        dim: The dimension of C features.

    Called with ``[..., C]``, or what has C features at ``dim``; returns the same shape and dtype. It calculates in
    float32.

    Examples:
        >>> RMSNorm(nn.Parameter(torch.ones(2)))(torch.tensor([[3.0, 4.0]]))
        tensor([[0.8485, 1.1314]], grad_fn=<_RMSNormBackward>)
    """

    eps: Tensor

    def __init__(self, weight: nn.Parameter, eps: float = 1e-4, dim: int = -1) -> None:
        super().__init__()
        self.weight, self.dim = weight, dim
        self.register_buffer("eps", torch.tensor(eps, device=weight.device), persistent=False)

    def forward(self, value: Tensor) -> Tensor:
        """Normalise."""
        if self.dim == -1:
            return _RMSNorm.apply(value, self.weight, self.eps)
        last = value.movedim(self.dim, -1).contiguous()  # channels last, which convolutions are faster with, too
        return _RMSNorm.apply(last, self.weight, self.eps).movedim(-1, self.dim)


class _RMSNorm(torch.autograd.Function):
    """y = x r w with r = (mean x² + ε)^−½, over the last dimension."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, weight: Tensor, eps: Tensor) -> Tensor:
        x = value.float()
        norm = torch.linalg.vector_norm(x, dim=-1, keepdim=True)  # in one pass: |x|² = C · mean x²
        scale = torch.addcmul(eps, norm, norm, value=1 / x.shape[-1]).rsqrt_()
        unit = x * scale
        ctx.save_for_backward(unit, scale, weight)
        return (unit * weight).to(value.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        unit, scale, weight = ctx.saved_tensors
        gradient_float = gradient.float()
        product = gradient_float * unit
        along = (product @ weight).unsqueeze(-1)
        of_value = (gradient_float * weight).addcmul_(unit, along, value=-1 / len(weight)).mul_(scale)
        return of_value.to(gradient.dtype), product.flatten(0, -2).sum(0), None


def fast_norms(module: Module) -> Module:
    """Replace TorchRL's RMS normalisations inside a module; parameters and results stay what they are."""
    for name, child in module.named_children():
        if isinstance(child, model_based._DreamerV3RMSNorm):
            setattr(module, name, RMSNorm(child.weight, child.eps))
        elif isinstance(child, model_based._DreamerV3ChannelRMSNorm):
            setattr(module, name, RMSNorm(child.weight, child.eps, dim=-3))
        else:
            fast_norms(child)
    return module
