"""RMS normalisation in a few operations gives what PyTorch's does, forward and backward."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import rms_norm, silu
from torchrl.modules import DreamerV3ImageDecoder, DreamerV3ImageEncoder, DreamerV3MLP

from torchrl_ocwm.modules.networks import ImageDecoder
from torchrl_ocwm.modules.rms_norm import ChannelRMSNormSiLU, RMSNorm, fast_norms


@pytest.mark.parametrize(
    ("kind", "shape", "dim"),
    [(RMSNorm, (7, 5), -1), (RMSNorm, (2, 3, 5), -1), (ChannelRMSNormSiLU, (2, 5, 3, 4), -3)],
)
def test_values_and_gradients_are_those_of_pytorch(kind: type[RMSNorm], shape: tuple[int, ...], dim: int) -> None:
    features = shape[dim]
    norm = kind(torch.nn.Parameter(torch.rand(features)), eps=0.1)
    value = torch.randn(shape, requires_grad=True)
    slow = value.detach().double().requires_grad_()
    weight = norm.weight.detach().double().requires_grad_()
    expected = rms_norm(slow.movedim(dim, -1), (features,), weight, 0.1).movedim(-1, dim)
    expected = expected if kind is RMSNorm else silu(expected)
    got, gradient = norm(value), torch.randn(shape)
    torch.testing.assert_close(got, expected.float())
    got.backward(gradient)
    expected.backward(gradient.double())
    torch.testing.assert_close(value.grad, slow.grad.float())
    torch.testing.assert_close(norm.weight.grad, weight.grad.float())


def test_calculates_in_float32() -> None:
    norm = RMSNorm(torch.nn.Parameter(torch.ones(2)))
    large = torch.tensor([[300.0, 400.0]], dtype=torch.float16, requires_grad=True)  # its square is not a float16
    got = norm(large)
    assert got.dtype == torch.float16
    torch.testing.assert_close(got.float(), torch.tensor([[0.8485, 1.1314]]), rtol=1e-3, atol=0)
    got.sum().backward()
    assert large.grad.dtype == torch.float16


def test_keeps_float64() -> None:
    norm, value = RMSNorm(torch.nn.Parameter(torch.rand(3).double())), torch.rand(4, 3).double().requires_grad_()
    torch.testing.assert_close(norm(value), rms_norm(value, (3,), norm.weight, 1e-4), rtol=0, atol=1e-8)
    assert torch.autograd.gradcheck(lambda one: norm(one), value)


@pytest.mark.parametrize(
    ("network", "value", "kind"),
    [
        (DreamerV3MLP(4, 3, depth=2, num_cells=8), torch.randn(5, 4), RMSNorm),
        (DreamerV3ImageEncoder(3, 4, (1, 2)), torch.rand(2, 3, 8, 8), ChannelRMSNormSiLU),
    ],
)
def test_replaces_all_norms_of_a_network_and_keeps_its_parameters(
    network: torch.nn.Module, value: torch.Tensor, kind: type[RMSNorm]
) -> None:
    expected, names = network(value), [name for name, _ in network.named_parameters()]
    torch.testing.assert_close(fast_norms(network)(value), expected)
    assert [name for name, _ in network.named_parameters()] == names
    norms = [type(module) for module in network.modules() if "RMSNorm" in type(module).__name__]
    assert norms == [kind, kind]


def test_decoder_is_that_of_torchrl() -> None:
    plain = DreamerV3ImageDecoder(5, (3, 8, 8), 4, (1, 2), num_blocks=1)
    ours = fast_norms(ImageDecoder(5, (3, 8, 8), 4, (1, 2), num_blocks=1))
    ours.load_state_dict(plain.state_dict())
    latent, gradient = (torch.randn(2, 3, 4), torch.randn(2, 3, 1)), torch.randn(2, 3, 3, 8, 8)
    expected, got = plain(*latent), ours(*latent)
    torch.testing.assert_close(got, expected)
    got.backward(gradient)
    expected.backward(gradient)
    of_ours = dict(ours.named_parameters())
    for name, parameter in plain.named_parameters():
        torch.testing.assert_close(of_ours[name].grad, parameter.grad, rtol=1e-4, atol=1e-4, msg=name)
