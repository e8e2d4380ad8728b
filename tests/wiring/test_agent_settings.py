"""What the settings of agents do: world models, behaviours and their parts, sizes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from debug_agents import PAIR, REACH, TASK, changes_of, groups, imagined, loss, losses, make
from rows import shows
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_ocwm.agents import AGENTS, Adam, Agent, DreamerV3, build_agent
from torchrl_ocwm.agents.checkpoint import CheckpointError, describe, rebuild
from torchrl_ocwm.envs import Workspace
from torchrl_ocwm.modules import MovingCentre
from torchrl_ocwm.settings import SettingsError
from torchrl_ocwm.testing import STYLES, random_records, reacher_task

# Learning.


@shows("Learning.imagination_horizon")
@pytest.mark.parametrize("horizon", [2, 4])
def test_imagination_goes_so_far(horizon: int) -> None:
    agent = make(size={"learning.imagination_horizon": horizon})
    assert imagined(agent).shape == (10, horizon)


@shows("Learning.model_lr", "Learning.actor_lr", "Learning.value_lr", "Size.learning")
@pytest.mark.parametrize("name", ["model_lr", "actor_lr", "value_lr"])
def test_learning_rates_are_those_of_their_parts(name: str) -> None:
    """Adam's first step is as long as the learning rate."""
    rates = {"model_lr": 1e-2, "actor_lr": 1e-3, "value_lr": 1e-4, name: 0.0}
    size = {"learning.optimizer": {"name": "adam", "eps": 1e-20}}
    agent = make(size={**size, **{f"learning.{key}": rate for key, rate in rates.items()}})
    assert changes_of(agent, groups(agent)) == pytest.approx(rates, rel=0.02)


@shows("Learning.gamma")
def test_gamma_discounts_what_comes_later() -> None:
    """Without a future the return is the reward; with one it is further off the longer it counts."""
    returns = {gamma: imagined(make(size={"learning.gamma": gamma})) for gamma in (0.0, 0.5, 1.0)}
    now = returns[0.0]
    torch.testing.assert_close(now["lambda_target"], now["next", "reward"])
    later = [(returns[gamma]["lambda_target"][:, 0] - now["lambda_target"][:, 0]).abs().mean() for gamma in (0.5, 1.0)]
    assert 0 < later[0] < later[1]


@shows("Learning.entropy_bonus")
def test_the_entropy_bonus_is_a_weight() -> None:
    none, one, two = (loss("loss_actor", "dreamer_pcp", size={"learning.entropy_bonus": value}) for value in (0, 1, 2))
    assert one < none
    torch.testing.assert_close(two - none, 2 * (one - none))


@shows("Learning.lambda_dynamic")
def test_the_weight_of_the_prior() -> None:
    one, three = (loss("loss_model_dynamic", "dreamer", size={"learning.lambda_dynamic": value}) for value in (1, 3))
    torch.testing.assert_close(three, 3 * one)


@shows("Learning.optimizer", "DreamerV3.warmup")
def test_optimizers() -> None:
    """One steps as far as the learning rate at once, the other takes its time."""

    def moved(optimizer: Any, updates: int) -> float:
        agent = make(size={"learning.optimizer": optimizer, "learning.model_lr": 1e-2})
        return changes_of(agent, groups(agent), updates)["model_lr"]

    assert moved(Adam(), 1) == pytest.approx(1e-2, rel=0.02)
    assert moved(DreamerV3(), 1) > 0
    assert moved(DreamerV3(warmup=10), 1) == 0
    assert 0 < moved(DreamerV3(warmup=10), 2) < 0.2 * moved(DreamerV3(), 2)


def stepped(optimizer: Adam, gradient: float) -> tuple[float, float]:
    """Weight and gradient after one step from a weight of 1 at a learning rate of 0.5."""
    weight = nn.Parameter(torch.ones(1))
    made = optimizer.build([{"params": [weight], "lr": 0.5}])
    weight.grad = torch.full_like(weight, gradient)
    made.step()
    return weight.item(), weight.grad.item()


