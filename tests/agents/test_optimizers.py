"""Optimisers by name."""

import pytest
import torch
from torchrl.trainers.algorithms import DreamerV3Optimizer

from torchrl_ocwm.agents import SIZES, Adam, DreamerV3, build_agent
from torchrl_ocwm.agents.optimizers import ClippedAdam
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import random_records, reacher_task
from torchrl_ocwm.training.settings import Training
from torchrl_ocwm.training.stepper import make_stepper


@pytest.mark.parametrize(("name", "kind"), [("dreamer_v3", DreamerV3Optimizer), ("adam", ClippedAdam)])
def test_each_group_has_its_learning_rate(name: str, kind: type) -> None:
    rates = {"learning.model_lr": 1.0, "learning.actor_lr": 2.0, "learning.value_lr": 3.0}
    agent = build_agent("focus_lcp", reacher_task(), change(SIZES["debug"], {"learning.optimizer": name, **rates}))
    optimizer = agent.size.learning.optimizer.build(agent.parameter_groups())
    assert type(optimizer) is kind
    model, actor, critic = optimizer.param_groups
    assert [group["lr"] for group in (model, actor, critic)] == [1.0, 2.0, 3.0]
    assert {id(p) for p in model["params"]} == {id(p) for p in agent.model.parameters()}
    assert {id(p) for p in actor["params"]} == {id(p) for p in agent.actor.parameters()}


def test_settings_reach_the_optimizers() -> None:
    groups = [{"params": [torch.nn.Parameter(torch.ones(2))], "lr": 0.5}]
    adam = Adam(max_norm=7.0, eps=0.25, decay=0.1).build(groups)
    assert (adam.max_norm, adam.defaults["eps"], adam.param_groups[0]["weight_decay"]) == (7.0, 0.25, 0.2)
    assert DreamerV3(warmup=9).build(groups).defaults["warmup_steps"] == 9


def test_a_learning_rate_of_zero_trains_nothing() -> None:
    size = change(SIZES["debug"], {"learning.optimizer": "adam", "learning.model_lr": 0})
    agent = build_agent("dreamer_pcp", reacher_task(), size)
    before = [parameter.detach().clone() for parameter in agent.model.parameters()]
    actor = [parameter.detach().clone() for parameter in agent.actor.parameters()]
    make_stepper(agent, Training()).step(None, random_records(agent.task, 2, 8))
    assert all(torch.equal(p, old) for p, old in zip(agent.model.parameters(), before, strict=True))
    assert not all(torch.equal(p, old) for p, old in zip(agent.actor.parameters(), actor, strict=True))


def test_clipped_adam_step_by_step() -> None:
    """Against Adam written out: norm of each group clipped, moments, decay by a share of the weight."""
    torch.manual_seed(0)
    weights = [[torch.randn(3), torch.randn(2, 2)], [torch.randn(4)]]
    rates, max_norm, eps, decay = (0.1, 0.01), 2.0, 1e-5, 1e-3
    parameters = [[torch.nn.Parameter(weight.clone()) for weight in group] for group in weights]
    groups = [{"params": group, "lr": rate} for group, rate in zip(parameters, rates, strict=True)]
    optimizer = ClippedAdam(groups, max_norm=max_norm, eps=eps, decay=decay)
    moments = [[[torch.zeros_like(weight) for weight in group] for group in weights] for _ in range(2)]
    for step in range(1, 4):
        scale = (0.1, 10.0, 1.0)[step - 1]  # the second is clipped
        gradients = [[scale * torch.randn_like(weight) for weight in group] for group in weights]
        for group, given in zip(parameters, gradients, strict=True):
            for parameter, gradient in zip(group, given, strict=True):
                parameter.grad = gradient.clone()
        optimizer.step()
        for number, (group, given) in enumerate(zip(weights, gradients, strict=True)):
            norm = torch.cat([gradient.flatten() for gradient in given]).norm()
            for place, gradient in enumerate(given):
                gradient = gradient * min(1.0, float(max_norm / norm))
                first = moments[0][number][place] = 0.9 * moments[0][number][place] + 0.1 * gradient
                second = moments[1][number][place] = 0.999 * moments[1][number][place] + 0.001 * gradient**2
                move = first / (1 - 0.9**step) / ((second / (1 - 0.999**step)).sqrt() + eps)
                group[place] = (1 - decay) * group[place] - rates[number] * move
    for group, expected in zip(parameters, weights, strict=True):
        for parameter, weight in zip(group, expected, strict=True):
            torch.testing.assert_close(parameter.detach(), weight, rtol=1e-4, atol=1e-5)


def test_an_update_with_adam_moves_all_three() -> None:
    agent = build_agent("focus_pcp", reacher_task(), change(SIZES["debug"], {"learning.optimizer": "adam"}))
    parts = {"model": agent.model, "actor": agent.actor, "critic": agent.behaviour().loss.value_loss.value_model_params}
    before = {name: [p.detach().clone() for p in part.parameters()] for name, part in parts.items()}
    make_stepper(agent, Training()).step(None, random_records(agent.task, 2, 8))
    for name, part in parts.items():
        assert any(not torch.equal(p, old) for p, old in zip(part.parameters(), before[name], strict=True)), name
