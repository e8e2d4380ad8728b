"""Explorers: behaviours without a goal, alone or beside a task."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_ocwm import load_agent, save_agent
from torchrl_ocwm.agents import (
    AGENTS,
    EXPLORERS,
    SIZES,
    Agent,
    Behaviour,
    Disagreement,
    ObjectEntropy,
    agent_name,
    build_agent,
)
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.envs.workspace import Workspace
from torchrl_ocwm.modules import StreamingNorm, particle_entropy
from torchrl_ocwm.settings import SettingsError, change, from_dict, to_dict
from torchrl_ocwm.testing import random_records, reacher_task

LCP = AGENTS["focus_lcp"]
REWARD = "behaviours.explore.reward"


def beside(explorer: str, changes: Mapping[str, Any] = {}, task: Task | None = None) -> Agent:
    """FOCUS + LCP with an explorer."""
    torch.manual_seed(0)
    row = change(LCP.and_behaviours(explore=EXPLORERS[explorer]), changes)
    return build_agent(row, task or reacher_task(), "debug")


def imagine(agent: Agent, count: int = 6) -> TensorDict:
    """A rollout of the explorer."""
    learnt = agent.behaviour("explore")
    torch.manual_seed(1)
    latent = {"state": torch.rand(count, agent.model.state), "belief": torch.randn(count, agent.model.belief)}
    start = TensorDict({"latent": TensorDict(latent, [count])}, [count])
    return learnt.imagination.rollout(4, learnt.actor, auto_reset=False, tensordict=start, break_when_any_done=False)


def reward_part(agent: Agent, kind: type[nn.Module]) -> Any:
    return next(one for one in agent.behaviour("explore").imagination.modules() if isinstance(one, kind))


def trained(module: nn.Module) -> float:
    return sum(float(one.grad.abs().sum()) for one in module.parameters() if one.grad is not None)


@pytest.mark.parametrize("explorer", EXPLORERS)
def test_its_losses_have_its_name(explorer: str) -> None:
    agent = beside(explorer)
    losses = agent.loss(random_records(reacher_task(), 2, 5))
    own = {name for name in losses.keys() if "explore" in name and name.startswith("loss")}
    ensemble = {"loss_explore_ensemble"} if explorer == "plan2explore" else set()
    assert own == {"loss_explore_actor", "loss_explore_value"} | ensemble
    assert own < set(agent.loss.out_keys)
    assert "explore_return_high" in losses


@pytest.mark.parametrize("explorer", EXPLORERS)
def test_what_its_losses_train(explorer: str) -> None:
    """The actor through the dynamics; never the world model, nor what the task learns."""
    agent = beside(explorer)
    losses = agent.loss(random_records(reacher_task(), 2, 5))
    sum(value for name, value in losses.items() if name.startswith("loss_explore")).backward()
    assert trained(agent.model) == 0
    assert trained(agent.behaviour("reach")) == 0
    assert trained(agent.behaviour("explore").actor) > 0


@pytest.mark.parametrize("explorer", EXPLORERS)
def test_the_reward_alone_teaches_the_actor(explorer: str) -> None:
    agent = beside(explorer)
    imagine(agent)["next", "reward"].square().sum().backward()
    assert trained(agent.behaviour("explore").actor) > 0


def test_the_actor_leaves_the_ensemble_alone_and_its_own_loss_trains_it() -> None:
    agent = beside("plan2explore")
    ensemble = agent.behaviour("explore").loss.reward_loss
    losses = agent.loss(random_records(reacher_task(), 2, 5))
    losses["loss_explore_actor"].backward(retain_graph=True)
    assert trained(ensemble) == 0
    losses["loss_explore_ensemble"].backward()
    assert trained(ensemble) > 0
    assert trained(agent.model) == 0


def test_the_ensemble_learns_what_comes_next() -> None:
    """And agrees then."""
    agent, records = beside("plan2explore", {f"{REWARD}.normalize": "none"}), random_records(reacher_task(), 2, 8)
    loss = agent.behaviour("explore").loss.reward_loss
    with torch.no_grad():
        seen = TensorDict({"records": agent.model.records()(records)})
    optimizer = torch.optim.Adam(loss.parameters(), 3e-3)
    latent, action = seen["records", "next"][:, :-1], seen["records", "action"][:, 1:]
    judge = reward_part(agent, type(loss.ensemble))

    def spread() -> float:
        return float(judge(latent["state"], latent["belief"], action).var(0).mean())

    first, before = float(loss(seen)["loss_ensemble"]), spread()
    for _ in range(200):
        optimizer.zero_grad()
        loss(seen)["loss_ensemble"].backward()
        optimizer.step()
    assert float(loss(seen)["loss_ensemble"]) < 0.2 * first
    assert spread() < 0.2 * before


def test_entropy_of_object_latents() -> None:
    """From the parts, for two objects: all of them, or the one that the behaviour is about."""
    task = Task("x", 64, ("a", "b"), 4, 2, Workspace(low=(-1.0, 0.0), high=(1.0, 0.5)))
    plain = {f"{REWARD}.normalize": "none", f"{REWARD}.k": 3}

    def entropies(latent: TensorDict, agent: Agent) -> list[Tensor]:
        latents = agent.model.extractor(latent["state"], latent["belief"])
        return [particle_entropy(latents[:, :, one].reshape(24, -1), k=3, clip=1e-4).reshape(6, 4) for one in (0, 1)]

    agent = beside("focus_explore", plain, task)
    rollout = imagine(agent)
    expected = sum(entropies(rollout["next", "latent"], agent))
    torch.testing.assert_close(rollout["next", "reward"].squeeze(-1), expected)
    agent = beside("focus_explore", {**plain, f"{REWARD}.objects": "one", "behaviours.explore.object": "b"}, task)
    rollout = imagine(agent)
    expected = entropies(rollout["next", "latent"], agent)[1]
    torch.testing.assert_close(rollout["next", "reward"].squeeze(-1), expected)


def test_entropy_of_the_belief() -> None:
    rollout = imagine(beside("apt", {f"{REWARD}.normalize": "none", f"{REWARD}.k": 5}))
    belief = rollout["next", "latent", "belief"].reshape(24, -1)
    expected = particle_entropy(belief, k=5).reshape(6, 4)
    torch.testing.assert_close(rollout["next", "reward"].squeeze(-1), expected)


SETTINGS: dict[str, tuple[str, Any, Callable[[Agent], Any], Any]] = {
    "members": (
        "plan2explore",
        7,
        lambda agent: len(agent.behaviour("explore").loss.reward_loss.ensemble(*zeros(agent))),
        7,
    ),
    "layers": ("plan2explore", 3, lambda agent: len(agent.behaviour("explore").loss.reward_loss.ensemble.layers), 4),
    "units": (
        "plan2explore",
        9,
        lambda agent: agent.behaviour("explore").loss.reward_loss.ensemble.layers[0].bias.shape[-1],
        9,
    ),
    "lr": ("plan2explore", 0.5, lambda agent: agent.parameter_groups()[-1]["lr"], 0.5),
}


def zeros(agent: Agent) -> list[Tensor]:
    return [torch.zeros(1, size) for size in (agent.model.state, agent.model.belief, agent.model.action)]


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_reach_their_part(name: str) -> None:
    explorer, value, read, expected = SETTINGS[name]
    assert read(beside(explorer, {f"{REWARD}.{name}": value})) == expected
    assert read(beside(explorer)) != expected


@pytest.mark.parametrize(
    ("explorer", "name", "value"),
    [
        ("plan2explore", "log", True),
        ("plan2explore", "normalize", "scale"),
        ("focus_explore", "k", 2),
        ("focus_explore", "clip", 0.5),
        ("focus_explore", "normalize", "none"),
        ("apt", "k", 2),
        ("apt", "clip", 0.5),
        ("apt", "normalize", "scale"),
    ],
)
def test_settings_change_the_reward(explorer: str, name: str, value: Any) -> None:
    """And only it: the networks and what they draw are the same."""
    usual, other = (imagine(beside(explorer, changes)) for changes in ({}, {f"{REWARD}.{name}": value}))
    torch.testing.assert_close(usual["next", "latent", "belief"], other["next", "latent", "belief"])
    assert (usual["next", "reward"] - other["next", "reward"]).abs().max() > 1e-3


@pytest.mark.parametrize(("target", "key"), [("embedding", "encoded_latents"), ("state", "state")])
def test_what_the_ensemble_predicts(target: str, key: str) -> None:
    agent = beside("plan2explore", {f"{REWARD}.target": target})
    loss = agent.behaviour("explore").loss.reward_loss
    assert loss.tensor_keys.target == key
    after = agent.model.records()(random_records(reacher_task(), 2, 3))["next", key]
    assert loss.ensemble(*zeros(agent)).shape[-1] == after.shape[-1]


def test_a_size_gives_the_ensemble_its_units_and_style() -> None:
    size = change(
        SIZES["debug"],
        {"architecture.style": "dreamer_v2", "architecture.cnn_mults": (1, 2, 4, 8)}
        | {"architecture.gru_blocks": 8, "architecture.mlp_units": 11},
    )
    ensemble = build_agent("plan2explore", reacher_task(), size).behaviour().loss.reward_loss.ensemble
    assert (ensemble.style, ensemble.layers[0].bias.shape[-1]) == ("dreamer_v2", 11)


def test_every_parameter_is_trained_once() -> None:
    agent = beside("plan2explore")
    owned = [id(parameter) for group in agent.parameter_groups() for parameter in group["params"]]
    assert len(owned) == len(set(owned))
    assert set(owned) == {id(parameter) for parameter in agent.parameters() if parameter.requires_grad}


def test_its_moments_are_saved_and_frozen(tmp_path: Path) -> None:
    agent = beside("focus_explore")
    for seed in range(3):
        agent.loss(random_records(reacher_task(), 2, 5, seed=seed))
    norm = reward_part(agent, StreamingNorm)
    assert norm.calls == 3
    assert norm.mean != 0
    loaded = load_agent(save_agent(agent, tmp_path / "agent.zip"), behaviour="explore").agent
    again = reward_part(loaded, StreamingNorm)
    torch.testing.assert_close(again.state_dict(), norm.state_dict())
    agent.eval()
    torch.testing.assert_close(imagine(loaded)["next", "reward"], imagine(agent)["next", "reward"])
    assert norm.calls == again.calls == 3


def test_each_behaviour_acts_by_its_name(tmp_path: Path) -> None:
    file = save_agent(beside("focus_explore"), tmp_path / "agent.zip")
    records = random_records(reacher_task(), 2, 1)
    step = records["next"][:, 0].exclude("reward", "done", "terminated").set("is_init", records["is_init"][:, 0])
    explorer, task = load_agent(file, behaviour="explore"), load_agent(file)
    assert explorer.behaviour is explorer.agent.behaviours["explore"]
    assert not explorer.takes_images
    assert task.behaviour is task.agent.behaviours["reach"]
    assert "goal" not in explorer(step.clone().exclude("goal_position"))["latent"]
    assert pickle.loads(pickle.dumps(explorer)).in_keys == explorer.in_keys  # for workers
    with pytest.raises(ValueError, match="unknown behaviour 'play'; this agent has reach, explore"):
        load_agent(file, behaviour="play")


def test_the_order_of_behaviours_is_not_that_of_a_file(tmp_path: Path) -> None:
    names = ("b", "reach", "a")
    row = replace(LCP, behaviours=dict.fromkeys(names, EXPLORERS["apt"]))
    agent = build_agent(row, reacher_task(), "debug")
    assert list(agent.behaviours) == list(row.behaviours) == ["reach", "a", "b"]
    row = replace(LCP, behaviours=dict.fromkeys(("b", "a"), EXPLORERS["apt"]))
    agent = build_agent(row, reacher_task(), "debug")
    loaded = load_agent(save_agent(agent, tmp_path / "agent.zip")).agent
    assert [name for name, _ in loaded.named_parameters()] == [name for name, _ in agent.named_parameters()]
    assert loaded.config.acting == row.acting == "a"


def test_a_row_that_only_explores() -> None:
    agent = build_agent("plan2explore", reacher_task(), "debug")
    assert agent.config.acting == "explore"
    assert {"loss_actor", "loss_value", "loss_ensemble"} < set(agent.loss(random_records(reacher_task(), 2, 5)).keys())
    assert agent.model.reward_head is None


def test_objects_need_object_latents() -> None:
    row = AGENTS["dreamer_pcp"].and_behaviours(explore=EXPLORERS["focus_explore"])
    with pytest.raises(SettingsError, match="object latents need world_model='object'"):
        build_agent(row, reacher_task(), "debug")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("members", 1, "members must be at least 2"),
        ("layers", -1, "layers must be at least 0"),
        ("units", 0, "units must be at least 1"),
        ("target", "image", "target must be one of 'embedding', 'state'"),
        ("normalize", "rms", "normalize must be one of 'none', 'scale', 'standard'"),
        ("k", 3, "k is no setting"),
    ],
)
def test_bad_settings(name: str, value: Any, message: str) -> None:
    with pytest.raises(SettingsError, match=f"{REWARD}.{message}"):
        change(AGENTS["plan2explore"], {f"{REWARD}.{name}": value})


def test_names() -> None:
    row = LCP.and_behaviours(explore=EXPLORERS["plan2explore"])
    assert agent_name(AGENTS["plan2explore"]) == "plan2explore"
    assert agent_name(row) == "focus_lcp + plan2explore"
    assert agent_name(change(row, {f"{REWARD}.members": 9})) == f"focus_lcp + plan2explore ({REWARD}.members=9)"


def test_settings_survive_a_file() -> None:
    for behaviour in (Behaviour(reward=Disagreement(members=3, lr=0.1)), Behaviour(reward=ObjectEntropy(k=3))):
        assert from_dict(Behaviour, to_dict(behaviour)) == behaviour