@shows("Adam.max_norm", "Adam.eps", "Adam.decay")
def test_adam() -> None:
    assert stepped(Adam(max_norm=2.0), 30.0)[1] == pytest.approx(2.0)
    assert stepped(Adam(decay=0), 1.0)[0] == pytest.approx(0.5, rel=1e-3)
    assert stepped(Adam(decay=0, eps=1.0), 1.0)[0] == pytest.approx(0.75, rel=1e-3)  # half as far
    assert stepped(Adam(decay=0.25), 0.0)[0] == pytest.approx(0.75, rel=1e-3)


# Architecture.


ALL_VECTORS = {"vector_decoders", "position_decoder"}
LATENT = {"prior", "posterior", "vector_decoders", "extractor", "continue_head"}
NUMBERS: dict[str, tuple[Any, set[str]]] = {
    "cnn_depth": (3, {"encoder", "object_decoder", "posterior"}),
    "cnn_mults": ((1, 2, 3, 4), {"encoder", "object_decoder", "posterior"}),
    "categoricals": (5, LATENT),
    "classes": (5, LATENT),
    "belief": (20, LATENT),
    "hidden": (18, {"prior", "posterior"}),
    "gru_blocks": (4, {"prior"}),
    "mlp_layers": (2, {"encoder", "positional_encoder", *ALL_VECTORS}),
    "mlp_units": (20, {"encoder", "positional_encoder", "posterior", "continue_head", *ALL_VECTORS}),
    "object_features": (12, {"extractor", "object_decoder", "position_decoder", "positional_encoder"}),
    "extractor_units": (24, {"extractor"}),
}


@shows(*(f"Architecture.{name}" for name in NUMBERS), "Size.architecture")
@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_shape_their_networks(name: str) -> None:
    """And no other ones."""
    value, parts = NUMBERS[name]
    before, after = (
        {key: tensor.shape for key, tensor in make("focus_lcp", size=size).model.state_dict().items()}
        for size in ({}, {f"architecture.{name}": value})
    )
    changed = {key for key in {*before, *after} if before.get(key) != after.get(key)}
    assert {key.split(".")[0] for key in changed} == parts
    sizes = {size for key in changed if key in after for size in after[key]}
    if name not in ("mlp_layers", "gru_blocks"):
        least = value[-1] if isinstance(value, tuple) else value
        assert any(size % least == 0 for size in sizes)


@shows("Architecture.mlp_layers", "Architecture.mlp_units")
def test_actor_and_critic_have_the_same_numbers() -> None:
    behaviour = make(size={"architecture.mlp_layers": 3, "architecture.mlp_units": 20}).behaviour()
    actor = [layer.out_features for layer in behaviour.actor.modules() if isinstance(layer, nn.Linear)]
    critic = [tuple(weight.shape) for weight in behaviour.loss.value_loss.value_model_params.values(True, True)]
    assert actor == [20, 20, 20, 4]
    assert critic.count((20, 20)) == 2


@shows("Architecture.style")
def test_styles() -> None:
    for style, kind, other in (("dreamer_v3", "DreamerV3MLP", "GRUCell"), ("dreamer_v2", "GRUCell", "DreamerV3MLP")):
        layers = {type(part).__name__ for part in make(size=STYLES[style], task=reacher_task()).modules()}
        assert kind in layers
        assert other not in layers


# World models.


def states(agent: Agent, records: TensorDictBase) -> Tensor:
    torch.manual_seed(1)
    return agent.model.records()(records.clone())["next", "posterior_logits"]


