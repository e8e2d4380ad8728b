"""What an agent has learnt, under names that last."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torchrl.checkpoint import CheckpointError

from torchrl_ocwm import load_agent, save_agent
from torchrl_ocwm.agents import AGENTS, EXPLORERS, Agent, AgentWeights, build_agent, shipped_agents
from torchrl_ocwm.agents.archive import Archive
from torchrl_ocwm.agents.checkpoint import describe
from torchrl_ocwm.agents.config import EXPLORE, AgentConfig
from torchrl_ocwm.testing import reacher_task


def shaken(config: str | AgentConfig) -> Agent:
    """An agent in which no two numbers are alike by chance."""
    agent = build_agent(config, reacher_task(), "debug")
    with torch.no_grad():
        for value in AgentWeights(agent).state_dict().values():
            value.copy_(torch.rand(value.shape).mul(100) if value.is_floating_point() else torch.full_like(value, 7))
    return agent


ROWS: dict[str, str | AgentConfig] = {
    **{name: name for name in AGENTS},
    **{
        f"focus_lcp and {name}": AgentConfig(
            AGENTS["focus_lcp"].world_model, {**AGENTS["focus_lcp"].behaviours, EXPLORE: explorer}
        )
        for name, explorer in EXPLORERS.items()
    },
}


@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_all_that_an_agent_has_learnt_is_kept(row: str | AgentConfig, tmp_path: Path) -> None:
    agent = shaken(row)
    loaded = load_agent(save_agent(agent, tmp_path / "agent.zip")).agent
    there, here = agent.loss.state_dict(), loaded.loss.state_dict()
    assert there.keys() == here.keys()
    for name, value in there.items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(here[name], value, rtol=0, atol=0, msg=name)


def test_a_loaded_agent_can_be_saved_again(tmp_path: Path) -> None:
    first = load_agent(save_agent(shaken("lexa_temporal"), tmp_path / "first.zip")).agent
    second = load_agent(save_agent(first, tmp_path / "second.zip")).agent
    for name, value in AgentWeights(first).state_dict().items():
        torch.testing.assert_close(AgentWeights(second).state_dict()[name], value, rtol=0, atol=0, msg=name)


@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_each_parameter_is_kept_once(row: str | AgentConfig) -> None:
    agent = build_agent(row, reacher_task(), "debug")
    kept = [value for value in AgentWeights(agent).state_dict().values() if value.numel()]
    assert len({value.data_ptr() for value in kept}) == len(kept)
    assert {one.data_ptr() for one in agent.loss.parameters()} <= {value.data_ptr() for value in kept}


def test_names_say_what_part_a_tensor_plays() -> None:
    names = AgentWeights(build_agent("focus_lcp", reacher_task(), "debug")).state_dict()
    assert "model.positional_encoder.mlp.model.0.weight" in names
    assert "reach.actor.mlp.model.0.weight" in names
    assert "reach.critic.model.0.weight" in names
    assert not [name for name in names if "module" in name]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda kept: kept.pop("model.units.low"), r"missing weights 'model\.units\.low' \(1 in all\)"),
        (lambda kept: kept.update(moon=torch.zeros(1)), r"unknown weights 'moon' \(1 in all\)"),
        (
            lambda kept: kept.update({"model.units.low": torch.zeros(3)}),
            r"weights 'model\.units\.low' have shape \(3,\), not \(2,\)",
        ),
    ],
)
def test_weights_that_do_not_fit(change, message, tmp_path: Path) -> None:
    agent = build_agent("dreamer_pcp", reacher_task(), "debug")

    class Changed(AgentWeights):
        def state_dict(self) -> dict[str, torch.Tensor]:
            kept = super().state_dict()
            change(kept)
            return kept

    file = Archive(agent=describe(agent), weights=Changed(agent)).save(tmp_path / "agent.zip")
    with pytest.raises(CheckpointError, match=message):
        load_agent(file)


@pytest.mark.parametrize("name", shipped_agents())
def test_agents_that_come_with_the_package_can_be_loaded(name: str) -> None:
    policy = load_agent(name)
    assert policy.agent.task.name == name.partition("/")[0]
    assert all(value.isfinite().all() for value in policy.parameters())
