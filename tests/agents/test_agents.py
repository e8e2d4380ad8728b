"""Agents as a world model and behaviours: which part gets what."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.agents import (
    AGENTS,
    SIZES,
    AgentConfig,
    Behaviour,
    Flat,
    PositionDistance,
    agent_name,
    build_agent,
)
from torchrl_ocwm.settings import SettingsError, change
from torchrl_ocwm.testing import random_records, reacher_task

PCP, LCP = AGENTS["dreamer_pcp"], AGENTS["focus_lcp"]
REACH = "behaviours.reach"


@pytest.mark.parametrize("name", AGENTS)
def test_every_row_learns_and_acts(name: str) -> None:
    task = reacher_task()
    agent = build_agent(name, task, "debug")
    records = random_records(task, 2, 3)
    losses = agent.loss(records)
    assert all(value.isfinite() for key, value in losses.items() if key.startswith("loss_"))
    step = records["next"][:, 0].exclude("reward", "done", "terminated").set("is_init", records["is_init"][:, 0])
    policy = agent.policy()
    if not policy.takes_positions:
        with pytest.raises(ValueError, match="takes goals as images only"):
            policy(step.clone())
        step["goal"] = TensorDict({"pixels": step["pixels"]}, [2])
    assert policy(step)["action"].shape == (2, task.action)


def test_a_fresh_critic_expects_nothing() -> None:
    critic = build_agent("dreamer_pcp", reacher_task(), "debug").behaviour().loss.actor_loss.value_model
    latent = {"state": torch.rand(5, 16), "belief": torch.randn(5, 16), "goal": torch.randn(5, 2)}
    assert critic(TensorDict({"latent": TensorDict(latent, [5])}, [5]))["state_value"].abs().max() == 0


def test_who_sees_the_goal() -> None:
    """Dreamer's world model, PCP's actor and critic."""
    dreamer, pcp = (build_agent(name, reacher_task(), "debug") for name in ("dreamer", "dreamer_pcp"))
    goal = ("next", "goal_position")
    assert goal in dreamer.model.records().in_keys
    assert goal not in pcp.model.records().in_keys
    assert ("latent", "goal") not in dreamer.actor.in_keys
    assert ("latent", "goal") in pcp.actor.in_keys
    assert ("latent", "goal") in pcp.behaviour().loss.actor_loss.value_model.in_keys
    assert dreamer.model.reward_head is not None
    assert pcp.model.reward_head is None


@pytest.mark.parametrize(
    ("config", "changes", "message"),
    [
        (PCP, {f"{REACH}.goals": "environment"}, "goal='position' does not go with goals='environment'"),
        (PCP, {f"{REACH}.goal": "none"}, "goal='none' does not go with goals='uniform'"),
        (PCP, {f"{REACH}.reward": "head"}, "reward='head' does not go with goal='position'"),
        (AgentConfig(Flat(), {"reach": Behaviour(reward=PositionDistance())}), {}, "does not go with goal='none'"),
        (PCP, {"world_model.observed": ["proprio"], "world_model.lambda_object_position": 200}, "not decode object"),
        (PCP, {f"{REACH}.goal": "object_latent"}, "world_model='flat' has no positional_encoder"),
        (LCP, {"world_model.observed": ["proprio"]}, "'object_position' in `observed`"),
        (LCP, {f"{REACH}.reward": {"name": "latent_similarity", "distance": "mse"}}, "compares lengths"),
        (PCP, {f"{REACH}.object": "cube"}, "object='cube' is not in 'reacher', which has finger"),
    ],
)
def test_choices_that_do_not_fit(config: AgentConfig, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build_agent(change(config, changes), reacher_task(), "debug")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"world_model.lambda_goal_position": 9.0}, "world_model.lambda_goal_position does nothing"),
        ({"world_model.lambda_pixels": 9.0}, "world_model.lambda_pixels is no setting"),
        ({f"{REACH}.reward.distance": "mse"}, "behaviours.reach.reward.distance is no setting"),
        (
            {f"{REACH}.goal": "latent"},
            "must be one of none, position, object_latent.*got 'latent'",
        ),
        ({f"{REACH}.goal": 3}, "behaviours.reach.goal must be the name of a goal"),
        ({"behaviours": {}}, "behaviours must have at least one"),
        ({"behaviours": {"a b": {}}}, "names like 'reach', got 'a b'"),
        ({"world_model.lambda_proprio": None}, "world_model.lambda_proprio must be a number, got None"),
        ({"world_model.lambda_proprio": -1.0}, "world_model.lambda_proprio must be at least 0, got -1.0"),
    ],
)
def test_settings_that_mean_nothing_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        change(PCP, changes)


def test_unknown_names_list_the_valid_ones() -> None:
    with pytest.raises(ValueError, match="unknown agent 'muzero'; there are dreamer, dreamer_pcp, focus"):
        build_agent("muzero", reacher_task())
    with pytest.raises(ValueError, match="unknown size 'huge'; there are debug, cpu, small, paper, large"):
        build_agent("dreamer", reacher_task(), "huge")
    with pytest.raises(ValueError, match="unknown behaviour 'explore'; this agent has reach"):
        build_agent("dreamer", reacher_task(), "debug").policy("explore")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"architecture.style": "resnet"}, "style must be one of 'dreamer_v3', 'dreamer_v2', got 'resnet'"),
        ({"architecture.style": "dreamer_v2"}, "architecture.cnn_mults does nothing in style='dreamer_v2'"),
        ({"architecture.cnn_mults": []}, "architecture.cnn_mults must have a multiplier"),
        ({"architecture.belief": 15}, "architecture.belief must be a multiple of gru_blocks, got 15 and 2"),
        ({"learning.batch_size": 0}, "learning.batch_size must be at least 1"),
        ({"learning.optimizer.warmup": -1}, "learning.optimizer.warmup must be at least 0"),
        ({"learning.optimizer": {"name": "adam", "warmup": 5}}, "learning.optimizer.warmup is no setting"),
    ],
)
def test_bad_sizes(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        change(SIZES["debug"], changes)


def test_zero_entropy_bonus_is_a_value() -> None:
    agent = build_agent(PCP, reacher_task(), change(SIZES["debug"], {"learning.entropy_bonus": 0}))
    assert torch.isfinite(agent.loss(random_records(reacher_task(), 2, 3))["loss_actor"])


def test_several_objects_and_a_workspace_in_space() -> None:
    """Nothing is made for one object in a plane."""
    from torchrl_ocwm.envs.task import Task
    from torchrl_ocwm.envs.workspace import Workspace

    task = Task("x", 32, ("a", "b", "c"), 4, 3, Workspace(low=(-1.0, 0.0, 0.0), high=(1.0, 0.5, 0.3)))
    agent = build_agent("dreamer_pcp", task, change(SIZES["debug"], {"architecture.cnn_mults": (1, 2)}))
    losses = agent.loss(random_records(task, 2, 3))
    assert losses["loss_model_object_position"].isfinite()


def test_agent_name() -> None:
    assert agent_name(PCP) == "dreamer_pcp"
    assert agent_name(change(PCP, {"world_model.lambda_proprio": 2})) == "dreamer_pcp (world_model.lambda_proprio=2.0)"


class TestBehaviours:
    """Two behaviours of one agent: one world model, everything else apart."""

    def agent(self) -> Any:
        torch.manual_seed(0)
        row = replace(LCP, behaviours={**LCP.behaviours, "other": PCP.behaviours["reach"]})
        return build_agent(row, reacher_task(), "debug")

    def test_each_has_losses_of_its_own(self) -> None:
        agent = self.agent()
        losses = agent.loss(random_records(reacher_task(), 2, 5))
        assert {"loss_actor", "loss_value", "loss_other_actor", "loss_other_value"} <= set(losses.keys())
        losses["loss_other_actor"].backward()
        trained = {
            name for name, one in agent.behaviours.items() if any(p.grad is not None for p in one.actor.parameters())
        }
        assert trained == {"other"}

    def test_each_acts_by_its_own_policy(self) -> None:
        agent, records = self.agent(), random_records(reacher_task(), 2, 1)
        step = records["next"][:, 0].exclude("reward", "done", "terminated").set("is_init", records["is_init"][:, 0])
        reach, other = agent.policy()(step.clone()), agent.policy("other")(step.clone())
        assert reach["latent", "goal"].shape == (2, 16)
        assert other["latent", "goal"].shape == (2, 2)
        assert agent.policy("reach").takes_images
        assert not agent.policy("other").takes_images

    def test_the_world_model_is_trained_once(self, monkeypatch: pytest.MonkeyPatch) -> None:
        agent, calls = self.agent(), []
        agent.loss.model_loss.register_forward_hook(lambda *_: calls.append(1))
        agent.loss(random_records(reacher_task(), 2, 5))
        assert len(calls) == 1
        groups = agent.parameter_groups()
        assert len(groups) == 5
        owned = [id(parameter) for group in groups for parameter in group["params"]]
        assert len(owned) == len(set(owned))
        assert set(owned) == {id(parameter) for parameter in agent.parameters() if parameter.requires_grad}