@shows("_Observing.observed")
@pytest.mark.parametrize("row", ["dreamer", "focus"])
def test_what_is_observed_is_seen_and_nothing_else(row: str) -> None:
    records = random_records(TASK, 2, 3)
    for observed in (("proprio", "object_position"), ("object_position", "goal_position")):
        agent = make(row, {"world_model.observed": observed})
        before = states(agent, records)
        seen = set()
        for name in ("proprio", "object_position", "goal_position"):
            other = records.clone()
            other["next", name] += 0.5
            if not torch.equal(states(agent, other), before):
                seen.add(name)
        assert seen == set(observed)


@shows("PositionDistance.unit")
def test_the_unit_of_a_distance() -> None:
    """A workspace of 0.48 m is 2 half-widths wide."""
    metres = make("dreamer_pcp")
    units = make("dreamer_pcp", {f"{REACH}.reward.unit": "workspace"})
    units.model.load_state_dict(metres.model.state_dict())
    half = metres.model.units.metres_per_unit[0]
    torch.testing.assert_close(reward(metres, latents(metres)), half * reward(units, latents(metres)))


@shows("_Observing.predicted")
@pytest.mark.parametrize("row", ["dreamer_pcp", "focus_pcp", "focus_lcp"])
def test_what_is_predicted_is_learnt_and_not_seen(row: str) -> None:
    """The agent acts without it, too."""
    agent = make(row, {"world_model.observed": ("proprio",), "world_model.predicted": ("object_position",)})
    records = random_records(TASK, 2, 3)
    other = records.clone()
    other["next", "object_position"] += 0.1
    torch.testing.assert_close(states(agent, other), states(agent, records), rtol=0, atol=0)
    before, after = (agent.loss.model_loss(one.clone())[0]["loss_model_object_position"] for one in (records, other))
    assert before != after
    assert ("next", "object_position") in agent.loss.in_keys
    assert "object_position" not in agent.policy().in_keys
    assert "object_position" in make(row).policy().in_keys


@pytest.mark.parametrize("row", ["dreamer", "focus"])
def test_goals_can_be_predicted_alone(row: str) -> None:
    changes = {"world_model.observed": ("proprio", "object_position"), "world_model.predicted": ("goal_position",)}
    agent = make(row, changes)
    assert agent.loss.model_loss(random_records(TASK, 2, 3))[0]["loss_model_goal_position"] > 0
    assert "goal_position" not in agent.policy().in_keys


def test_nothing_is_observed_and_predicted() -> None:
    with pytest.raises(SettingsError, match="'object_position' is in observed and in predicted"):
        make("focus", {"world_model.predicted": ("object_position",)})


@shows("_Observing.lambda_proprio", "_Observing.lambda_object_position", "_Observing.lambda_goal_position")
@pytest.mark.parametrize("row", ["dreamer", "focus"])
@pytest.mark.parametrize("name", ["proprio", "object_position", "goal_position"])
def test_weights_of_what_is_observed(row: str, name: str) -> None:
    one, three = (loss(f"loss_model_{name}", row, {f"world_model.lambda_{name}": value}) for value in (1, 3))
    torch.testing.assert_close(three, 3 * one)
    assert one > 0


@shows("AgentConfig.world_model")
def test_world_models() -> None:
    flat, objects = losses(make("dreamer")), losses(make("focus"))
    assert "loss_model_pixels" in flat
    assert "loss_model_masks" in objects


# Behaviours.


def reward(agent: Agent, latent: TensorDictBase) -> Tensor:
    return agent.imagination.world_model.get_reward_operator()(TensorDict({"latent": latent.clone()}, [4]))["reward"]


def latents(agent: Agent) -> TensorDictBase:
    torch.manual_seed(2)
    sizes = {"state": agent.model.state, "belief": agent.model.belief, "goal": agent.behaviour().goal.features}
    return TensorDict({name: torch.randn(4, size) for name, size in sizes.items()}, [4])


@shows("AgentConfig.behaviours")
def test_each_behaviour_learns() -> None:
    row = replace(
        AGENTS["focus_lcp"], behaviours=dict.fromkeys(("reach", "other"), AGENTS["focus_pcp"].behaviours["reach"])
    )
    agent = build_agent(row, TASK, "debug")
    assert {"loss_actor", "loss_other_actor"} <= set(losses(agent).keys())


