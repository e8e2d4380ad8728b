"""A transposed convolution as a plain one gives what PyTorch's does, forward and backward."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_ocwm.modules import upsampling
from torchrl_ocwm.modules.upsampling import upsample


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-4), (torch.bfloat16, 0.1)])
@pytest.mark.parametrize(("image", "out"), [((2, 3, 5, 4), 4), ((1, 2, 1, 3), 1)])
def test_values_and_gradients_are_those_of_pytorch(
    image: tuple[int, ...], out: int, dtype: torch.dtype, tolerance: float
) -> None:
    layer = nn.ConvTranspose2d(image[1], out, 5, 2, 2, 1).to(dtype)
    hidden = torch.randn(image, dtype=dtype, requires_grad=True)
    inputs = [hidden, *layer.parameters()]
    expected, got = layer(hidden) + 0.5, upsample(hidden, layer, 0.5)
    assert got.is_contiguous()
    torch.testing.assert_close(got, expected, atol=tolerance, rtol=tolerance)
    gradient = torch.randn_like(got)
    for one, other in zip(
        torch.autograd.grad(got, inputs, gradient), torch.autograd.grad(expected, inputs, gradient), strict=True
    ):
        torch.testing.assert_close(one, other, atol=tolerance, rtol=tolerance)


def test_what_compiles_or_is_elsewhere_is_pytorchs_own(monkeypatch: pytest.MonkeyPatch) -> None:
    layer, hidden = nn.ConvTranspose2d(3, 2, 5, 2, 2, 1), torch.randn(2, 3, 5, 4)
    monkeypatch.setattr(upsampling, "_Interleave", None)
    assert upsample(hidden.to("meta"), layer.to("meta"), 0.5).device.type == "meta"
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    layer = nn.ConvTranspose2d(3, 2, 5, 2, 2, 1)
    assert torch.equal(upsample(hidden, layer, 0.5), layer(hidden) + 0.5)
