from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs
from torchrl.modules import RSSMRolloutV3

from torchrl_ocwm.agents import SIZES, Agent, build_agent
from torchrl_ocwm.modules import ImaginationEnv
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import STYLES, random_records, reacher_task


@pytest.fixture
def agent(make_agent: Any) -> Agent:
    return make_agent("dreamer_pcp")


def test_specs(agent: Agent) -> None:
    check_env_specs(agent.imagination)


@pytest.mark.parametrize("name", ["dreamer", "dreamer_pcp", "plan2explore"])
def test_rollout_is_torchrls(make_agent: Any, name: str) -> None:
    """The short cut gives what EnvBase.rollout gives, number by number."""
    agent = make_agent(name).eval()  # a normalised reward counts its calls
    start = agent.imagination.reset().expand(4).clone()
    options = {"auto_reset": False, "tensordict": start, "break_when_any_done": False}
    torch.manual_seed(1)
    ours = agent.imagination.rollout(3, agent.actor, **options)
    torch.manual_seed(1)
    theirs = EnvBase.rollout(agent.imagination, 3, agent.actor, **options)
    for key in ours.keys(True, True):
        torch.testing.assert_close(ours[key], theirs[key], msg=str(key))
    assert ours.batch_size == theirs.batch_size == (4, 3)


FIXED = {"auto_reset": False, "break_when_any_done": False}


def times(keys: list[Any], out: str) -> TensorDictModule:
    """What is read first, times the mean of what is read second."""
    return TensorDictModule(lambda value, factor: value * factor.mean(-1, keepdim=True), keys, [out])


@pytest.mark.parametrize(
    ("in_reward", "in_policy"),
    [
        ("action", None),
        ("weight", None),
        ("loc", None),
        (None, "weight"),
        (("latent", "weight"), ("latent", "weight")),
        (("before", "goal"), None),
        (("before", "state"), "loc"),
    ],
)
def test_what_reward_and_policy_read_is_there(agent: Agent, in_reward: Any, in_policy: Any) -> None:
    """Beside the latent, and in it: the action, what the policy writes, and what was there at the start."""
    parts, model = agent.imagination.world_model, agent.model
    reward, policy = parts.get_reward_operator(), agent.actor
    if in_reward is not None:
        reward = TensorDictSequential(reward, times(["reward", in_reward], "reward"))
    if in_policy is not None:
        policy = TensorDictSequential(policy, times(["action", in_policy], "action"))
    sizes = {"state": model.state, "belief": model.belief, "action": 2, "goal": 2}
    env = ImaginationEnv(parts.get_transition_model_operator(), reward, **sizes)
    start = env.reset().expand(4).clone()
    start["weight"] = start["latent", "weight"] = torch.full((4, 1), 3.0)
    torch.manual_seed(1)
    ours = env.rollout(3, policy, tensordict=start.clone(), **FIXED)
    torch.manual_seed(1)
    theirs = EnvBase.rollout(env, 3, policy, tensordict=start.clone(), **FIXED)
    torch.testing.assert_close(ours["action"], theirs["action"])
    torch.testing.assert_close(ours["next", "reward"], theirs["next", "reward"])


def test_a_policy_that_does_not_say_what_it_reads(agent: Agent) -> None:
    """TorchRL's own rollout decides what it gets."""
    start = agent.imagination.reset().expand(4).clone()
    rollout = agent.imagination.rollout(3, lambda latent: latent["state"][..., :2], tensordict=start, **FIXED)
    torch.testing.assert_close(rollout["action"], rollout["latent", "state"][..., :2])


@pytest.mark.parametrize("name", ["dreamer_pcp", "plan2explore", "focus_explore"])
def test_the_short_cut_is_taken(make_agent: Any, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    agent = make_agent(name)
    monkeypatch.setattr(EnvBase, "rollout", None)
    start = agent.imagination.reset().expand(4).clone()
    assert agent.imagination.rollout(3, agent.actor, tensordict=start, **FIXED).shape == (4, 3)


@pytest.mark.parametrize("short", [True, False])
def test_a_reward_sees_the_step_that_it_judges(short: bool) -> None:
    """Before, action and after of each step: 0 + 1 = 1, 1 + 1 = 2, 2 + 1 = 3."""
    keys: list[Any] = [("latent", "state"), ("latent", "belief")]
    transition = TensorDictModule(lambda state, belief, action: (state + action, belief), [*keys, "action"], keys)
    seen: list[Any] = [("before", "state"), "action", ("latent", "state")]
    reward = TensorDictModule(lambda before, action, after: 100 * before + 10 * action + after, seen, ["reward"])
    policy = TensorDictModule(torch.ones_like, [("latent", "state")], ["action"])
    env = ImaginationEnv(transition, reward, state=1, belief=1, action=1)
    start = env.reset().expand(2).clone().apply(torch.zeros_like)
    rollout = env.rollout if short else partial(EnvBase.rollout, env)
    got = rollout(3, policy, tensordict=start, **FIXED)["next", "reward"]
    torch.testing.assert_close(got, torch.tensor([[11.0], [112.0], [213.0]]).expand(2, 3, 1))


def test_an_ordinary_rollout_works_too(agent: Agent) -> None:
    rollout = agent.imagination.rollout(3)
    assert rollout["next", "latent", "goal"].shape == (3, 2)


@pytest.mark.parametrize("style", ["dreamer_v3", "dreamer_v2"])
def test_actions_beyond_the_bounds_count_as_clipped(style: Any) -> None:
    agent = build_agent("dreamer_pcp", reacher_task(), change(SIZES["debug"], STYLES[style]))
    start = agent.imagination.reset().expand(4).clone()
    wild = start.clone().set("action", torch.tensor([[5.0, -3.0]]).expand(4, 2))
    clipped = start.clone().set("action", torch.tensor([[1.0, -1.0]]).expand(4, 2))
    torch.manual_seed(1)
    first = agent.model.transition()(wild)
    torch.manual_seed(1)
    second = agent.model.transition()(clipped)
    torch.testing.assert_close(first["latent", "belief"], second["latent", "belief"])
    torch.testing.assert_close(first["latent", "state"], second["latent", "state"])


@pytest.mark.parametrize("style", ["dreamer_v3", "dreamer_v2"])
def test_recorded_actions_count_as_imagined_ones(style: Any) -> None:
    """Beyond the bounds they are clipped, and double precision is no other action."""
    agent = build_agent("dreamer_pcp", reacher_task(), change(SIZES["debug"], STYLES[style]))
    records, after = random_records(reacher_task(), 2, 4), []
    for action in (4 * records["action"], (4 * records["action"]).clamp(-1, 1).double()):
        torch.manual_seed(1)
        after.append(agent.model.records()(records.clone().set("action", action))["next"])
    torch.testing.assert_close(after[0]["belief"], after[1]["belief"])
    assert (4 * records["action"]).abs().max() > 1


@pytest.mark.parametrize("name", ["dreamer_pcp", "focus_lcp"])
def test_sequences_take_torchrls_fast_path(make_agent: Any, name: str) -> None:
    rollouts = [module for module in make_agent(name).loss.modules() if isinstance(module, RSSMRolloutV3)]
    assert [rollout._fast_path for rollout in rollouts] == [True]