@shows("Behaviour.goal")
@pytest.mark.parametrize(("row", "sees"), [("dreamer", False), ("dreamer_pcp", True), ("focus_lcp", True)])
def test_the_policy_sees_the_goal(row: str, sees: bool) -> None:
    agent = make(row)
    step = random_records(TASK, 4, 1)["next"][:, 0].select("pixels", "proprio", "object_position", "goal_position")
    step["is_init"] = torch.ones(4, 1, dtype=torch.bool)
    other = step.clone()
    other["goal_position"] = -step["goal_position"]
    actions, latent = [], []
    for one in (step, other):
        torch.manual_seed(1)
        played = agent.policy()(one.clone())
        actions.append(played["action"])
        latent.append(played["latent", "belief"])
    if row != "dreamer":  # whose world model sees it
        assert torch.equal(*latent)
    assert torch.equal(*actions) != (sees or row == "dreamer")
    assert ("goal" in played["latent"]) == sees


@shows("Behaviour.reward")
def test_the_reward_is_the_chosen_one() -> None:
    """In metres for positions, the slope of a chord or a cosine for latents."""
    agent = make("focus_lcp")
    latent = latents(agent)
    extracted = agent.model.extractor(latent["state"], latent["belief"])[:, 0]
    cosine = torch.cosine_similarity(extracted, latent["goal"], dim=-1).unsqueeze(-1)
    torch.testing.assert_close(reward(agent, latent), -(2 - 2 * cosine).sqrt())
    agent = make("focus_lcp", {f"{REACH}.reward": "latent_similarity"})
    torch.testing.assert_close(reward(agent, latent), cosine)
    agent = make("dreamer_pcp")
    latent = latents(agent)
    position = agent.model.vector_decoders["object_position"](latent["state"], latent["belief"])
    torch.testing.assert_close(reward(agent, latent), -0.24 * (position - latent["goal"]).norm(dim=-1, keepdim=True))


@shows("LatentSimilarity.distance")
def test_the_distance_of_latents() -> None:
    changes = {f"{REACH}.reward": {"name": "latent_similarity", "distance": "mse"}, f"{REACH}.goal.distance": "mse"}
    agent = make("focus_lcp", changes)
    latent = latents(agent)
    extracted = agent.model.extractor(latent["state"], latent["belief"])[:, 0]
    expected = -(extracted - latent["goal"]).square().mean(-1, keepdim=True)
    torch.testing.assert_close(reward(agent, latent), expected)


@shows("LatentChord.centred")
def test_a_centred_chord_takes_out_what_imagined_latents_share() -> None:
    """It learns the centre while it is trained, keeps it afterwards, and compares what is left."""
    agent = make("focus_lcp", {f"{REACH}.reward.centred": True})
    latent = latents(agent)
    plain = reward(make("focus_lcp"), latent)
    (centre,) = (module for module in agent.modules() if isinstance(module, MovingCentre))
    losses(agent)
    agent.eval()
    mean = centre.mean.clone()
    assert mean.norm() > 0.1
    directions = [
        torch.nn.functional.normalize(part, dim=-1) - mean
        for part in (agent.model.extractor(latent["state"], latent["belief"])[:, 0], latent["goal"])
    ]
    cosine = torch.cosine_similarity(*directions, dim=-1).unsqueeze(-1)
    torch.testing.assert_close(reward(agent, latent), -(2 - 2 * cosine).sqrt())
    assert torch.equal(centre.mean, mean)
    assert not torch.allclose(reward(agent, latent), plain)


def starts(agent: Agent) -> tuple[Tensor, TensorDictBase]:
    """Goals of imagination, and the records from which it starts."""
    torch.manual_seed(1)
    records = agent.model.records()(random_records(agent.task, 2, 5))
    return agent.behaviour().loss.imagination_start(records["next"])["latent", "goal"], records["next"]


