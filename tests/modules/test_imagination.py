from __future__ import annotations

from typing import Any

import pytest
import torch
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from torchrl_ocwm.agents import SIZES, Agent, build_agent
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import STYLES, reacher_task


@pytest.fixture
def agent(make_agent: Any) -> Agent:
    return make_agent("dreamer_pcp")


def test_specs(agent: Agent) -> None:
    check_env_specs(agent.imagination)


@pytest.mark.parametrize("name", ["dreamer", "dreamer_pcp"])
def test_rollout_is_torchrls(make_agent: Any, name: str) -> None:
    """The short cut gives what EnvBase.rollout gives, number by number."""
    agent = make_agent(name)
    start = agent.imagination.reset().expand(4).clone()
    options = {"auto_reset": False, "tensordict": start, "break_when_any_done": False}
    torch.manual_seed(1)
    ours = agent.imagination.rollout(3, agent.actor, **options)
    torch.manual_seed(1)
    theirs = EnvBase.rollout(agent.imagination, 3, agent.actor, **options)
    for key in ours.keys(True, True):
        torch.testing.assert_close(ours[key], theirs[key], msg=str(key))
    assert ours.batch_size == theirs.batch_size == (4, 3)


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
