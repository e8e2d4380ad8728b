"""What the settings of explorers, of LEXA's parts and of goals reached later do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch
from debug_agents import PAIR, TASK, changes_of, loss, losses, make
from rows import shows
from tensordict import TensorDict
from torch import Tensor

from torchrl_ocwm.agents import AGENTS, EXPLORERS, Agent, build_agent
from torchrl_ocwm.agents.checkpoint import CheckpointError, describe, rebuild
from torchrl_ocwm.envs import Task
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import random_records

REWARD = "behaviours.explore.reward"
TEMPORAL = "behaviours.reach.reward"


def explorer(name: str, changes: Mapping[str, Any] = {}, task: Task = TASK) -> Agent:
    torch.manual_seed(0)
    row = change(
        AGENTS["focus_pcp"].and_behaviours(explore=EXPLORERS[name]),
        {f"{REWARD}.{key}": value for key, value in changes.items()},
    )
    return build_agent(row, task, "debug")


def rewards(agent: Agent) -> Tensor:
    """Of imagined states ``[6, 4]`` that are the same for all agents."""
    torch.manual_seed(1)
    shape = (6, 4)
    latent = {"state": torch.rand(*shape, agent.model.state), "belief": torch.randn(*shape, agent.model.belief)}
    now, before = TensorDict(latent, shape), TensorDict({key: value.flip(0) for key, value in latent.items()}, shape)
    steps = TensorDict({"latent": now, "before": before, "action": torch.rand(*shape, agent.model.action)}, shape)
    operator = agent.behaviour("explore").imagination.world_model.get_reward_operator()
    return operator(steps)["reward"].detach()


@shows("ExplorationReward.normalize")
def test_rewards_are_brought_to_one_scale() -> None:
    raw, standard, scale = (rewards(explorer("apt", {"normalize": how})) for how in ("none", "standard", "scale"))
    assert not torch.allclose(raw, standard)
    ratio = scale / raw
    torch.testing.assert_close(ratio, ratio[:1, :1].expand_as(ratio))  # divided by one number
    slope = (standard - standard.mean()) / (raw - raw.mean())
    torch.testing.assert_close(slope, slope[:1, :1].expand_as(slope), rtol=1e-3, atol=1e-3)  # shifted too


@shows("Disagreement.members", "Disagreement.layers", "Disagreement.units", "Disagreement.target")
def test_the_shape_of_an_ensemble() -> None:
    settings = {"members": 3, "layers": 2, "units": 9, "target": "state"}
    agent = explorer("plan2explore", settings)
    ensemble = agent.behaviour("explore").loss.reward_loss.ensemble
    inputs = [torch.zeros(5, size) for size in (agent.model.state, agent.model.belief, agent.model.action)]
    assert ensemble(*inputs).shape == (3, 5, agent.model.state)
    assert [layer.bias.shape[-1] for layer in ensemble.layers] == [9, 9, agent.model.state]
    agent = explorer("plan2explore", {**settings, "target": "embedding"})
    ensemble = agent.behaviour("explore").loss.reward_loss.ensemble
    assert ensemble(*inputs).shape == (3, 5, agent.model.encoder.features)


@shows("Disagreement.log")
def test_the_logarithm_of_the_disagreement() -> None:
    """Of the standard deviation, whose square is the variance; both are means over the features."""
    variance, log = (rewards(explorer("plan2explore", {"normalize": "none", "log": log})) for log in (False, True))
    assert (variance > 0).all()
    assert (log <= 0.5 * variance.log() + 1e-4).all()  # of a mean is more than the mean of


@shows("Disagreement.lr", "TemporalDistance.lr")
@pytest.mark.parametrize("row", ["plan2explore", "lexa_temporal"])
def test_what_learns_for_a_reward_has_its_rate(row: str) -> None:
    name = "explore" if row == "plan2explore" else "reach"
    for rate, expected in ((None, 1e-3), (0.05, 0.05), (0.0, 0.0)):
        changes = {f"behaviours.{name}.reward.lr": rate}
        agent = make(row, changes, {"learning.optimizer": {"name": "adam", "eps": 1e-20}})
        parameters = list(agent.behaviour().loss.reward_loss.parameters())
        moved = changes_of(agent, {"reward": parameters})["reward"]
        assert moved == pytest.approx(expected, rel=0.02)


@shows("ObjectEntropy.k", "ObjectEntropy.clip", "StateEntropy.k", "StateEntropy.clip")
@pytest.mark.parametrize("name", ["focus_explore", "apt"])
def test_nearest_neighbours(name: str) -> None:
    """The more are averaged the farther they are; what is nearer than the clip counts as nothing."""
    near, far = (rewards(explorer(name, {"normalize": "none", "k": k})) for k in (2, 20))
    assert (near < far).all()
    assert (near > 0).all()
    assert (rewards(explorer(name, {"normalize": "none", "clip": 1e6})) == 0).all()


@shows("ObjectEntropy.objects")
def test_all_objects_or_one() -> None:
    every, one = (
        rewards(explorer("focus_explore", {"normalize": "none", "objects": which}, PAIR)) for which in ("all", "one")
    )
    assert (every > one).all()


@shows("FullLatent.weight")
def test_the_weight_of_what_images_alone_show() -> None:
    weight = "behaviours.reach.goal.weight"
    one, three = (loss("loss_model_image_latent", "lexa_cosine", {weight: value}) for value in (1, 3))
    torch.testing.assert_close(three, 3 * one)
    assert one != 0


@shows("TemporalDistance.layers", "TemporalDistance.units", "TemporalDistance.batch_norm")
def test_the_shape_of_the_temporal_distance() -> None:
    settings = {"layers": 2, "units": 7, "batch_norm": True}
    agent = make("lexa_temporal", {f"{TEMPORAL}.{name}": value for name, value in settings.items()})
    network = agent.behaviour().loss.reward_loss.distance
    assert [layer.out_features for layer in network.linears] == [7, 7]
    assert len(network.norms) == 2
    before = network.norms[0].running_mean.clone()
    losses(agent)
    assert not torch.equal(network.norms[0].running_mean, before)
    assert not make("lexa_temporal").behaviour().loss.reward_loss.distance.norms


@shows("TemporalDistance.positives", "TemporalDistance.negatives")
def test_pairs_that_the_temporal_distance_learns_from() -> None:
    changes = {f"{TEMPORAL}.positives": 20, f"{TEMPORAL}.negatives": 0.25}
    agent, pairs = make("lexa_temporal", changes), []

    def look(module: Any, arguments: tuple[Tensor, ...], options: dict[str, Any]) -> None:
        if options.get("learning"):
            pairs.append(len(arguments[0]))

    agent.behaviour().loss.reward_loss.distance.register_forward_pre_hook(look, with_kwargs=True)
    losses(agent)
    assert pairs == [25]


def offsets(mean_offset: float, share: float) -> Tensor:
    """How many frames later goals are than the starts that they belong to; NaN for those of other sequences."""
    goals = {"name": "future", "mean_offset": mean_offset, "share": share}
    agent = make(changes={"behaviours.reach.goals": goals})
    torch.manual_seed(1)
    records = agent.model.records()(random_records(TASK, 6, 60))
    frames = records["next"].set("is_init", records["is_init"])
    chosen = agent.behaviour().loss.imagination_start(frames)["latent", "goal"].reshape(6, 60, 1, 2)
    same = (chosen - frames["object_units"].unsqueeze(1)).abs().amax(-1) < 1e-6
    found = same.float().argmax(-1) - torch.arange(60)
    return torch.where(same.any(-1), found, torch.nan)


@shows("FutureGoalSource.mean_offset", "FutureGoalSource.share")
def test_goals_that_are_reached_later() -> None:
    soon, late, random = offsets(2.0, 1.0), offsets(20.0, 1.0), offsets(2.0, 0.0)
    assert (soon[:, :-1] >= 1).all()  # the last frame has none
    assert 1 < soon[:, :20].mean() < 3
    assert 8 < late[:, :20].mean() < 25
    assert random.isnan().float().mean() > 0.6
    assert 0.2 < offsets(2.0, 0.5).isnan().float().mean() < 0.6


@shows("Description.plugins")
def test_a_part_of_a_package_that_is_not_here() -> None:
    description = describe(make())
    assert rebuild(description).config == AGENTS["dreamer_pcp"]
    description["agent"]["behaviours"]["reach"]["reward"] = {"name": "glory"}
    description["plugins"] = {"reward glory": "fame"}
    with pytest.raises(CheckpointError, match="not registered here: reward 'glory' of the package 'fame'"):
        rebuild(description)