def shared(goals: Tensor, places: Tensor) -> float:
    """Share of the goals that are among places."""
    return float((torch.cdist(goals, places.reshape(-1, goals.shape[-1])).min(-1).values < 1e-5).float().mean())


@shows("Behaviour.goals")
def test_goals_in_imagination() -> None:
    for source, share in (("uniform", 0.0), ("frames", 1.0)):
        goals, frames = starts(make(changes={f"{REACH}.goals": source}))
        assert shared(goals, frames["object_units"]) == share


@shows("MixedGoalSource.share")
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_the_share_of_frames(share: float) -> None:
    goals, frames = starts(make(changes={f"{REACH}.goals": {"name": "mixed", "share": share}}))
    assert shared(goals, frames["object_units"]) == share


@shows("Behaviour.object")
@pytest.mark.parametrize(("name", "index"), [(None, 0), ("finger", 0), ("thumb", 1)])
def test_the_object_decides_goals_and_rewards(name: str | None, index: int) -> None:
    changes = {f"{REACH}.object": name, f"{REACH}.goals": "frames"}
    agent = make(changes=changes, task=PAIR)
    goals, frames = starts(agent)
    assert shared(goals, frames["object_position"][..., index, :] / 0.24) == 1
    latent = latents(agent)
    position = agent.model.vector_decoders["object_position"](latent["state"], latent["belief"]).unflatten(-1, (2, 2))
    expected = -0.24 * (position[:, index] - latent["goal"]).norm(dim=-1, keepdim=True)
    torch.testing.assert_close(reward(agent, latent), expected)
    agent = make("focus_lcp", changes, task=PAIR)
    latent = latents(agent)
    extracted = agent.model.extractor(latent["state"], latent["belief"])[:, index]
    cosine = torch.cosine_similarity(extracted, latent["goal"], dim=-1).unsqueeze(-1)
    torch.testing.assert_close(reward(agent, latent), -(2 - 2 * cosine).sqrt())
    position = agent.behaviour().goal.position(torch.zeros(1, 2))
    expected = agent.model.positional_encoder(torch.zeros(1, 2, 2))[:, index]
    torch.testing.assert_close(torch.cosine_similarity(position, expected), torch.ones(1))


@shows("ObjectLatent.weight")
def test_the_weight_of_the_positional_encoder() -> None:
    one, three = (loss("loss_model_positional", "focus_lcp", {f"{REACH}.goal.weight": value}) for value in (1, 3))
    torch.testing.assert_close(three, 3 * one)
    assert one != 0


@shows("ObjectLatent.final_weight", "ObjectLatent.annealing_updates")
def test_the_weight_of_the_positional_encoder_moves() -> None:
    """From 100 to 4 in two updates by way of 20, and no further."""
    agent = make("focus_lcp", {f"{REACH}.goal.final_weight": 4, f"{REACH}.goal.annealing_updates": 2})
    same = loss("loss_model_positional", "focus_lcp", {f"{REACH}.goal.weight": 1})
    for weight in (100, 20, 4, 4):
        torch.testing.assert_close(losses(agent)["loss_model_positional"], weight * same)
    for changes, message in (
        ({"weight": 0, "final_weight": 4}, "final_weight needs a weight above 0"),
        ({"annealing_updates": 2}, "annealing_updates does nothing without a final_weight"),
    ):
        with pytest.raises(SettingsError, match=message):
            make("focus_lcp", {f"{REACH}.goal.{name}": value for name, value in changes.items()})


