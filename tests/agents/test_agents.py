from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from torchrl_ocwm.agents import AGENTS, SIZES, AgentConfig, agent_name, build_agent
from torchrl_ocwm.testing import random_records, reacher_task

PCP = AGENTS["dreamer_pcp"]


@pytest.mark.parametrize("name", AGENTS)
def test_every_row_learns_and_acts(name: str) -> None:
    task = reacher_task()
    agent = build_agent(name, task, "debug")
    records = random_records(task, 2, 3)
    losses = agent.loss(records)
    assert all(value.isfinite() for key, value in losses.items() if key.startswith("loss_"))
    step = records["next"][:, 0].exclude("reward", "done", "terminated").set("is_init", records["is_init"][:, 0])
    assert agent.policy()(step)["action"].shape == (2, task.action)


def test_who_sees_the_goal() -> None:
    """Dreamer's world model, PCP's actor and critic."""
    dreamer, pcp = (build_agent(name, reacher_task(), "debug") for name in ("dreamer", "dreamer_pcp"))
    goal = ("next", "goal_position")
    assert goal in dreamer.model.records().in_keys
    assert goal not in pcp.model.records().in_keys
    assert ("latent", "goal") not in dreamer.actor.in_keys
    assert ("latent", "goal") in pcp.actor.in_keys
    assert ("latent", "goal") in pcp.loss.actor_loss.value_model.in_keys
    assert dreamer.model.reward_head is not None
    assert pcp.model.reward_head is None


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (replace(PCP, goal_source="environment"), "does not go with goal_source"),
        (replace(PCP, goal="none"), "does not go with goal_source"),
        (replace(PCP, reward="head"), "reward='head' does not go with goal='position'"),
        (AgentConfig(reward="position_distance"), "reward='position_distance' does not go with goal='none'"),
        (replace(PCP, observed=("proprio",)), "does not decode object positions"),
        (replace(PCP, goal="object_latent"), "need world_model='object'"),
        (replace(AGENTS["focus_lcp"], observed=("proprio",)), "'object_position' in `observed`"),
    ],
)
def test_choices_that_do_not_fit(config: AgentConfig, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build_agent(config, reacher_task(), "debug")


def test_unknown_names_list_the_valid_ones() -> None:
    with pytest.raises(ValueError, match="unknown agent 'muzero'; there are dreamer, dreamer_pcp, focus"):
        build_agent("muzero", reacher_task())
    with pytest.raises(ValueError, match="unknown size 'huge'; there are debug, cpu, small, paper, large"):
        build_agent("dreamer", reacher_task(), "huge")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"style": "resnet"}, "style must be one of 'dreamer_v3', 'dreamer_v2', got 'resnet'"),
        ({"batch_size": 0}, "batch_size must be at least 1"),
        ({"belief": 15}, "belief must be a multiple of gru_blocks, got 15 and 2"),
    ],
)
def test_bad_sizes(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(SIZES["debug"], **changes)


def test_zero_entropy_bonus_is_a_value() -> None:
    agent = build_agent(PCP, reacher_task(), replace(SIZES["debug"], entropy_bonus=0))
    assert torch.isfinite(agent.loss(random_records(reacher_task(), 2, 3))["loss_actor"])


def test_several_objects_and_a_workspace_in_space() -> None:
    """Nothing is made for one object in a plane."""
    from torchrl_ocwm.envs.task import Task
    from torchrl_ocwm.envs.workspace import Workspace

    task = Task("x", 32, ("a", "b", "c"), 4, 3, Workspace(low=(-1.0, 0.0, 0.0), high=(1.0, 0.5, 0.3)))
    agent = build_agent("dreamer_pcp", task, replace(SIZES["debug"], cnn_mults=(1, 2)))
    losses = agent.loss(random_records(task, 2, 3))
    assert losses["loss_model_object_position"].isfinite()


def test_agent_name() -> None:
    assert agent_name(PCP) == "dreamer_pcp"
    assert agent_name(replace(PCP, lambda_proprio=2.0)) == "dreamer_pcp (lambda_proprio=2.0)"
