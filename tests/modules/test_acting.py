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
    step = make_agent().policy()(observation(random_records(reacher_task(), 2, 1), 0))
    torch.testing.assert_close(step["latent", "action"], step["action"])
    assert step["action"].abs().max() <= 1


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
