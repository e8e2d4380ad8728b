from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_ocwm.agents import Agent
from torchrl_ocwm.testing import random_records, reacher_task


def observation(records: TensorDict, time: int) -> TensorDict:
    """What the policy sees at a frame of stored records."""
    return records["next"][:, time].exclude("reward", "done", "terminated").set("is_init", records["is_init"][:, time])


def filter_by_acting(agent: Agent, records: TensorDict) -> TensorDict:
    """Beliefs, states and posterior logits ``[B, T]`` of the policy, led through the stored actions."""
    logits: list[torch.Tensor] = []
    hook = agent.model.posterior.register_forward_hook(lambda module, inputs, outputs: logits.append(outputs[0]))
    policy, steps, latent = agent.policy(), [], None
    with torch.no_grad():
        for time in range(records.shape[1]):
            step = observation(records, time)
            if latent is not None:
                step["latent"] = latent
            latent = policy(step)["latent"].clone()
            steps.append(latent.select("belief", "state"))
            if time + 1 < records.shape[1]:
                latent["action"] = records["action"][:, time + 1]  # what was done in the stored episode
    hook.remove()
    return TensorDict.stack(steps, 1).set("posterior_logits", torch.stack(logits, 1))


@pytest.mark.usefixtures("no_noise")
@pytest.mark.parametrize("name", ["dreamer", "dreamer_pcp"])
@pytest.mark.parametrize("restart", [False, True])
def test_acting_filters_as_training_does(make_agent: Any, name: str, restart: bool) -> None:
    """Step by step or as a sequence: the same beliefs, states and posterior logits, from the first frame on."""
    agent = make_agent(name)
    records = random_records(reacher_task(), 3, 7)
    if restart:
        records["is_init"][1, 4] = True
    with torch.no_grad():
        trained = agent.model.records()(records.clone())["next"]
    acted = filter_by_acting(agent, records)
    for key in ("belief", "state", "posterior_logits"):
        torch.testing.assert_close(acted[key], trained[key], rtol=0, atol=1e-5)
    assert trained["posterior_logits"].std() > 0.01  # not the same for everything


def test_latent_restarts_with_the_episode(make_agent: Any) -> None:
    """What was carried over from the last episode has no influence on the first frame of the next."""
    agent = make_agent()
    records = random_records(reacher_task(), 2, 1)
    fresh, carried = observation(records, 0), observation(records, 0)
    model = agent.model
    carried["latent"] = TensorDict(
        {"state": torch.rand(2, model.state), "belief": torch.rand(2, model.belief), "action": torch.rand(2, 2)}, [2]
    )
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        torch.manual_seed(1)
        first = agent.policy()(fresh)
        torch.manual_seed(1)
        second = agent.policy()(carried)
    torch.testing.assert_close(first["latent", "belief"], second["latent", "belief"])
    torch.testing.assert_close(first["action"], second["action"])


def test_remembers_the_action_that_was_done(make_agent: Any) -> None:
    """Which is within the bounds, whatever was drawn."""
    with set_exploration_type(ExplorationType.RANDOM):
        step = make_agent().policy()(observation(random_records(reacher_task(), 50, 1), 0))
    torch.testing.assert_close(step["latent", "action"], step["action"])
    assert step["action"].abs().max() == 1
    assert step["action"].abs().min() < 1


def test_the_goal_changes_the_action(make_agent: Any) -> None:
    agent, records = make_agent(), random_records(reacher_task(), 2, 1)
    actions = []
    for x in (-0.2, 0.2):
        step = observation(records, 0).set("goal_position", torch.tensor([[x, 0.0]]).expand(2, 2))
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            torch.manual_seed(1)
            actions.append(agent.policy()(step)["action"])
    assert (actions[0] - actions[1]).abs().min() > 1e-4


def test_needs_to_know_where_episodes_start(make_agent: Any) -> None:
    step = observation(random_records(reacher_task(), 2, 1), 0).exclude("is_init")
    with pytest.raises(KeyError, match="InitTracker"):
        make_agent().policy()(step)


STEPS = 20


def inputs(agent: Agent, records: TensorDict, time: int, latent: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """What an exported policy is called with at a step: observations by name, and the latent of the step before."""
    seen = observation(records, time)
    return {**{key: seen[key] for key in agent.policy().in_keys if isinstance(key, str)}, **latent}


def zeros(agent: Agent, number: int) -> dict[str, torch.Tensor]:
    sizes = {"state": agent.model.state, "belief": agent.model.belief, "action": agent.model.action}
    return {f"latent_{name}": torch.zeros(number, size) for name, size in sizes.items()}


@pytest.mark.parametrize("name", ["dreamer", "focus_lcp"])
def test_an_exported_policy_acts_as_the_policy(make_agent: Any, name: str) -> None:
    """The latent goes in and comes out: without a memory it would act otherwise from the second step on."""
    agent = make_agent(name)
    policy, records = agent.policy().eval(), random_records(reacher_task(), 3, STEPS)
    names = ["_".join([key] if isinstance(key, str) else key) for key in policy.out_keys]
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        example = inputs(agent, records, 0, zeros(agent, 3))
        exported = torch.export.export(policy, args=(), kwargs=example, strict=False).module()
        carried, latent, beliefs = TensorDict({}, [3]), zeros(agent, 3), []
        for time in range(STEPS):
            torch.manual_seed(time)
            carried = policy(observation(records, time).update(carried.select("latent", strict=False)))
            torch.manual_seed(time)
            out = dict(zip(names, exported(**inputs(agent, records, time, latent)), strict=True))
            torch.testing.assert_close(out["action"], carried["action"], rtol=1e-4, atol=1e-5)
            latent = {key: out[key] for key in latent}
            beliefs.append(out["latent_belief"])
    assert (beliefs[0] - beliefs[-1]).abs().max() > 1e-3


def test_a_policy_is_not_exported_without_its_memory(make_agent: Any) -> None:
    agent = make_agent()
    policy, example = agent.policy().eval(), inputs(agent, random_records(reacher_task(), 1, 1), 0, {})
    with pytest.raises(ValueError, match="without its latent: latent_state, latent_belief, latent_action are"):
        torch.export.export(policy, args=(), kwargs=example, strict=False)
