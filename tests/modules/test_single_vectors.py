"""Parts that say ``[..., C]`` take one vector, without a batch, as they take many."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_ocwm.modules import Architecture, FrameGoals, MovingCentre, ObjectDecoder
from torchrl_ocwm.modules.networks import make_image_decoder, make_mlp
from torchrl_ocwm.modules.rms_norm import RMSNorm

SMALL = Architecture(cnn_depth=4, cnn_mults=(1, 2))


def rms_norm() -> nn.Module:
    return RMSNorm(nn.Parameter(torch.rand(8)))


def mlp() -> nn.Module:
    return make_mlp("dreamer_v3", 8, 3, layers=2, units=16)


def image_decoder() -> nn.Module:
    return make_image_decoder(SMALL, 8, (14, 16))


def object_colours() -> nn.Module:
    """Of one instance, with a batch or without."""
    return nn.Sequential(nn.Unflatten(-1, (1, 8)), ObjectDecoder(8, 16, SMALL), _First())


def centre() -> nn.Module:
    return MovingCentre(8)


class _First(nn.Module):
    def forward(self, parts: tuple[Tensor, ...]) -> Tensor:
        return parts[0]


@pytest.mark.parametrize("make", [rms_norm, mlp, image_decoder, object_colours, centre])
def test_one_is_a_batch_of_one(make: Callable[[], nn.Module]) -> None:
    """What comes out, and the gradients of all parameters and of the vector."""
    found = []
    for batch in ((), (1,), (1, 1)):
        torch.manual_seed(0)
        part, vector = make().train(), torch.randn(8).requires_grad_()
        out = part(vector.expand(*batch, 8))
        assert out.shape[: len(batch)] == batch
        (out.square().sum() + out.sum()).backward()
        gradients = [one.grad for one in part.parameters()]
        found.append([out.reshape(out.shape[len(batch) :]), vector.grad, *gradients])
    for other in found[1:]:
        torch.testing.assert_close(other, found[0])


def test_goals_of_one_element() -> None:
    goals = TensorDictModule(lambda position: 2 * position, ["position"], [("latent", "goal")])
    shuffled = FrameGoals(goals, object_visible=None)(TensorDict({"position": torch.ones(3)}))
    assert shuffled["latent", "goal"].tolist() == [2.0, 2.0, 2.0]
