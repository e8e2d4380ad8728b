"""Debug agents on small images, and what there is to see of an update."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_ocwm.agents import AGENTS, SIZES, Agent, build_agent
from torchrl_ocwm.envs import Task
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import random_records, reacher_task
from torchrl_ocwm.training.settings import Training
from torchrl_ocwm.training.stepper import make_stepper

REACH = "behaviours.reach"
TASK = reacher_task(16)
PAIR = replace(TASK, objects=("finger", "thumb"))


def make(
    name: str = "dreamer_pcp", changes: Mapping[str, Any] = {}, size: Mapping[str, Any] = {}, task: Task = TASK
) -> Agent:
    torch.manual_seed(0)
    agent = build_agent(change(AGENTS[name], changes), task, change(SIZES["debug"], size))
    with torch.no_grad():
        for parameter in agent.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return agent


def losses(agent: Agent) -> TensorDictBase:
    torch.manual_seed(1)
    return agent.loss(random_records(agent.task, 2, 5))


def loss(name: str, row: str, changes: Mapping[str, Any] = {}, size: Mapping[str, Any] = {}) -> Tensor:
    return losses(make(row, changes, size))[name].detach()


def changes_of(agent: Agent, groups: Mapping[str, list[nn.Parameter]], updates: int = 1) -> dict[str, float]:
    """Largest change of any parameter of each group by an update."""
    before = copy.deepcopy(dict(groups))
    stepper = make_stepper(agent, Training())
    for _ in range(updates):
        torch.manual_seed(1)
        stepper.step(None, random_records(agent.task, 2, 5))
    return {
        name: max(float((new - old).detach().abs().max()) for new, old in zip(groups[name], before[name], strict=True))
        for name in groups
    }


def groups(agent: Agent) -> dict[str, list[nn.Parameter]]:
    names = ("model_lr", "actor_lr", "value_lr")
    return {name: list(group["params"]) for name, group in zip(names, agent.parameter_groups(), strict=True)}


def imagined(agent: Agent) -> TensorDictBase:
    """The rollout on which the critic is trained."""
    seen: list[TensorDictBase] = []
    agent.behaviour().loss.value_loss.register_forward_pre_hook(lambda module, arguments: seen.append(arguments[0]))
    losses(agent)
    return seen[0]
