"""The rows compute what they computed in release 0.1, but for goal latents, which have had one length since.

Losses of three updates in float64, as commit caf7a5f gives them, which wrote down those of 0.1 in float32.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.testing import random_records, reacher_task
from torchrl_ocwm.training.settings import Training
from torchrl_ocwm.training.stepper import make_stepper

GOLDEN = json.loads((Path(__file__).parent / "golden.json").read_text())


@pytest.mark.parametrize("name", GOLDEN)
@pytest.mark.usefixtures("float64")
def test_losses_are_those_of_before(name: str) -> None:
    torch.manual_seed(3)
    agent = build_agent(name, reacher_task(), "debug")
    stepper = make_stepper(agent, Training())
    for update, expected in enumerate(GOLDEN[name]):
        torch.manual_seed(10 + update)
        losses = stepper.step(None, random_records(reacher_task(), 2, 8, seed=update))
        got = {key: float(value) for key, value in losses.items() if key.startswith("loss_")}
        # Another processor adds up in another order, and the optimiser makes steps of what is nothing but rounding.
        assert got == pytest.approx(expected, rel=1e-4, abs=1e-6)
