"""What makes updates fast does not change what is learnt."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import rms_norm, silu
from torchrl.modules import RSSMRolloutV3

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.modules import ImaginationEnv, networks, objects
from torchrl_ocwm.modules.recurrence import Rollout
from torchrl_ocwm.modules.rms_norm import ChannelRMSNormSiLU, RMSNorm
from torchrl_ocwm.testing import random_records, reacher_task
from torchrl_ocwm.training.settings import Training
from torchrl_ocwm.training.stepper import make_stepper

UPDATES = 20


def make_plain(patch: pytest.MonkeyPatch) -> None:
    """PyTorch's norms and transposed convolutions, TorchRL's rollouts, all objects decoded at once."""

    def upsample(image: Tensor, layer: nn.ConvTranspose2d, shift: float) -> Tensor:
        return layer(image) + shift

    def norm(self: RMSNorm, value: Tensor) -> Tensor:
        return rms_norm(value, value.shape[-1:], self.weight, float(self.eps))

    def channels(self: ChannelRMSNormSiLU, value: Tensor) -> Tensor:
        return silu(norm(self, value.movedim(-3, -1)).movedim(-1, -3))

    patch.setattr(networks, "upsample", upsample)
    patch.setattr(RMSNorm, "forward", norm)
    patch.setattr(ChannelRMSNormSiLU, "forward", channels)
    patch.setattr(Rollout, "_loop", RSSMRolloutV3._loop)
    patch.setattr(ImaginationEnv, "_reads_what_is_carried", lambda *_: False)
    patch.setattr(objects, "_AT_ONCE", 10**9)


def learn(name: str) -> Tensor:
    """All losses of some updates."""
    torch.manual_seed(0)
    agent, losses = build_agent(name, reacher_task(), "debug"), []
    stepper = make_stepper(agent, Training())
    if name == "focus_lcp":
        # The softmax over the instances' mask logits does not see the bias that they share. Its gradient is nothing but
        # rounding, of which the optimiser would make whole steps.
        seen = torch.tensor([1.0, 1.0, 1.0, 0.0])
        agent.model.object_decoder.cnn.layers[-1].bias.register_hook(seen.mul)
    for update in range(UPDATES):
        step = stepper.step(None, random_records(agent.task, 4, 8, seed=update))
        losses.append(torch.stack([value.double() for key, value in sorted(step.items()) if key.startswith("loss_")]))
    return torch.stack(losses)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dreamer_pcp", "focus_lcp"])
@pytest.mark.usefixtures("float64")
def test_updates_are_those_of_the_plain_path(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    losses = learn(name)
    make_plain(monkeypatch)
    expected = learn(name)
    assert not expected[0].allclose(expected[-1], rtol=0.01)
    torch.testing.assert_close(losses, expected, rtol=1e-4, atol=1e-4)
