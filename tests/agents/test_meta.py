"""Everything on the training and acting path runs without data: no stray CPU tensor, no shape that depends on values.

A tensor on the ``meta`` device has no values, so that ``.item()``, a mask as an index, and an operation together with a
tensor of the CPU raise. It stands for a GPU where there is none.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.agents import AGENTS, EXPLORERS, Agent, AgentConfig, build_agent
from torchrl_ocwm.data import RelabelGoals
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import random_records, reacher_task

TASK = reacher_task()
BESIDE = {f"focus_pcp with {name}": {"behaviours.explore": explorer} for name, explorer in EXPLORERS.items()}
SOURCES = {
    f"focus_lcp with goals from {name}": {"behaviours.reach.goals": name} for name in ("frames", "mixed", "future")
}
MOVING = {"behaviours.reach.goal.final_weight": 1, "behaviours.reach.reward.centred": True}
ROWS = {**{name: {} for name in AGENTS}, **BESIDE, **SOURCES, "focus_lcp with what moves": MOVING}


@pytest.fixture(params=ROWS)
def agent(request: pytest.FixtureRequest) -> Agent:
    config: AgentConfig = change(AGENTS[request.param.partition(" ")[0]], ROWS[request.param])
    with torch.device("meta"):
        return build_agent(config, TASK, size="debug")


def records() -> TensorDict:
    return random_records(TASK, 2, 6).to("meta")


def devices(tensors: Any) -> set[str]:
    return {tensor.device.type for tensor in tensors}


def test_update(agent: Agent) -> None:
    batch = records()  # has values first, which are not for the device below
    with torch.device("meta"):
        losses = agent.loss(batch)
        sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
    parameters = list(agent.parameters())
    assert devices(parameters) == {"meta"}
    assert devices(parameter.grad for parameter in parameters) == {"meta"}
    assert devices(agent.buffers()) == {"meta"}
    assert devices(losses.values()) == {"meta"}


def test_acting(agent: Agent) -> None:
    seen = records()["next"][:, 0]
    with torch.device("meta"):
        for name in agent.behaviours:
            policy = agent.policy(name)
            step = TensorDict({**seen, "is_init": torch.ones(2, 1, dtype=torch.bool)}, [2])
            if not policy.takes_positions:
                step["goal"] = {"pixels": seen["pixels"]}
            first = policy(step)
            assert first["action"].device.type == "meta"
            assert first["action"].shape == (2, TASK.action)
            assert policy(first)["action"].device.type == "meta"  # with the latent of the step before


def test_imagination(agent: Agent) -> None:
    with torch.device("meta"):
        for name in agent.behaviours:
            behaviour = agent.behaviour(name)
            imagined = behaviour.imagination.rollout(3, behaviour.actor, break_when_any_done=False)
            assert devices(imagined.values(True, True)) == {"meta"}


def test_what_the_sampler_does_to_a_batch() -> None:
    batch = records()
    with torch.device("meta"):
        batch = RelabelGoals(TASK.workspace)(batch)
    assert devices(batch.values(True, True)) == {"meta"}


@pytest.mark.parametrize("name", AGENTS)
def test_the_critic_that_actors_ask_moves_with_the_agent(name: str) -> None:
    """To another dtype here, as to a GPU elsewhere: TorchRL's losses do not register it."""
    for behaviour in build_agent(name, TASK, size="debug").double().loss.behaviours.values():
        critic = behaviour.actor_loss.value_model
        assert {tensor.dtype for tensor in (*critic.parameters(), *critic.buffers())} == {torch.float64}