@shows("ObjectLatent.distance")
def test_the_distance_that_the_positional_encoder_learns_by() -> None:
    """The cosine sees directions only, so that all goals are brought to one length; the squared error sees lengths."""
    for distance in ("cosine", "mse"):
        similarity = {"name": "latent_similarity", "distance": distance}
        agent = make("focus_lcp", {f"{REACH}.goal.distance": distance, f"{REACH}.reward": similarity})
        torch.manual_seed(1)
        records = agent.model.records()(random_records(TASK, 2, 5))["next"]
        encoded, latent = records["positional_latent"][..., 0, :], records["object_latent"][..., 0, :]
        expected = -torch.cosine_similarity(encoded, latent, dim=-1)
        if distance == "mse":
            expected = (encoded - latent).square().mean(-1)
        torch.testing.assert_close(losses(agent)["loss_model_positional"], 100 * expected.mean())
        lengths = agent.behaviour().goal.position(torch.rand(5, 2)).norm(dim=-1)
        assert torch.allclose(lengths, lengths[:1]) == (distance == "cosine")


@shows("ObjectLatent.gradient")
@pytest.mark.parametrize("gradient", ["encoder", "latent", "both"])
def test_what_the_positional_loss_trains(gradient: str) -> None:
    agent = make("focus_lcp", {f"{REACH}.goal.gradient": gradient})
    losses(agent)["loss_model_positional"].backward()
    trained = {
        name
        for name, part in {"encoder": agent.model.positional_encoder, "latent": agent.model.extractor}.items()
        if any(parameter.grad is not None and parameter.grad.any() for parameter in part.parameters())
    }
    assert trained == ({"encoder", "latent"} if gradient == "both" else {gradient})


# Tasks, and agents on disk.


@shows("Task.image_size", "Task.objects", "Task.proprio", "Task.action")
def test_an_agent_has_the_shapes_of_its_task() -> None:
    task = replace(TASK, image_size=32, objects=("a", "b", "c"), proprio=7, action=4)
    agent = make("focus_lcp", task=task)
    records = agent.model.records()(random_records(task, 2, 3))["next"]
    assert records["mask_logits"].shape == (2, 3, 4, 32, 32)
    assert records["reco_proprio"].shape == (2, 3, 7)
    assert losses(agent)["loss_actor"].isfinite()
    assert imagined(agent)["action"].shape[-1] == 4


@shows("Task.workspace", "Workspace.low", "Workspace.high")
def test_goals_lie_in_the_workspace() -> None:
    workspace = Workspace(low=(0.0, -1.0, 2.0), high=(0.5, 1.0, 4.0))
    goals = workspace.sample((2000,))
    torch.testing.assert_close(goals.amin(0), torch.tensor(workspace.low), atol=0.02, rtol=0)
    torch.testing.assert_close(goals.amax(0), torch.tensor(workspace.high), atol=0.02, rtol=0)
    units = make(task=replace(TASK, workspace=workspace)).model.units
    torch.testing.assert_close(units(torch.tensor([0.0, 1.0, 3.0])), torch.tensor([-1.0, 1.0, 0.0]))


@shows("Workspace.reach")
def test_evaluation_goals_can_be_reached() -> None:
    box = Workspace(low=(-1.0, -1.0), high=(1.0, 1.0))
    assert box.grid(8).norm(dim=-1).max() > 1.2
    distance = replace(box, reach=(0.2, 0.6)).grid(8).norm(dim=-1)
    assert 0.2 <= distance.min() <= distance.max() <= 0.6


@shows("Description.agent", "Description.size", "Description.task", "Description.release")
def test_an_agent_is_rebuilt_from_its_description() -> None:
    agent = make("focus_lcp", {"world_model.lambda_proprio": 3}, {"learning.gamma": 0.5}, PAIR)
    description = describe(agent)
    again = rebuild(description)
    assert [parameter.shape for parameter in again.parameters()] == [value.shape for value in agent.parameters()]
    assert (again.config, again.size, again.task) == (agent.config, agent.size, PAIR)
    description["agent"]["old"] = 1
    with pytest.raises(CheckpointError, match="damaged: agent.old"):
        rebuild(description)
    with pytest.raises(CheckpointError, match="of release '0.0'"):
        rebuild({**description, "release": "0.0"})
