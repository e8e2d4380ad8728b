"""The ensemble in one product, against member after member; how far predictions lie apart."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from torchrl_ocwm.modules import OneStepEnsemble, disagreement

SIZES = {"members": 4, "units": 6}


def inputs() -> tuple[Tensor, Tensor, Tensor]:
    return torch.randn(3, 5, 2), torch.randn(3, 5, 3), 3 * torch.randn(3, 5, 2)


def member(ensemble: OneStepEnsemble, number: int) -> nn.Sequential:
    """One of the networks, of PyTorch's own layers."""
    layers: list[nn.Module] = []
    for stacked in ensemble.layers:
        linear = nn.Linear(*stacked.weight.shape[1:])
        linear.weight.data, linear.bias.data = stacked.weight[number].T, stacked.bias[number, 0]
        between: dict[str, list[nn.Module]] = {
            "dreamer_v3": [nn.RMSNorm(SIZES["units"], elementwise_affine=False), nn.SiLU()],
            "dreamer_v2": [nn.ELU()],
        }
        layers += [linear, *between[ensemble.style]]
    last = max(index for index, layer in enumerate(layers) if isinstance(layer, nn.Linear))
    return nn.Sequential(*layers[: last + 1])


@pytest.mark.parametrize("style", ["dreamer_v3", "dreamer_v2"])
@pytest.mark.parametrize("layers", [0, 1, 3])
def test_each_member_is_a_network_of_its_own(style: Any, layers: int) -> None:
    ensemble, (state, belief, action) = OneStepEnsemble(7, 4, layers=layers, style=style, **SIZES), inputs()
    got = ensemble(state, belief, action)
    assert got.shape == (4, 3, 5, 4)
    together = torch.cat([state, belief, action.clamp(-1, 1)], -1)
    for number in range(4):
        torch.testing.assert_close(got[number], member(ensemble, number)(together))
    assert len(ensemble.layers) == layers + 1


def test_members_start_apart_and_learn_apart() -> None:
    ensemble = OneStepEnsemble(7, 4, layers=1, **SIZES)
    predictions = ensemble(*inputs())
    assert disagreement(predictions).min() > 1e-4
    predictions[2].sum().backward()
    for parameter in ensemble.parameters():
        assert [bool(one.abs().sum()) for one in parameter.grad] == [False, False, True, False]


def test_actions_beyond_the_bounds_keep_a_gradient() -> None:
    ensemble, (state, belief, action) = OneStepEnsemble(7, 4, layers=1, **SIZES), inputs()
    action = (5 * torch.ones_like(action)).requires_grad_()
    ensemble(state, belief, action).sum().backward()
    assert action.grad.abs().min() > 0


def test_one_member_cannot_disagree() -> None:
    with pytest.raises(ValueError, match="members must be at least 2 to disagree, got 1"):
        OneStepEnsemble(7, 4, members=1, layers=1, units=8)


def test_disagreement_by_hand() -> None:
    """Variances 1 and 9 of two features; a state on which all agree."""
    predictions = torch.tensor([[[0.0, 3.0], [1.0, 1.0]], [[1.0, 0.0], [1.0, 1.0]], [[2.0, 6.0], [1.0, 1.0]]])
    torch.testing.assert_close(disagreement(predictions), torch.tensor([[5.0], [0.0]]))
    log = disagreement(predictions, log=True)
    torch.testing.assert_close(log, torch.tensor([[2.0], [1e-6]]).log())


@pytest.mark.parametrize("log", [False, True])
def test_agreement_has_a_finite_gradient(log: bool) -> None:
    predictions = torch.ones(3, 2, 4, requires_grad=True)
    disagreement(predictions, log=log).sum().backward()
    assert predictions.grad.isfinite().all()


@pytest.mark.parametrize("log", [False, True])
def test_gradients_are_those_of_the_variance(log: bool) -> None:
    predictions = (3 + torch.randn(5, 6, 2, 4)).requires_grad_()
    variance = predictions.var(0)
    expected = variance.sqrt().mean(-1, keepdim=True).log() if log else variance.mean(-1, keepdim=True)
    got, weights = disagreement(predictions, log=log), torch.randn(6, 2, 1)
    torch.testing.assert_close(got, expected)
    gradients = [torch.autograd.grad((value * weights).sum(), predictions)[0] for value in (got, expected)]
    torch.testing.assert_close(*gradients)
