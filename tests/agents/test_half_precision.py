"""Agents with weights of half the size."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_ocwm.agents import AGENTS, build_agent
from torchrl_ocwm.testing import random_records, reacher_task


def observation(seed: int) -> TensorDictBase:
    seen = random_records(reacher_task(), 2, 1, seed=seed)[:, 0]["next"]
    return seen.set("is_init", torch.full((2, 1), seed == 0))


@pytest.mark.parametrize("row", AGENTS)
def test_policies_act_in_half_precision(row: str) -> None:
    """As in full precision up to rounding, with the actions that an environment takes."""
    torch.manual_seed(2)
    agent = build_agent(row, reacher_task(), "debug")
    with torch.no_grad():
        for weight in agent.actor.parameters():
            weight.copy_(torch.randn(weight.shape, generator=torch.Generator().manual_seed(1)))
    actions = []
    for convert in (agent.float, agent.bfloat16):
        policy = convert().policy()
        torch.manual_seed(0)
        first, second = observation(0), observation(1)
        if not policy.takes_positions:
            images = first["pixels"].unsqueeze(1)
            for one in (first, second):
                one["goal"] = TensorDict({"pixels": images}, [2])
        with torch.no_grad():
            second["latent"] = policy(first)["latent"]
            actions.append(policy(second)["action"])
    full, half = actions
    assert half.dtype == torch.float32
    assert next(agent.parameters()).dtype == torch.bfloat16
    assert not torch.equal(full, half)
    assert full.abs().max() > 0.3
    torch.testing.assert_close(half, full, atol=0.1, rtol=0)
