"""The LEXA rows and hindsight goals, wired: what is a goal, what is rewarded, and what trains what."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.functional import cosine_similarity

from torchrl_ocwm.agents import AGENTS, Agent, build_agent
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.envs.workspace import Workspace
from torchrl_ocwm.modules import FutureGoals
from torchrl_ocwm.settings import SettingsError, change
from torchrl_ocwm.testing import random_records, reacher_task

REACH = "behaviours.reach"
ROWS = ("lexa_cosine", "lexa_temporal")


def understood(agent: Agent, records: TensorDict) -> TensorDict:
    """What the world model makes of the frames of records."""
    return agent.loss.model_loss(records)[1]["next"]


def goals_in_imagination(agent: Agent, records: TensorDict) -> Tensor:
    """The goals of an update, ``[B, T, G]``."""
    loss, seen = agent.behaviour().loss, []
    hook = loss.goal_source.register_forward_hook(lambda _, inputs, output: seen.append(output["latent", "goal"]))
    agent.loss(records.select(*agent.loss.in_keys))
    hook.remove()
    return seen[0]


def given(agent: Agent, pixels: Tensor) -> Tensor:
    """The goals that a policy makes of images ``[N, 3, H, W]`` or ``[N, F, 3, H, W]``."""
    number = len(pixels)
    step = random_records(reacher_task(), number, 1)["next"][:, 0].select("pixels", "proprio", "object_position")
    step["is_init"] = torch.ones(number, 1, dtype=torch.bool)
    return agent.policy()(step.set("goal", TensorDict({"pixels": pixels}, [number])))["latent", "goal"]


@pytest.mark.usefixtures("no_noise")
@pytest.mark.parametrize("name", ROWS)
def test_a_goal_in_imagination_is_what_a_policy_makes_of_the_image(
    make_agent: Any, records: TensorDict, name: str
) -> None:
    agent = make_agent(name)
    known = given(agent, records["next", "pixels"].flatten(0, 1))
    drawn = goals_in_imagination(agent, records).flatten(0, 1)
    # Each frame is drawn once, in some order.
    projection = torch.randn(known.shape[-1])
    torch.testing.assert_close((drawn @ projection).sort().values, (known @ projection).sort().values)
    assert len((known @ projection).unique()) > 4


def test_full_latent_of_an_image_is_that_of_a_first_frame_without_vectors(make_agent: Any, records: TensorDict) -> None:
    model = make_agent("lexa_cosine").model
    torch.manual_seed(1)
    got = model.latent_in_images()(records["next", "pixels"][0, :4].unsqueeze(1))
    zeros = torch.zeros(4, model.state), torch.zeros(4, model.belief)
    torch.manual_seed(1)
    belief = model.prior._update_belief(*zeros, torch.zeros(4, model.action))
    state = model.posterior(belief, model.encoder(records["next", "pixels"][0, :4]))[1]
    torch.testing.assert_close(got, torch.cat([state, belief], -1))


def test_of_several_images_the_last_is_the_embedding(make_agent: Any, records: TensorDict) -> None:
    agent, images = make_agent("lexa_temporal"), records["next", "pixels"][:, :3]
    torch.testing.assert_close(given(agent, images), agent.model.encoder.image(images[:, -1]))
    assert given(agent, images).shape[-1] == agent.model.encoder.image_features


@pytest.mark.parametrize("name", ROWS)
def test_imagined_reward(make_agent: Any, records: TensorDict, name: str) -> None:
    """By hand, and its gradient alone teaches the actor."""
    agent = make_agent(name)
    start = agent.behaviour().loss.imagination_start(understood(agent, records))
    rollout = agent.imagination.rollout(3, agent.actor, auto_reset=False, tensordict=start, break_when_any_done=False)
    after, reward = rollout["next", "latent"], rollout["next", "reward"].squeeze(-1)
    if name == "lexa_cosine":
        expected = cosine_similarity(torch.cat([after["state"], after["belief"]], -1), after["goal"], dim=-1)
    else:
        loss = agent.behaviour().loss.reward_loss
        expected = -loss.distance(loss.head(after["state"], after["belief"]), after["goal"]).squeeze(-1)
    torch.testing.assert_close(reward, expected)
    reward[:, -1].sum().backward()
    assert sum(float(p.grad.abs().sum()) for p in agent.actor.parameters()) > 0


def trained(agent: Agent, losses: list[Tensor]) -> set[str]:
    agent.zero_grad()
    sum(losses).backward()  # type: ignore[union-attr]
    behaviour = agent.behaviour()
    parts: dict[str, nn.Module] = {"model": agent.model, "actor": behaviour.actor}
    if behaviour.loss.reward_loss is not None:
        parts |= {"head": behaviour.loss.reward_loss.head, "distance": behaviour.loss.reward_loss.distance}
    return {name for name, part in parts.items() if any(p.grad is not None and p.grad.any() for p in part.parameters())}


@pytest.mark.parametrize("batch_norm", [False, True])
def test_every_loss_of_lexa_temporal_trains_its_own_part(
    make_agent: Any, records: TensorDict, batch_norm: bool
) -> None:
    agent = make_agent("lexa_temporal", {f"{REACH}.reward.batch_norm": batch_norm})
    losses = agent.loss(records)
    expected = {"actor": "actor", "embedding": "head", "temporal_distance": "distance"}
    for name, part in expected.items():
        assert trained(agent, [losses[f"loss_{name}"]]) == {part}, name
    losses = agent.loss(records)
    model = [value for name, value in losses.items() if name.startswith("loss_model")]
    assert trained(agent, model) == {"model"}


def test_what_an_image_alone_shows_is_learnt(make_agent: Any, records: TensorDict) -> None:
    """The position in it, and a latent like that of the whole observation, which itself is left alone."""
    agent = make_agent("lexa_cosine", {f"{REACH}.goal.weight": 3.0, "world_model.lambda_object_position": 50.0})
    losses, after = agent.loss.model_loss(records)
    after = after["next"]
    whole = torch.cat([after["state"], after["belief"]], -1)
    alike = cosine_similarity(after["image_latent"], whole, dim=-1).mean()
    torch.testing.assert_close(losses["loss_model_image_latent"], -3 * alike)
    decoded = agent.model.vector_decoders["object_position"](after["image_latent"])
    torch.testing.assert_close(after["reco_image_units"], decoded)

    def symlog(x: Tensor) -> Tensor:
        return x.sign() * (x.abs() + 1).log()

    error = (symlog(decoded) - symlog(after["object_units"])).square().sum(-1).mean()
    torch.testing.assert_close(losses["loss_model_image_position"], 150 * error)
    losses["loss_model_image_latent"].backward()
    assert agent.model.encoder.cnn is not None
    assert any(p.grad is not None and p.grad.any() for p in agent.model.encoder.cnn.parameters())
    assert not any(p.grad is not None and p.grad.any() for p in agent.model.encoder.mlp.parameters())


def test_other_flat_rows_learn_nothing_of_images_alone(make_agent: Any, records: TensorDict) -> None:
    for name in ("dreamer_pcp", "lexa_temporal"):
        assert ("next", "image_latent") not in make_agent(name).model.records().out_keys
    model = make_agent("lexa_cosine", {"world_model": {"name": "flat", "observed": ["proprio"]}}).model
    assert ("next", "reco_image_units") not in model.records().out_keys


class TestSettings:
    """Each reaches its part."""

    def loss(self, **settings: Any) -> Any:
        row = change(AGENTS["lexa_temporal"], {f"{REACH}.reward.{name}": value for name, value in settings.items()})
        return build_agent(row, reacher_task(), "debug").behaviour().loss.reward_loss

    def test_defaults_are_the_papers(self) -> None:
        loss = self.loss()
        assert [linear.out_features for linear in loss.distance.linears] == [400] * 4
        assert (len(loss.distance.norms), loss.positives, loss.negatives) == (0, 256, 26)

    def test_changes(self) -> None:
        loss = self.loss(layers=3, units=128, batch_norm=True, positives=10, negatives=0.5)
        assert [linear.out_features for linear in loss.distance.linears] == [128] * 3
        assert (len(loss.distance.norms), loss.positives, loss.negatives) == (3, 10, 5)

    def test_learning_rate(self) -> None:
        for rate, expected in ((None, 1e-3), (0.5, 0.5)):
            row = change(AGENTS["lexa_temporal"], {f"{REACH}.reward.lr": rate})
            agent = build_agent(row, reacher_task(), "debug")
            own = {id(p) for p in agent.behaviour().loss.reward_loss.parameters()}
            groups = [group for group in agent.parameter_groups() if {id(p) for p in group["params"]} & own]
            assert [group["lr"] for group in groups] == [expected]
            assert {id(p) for p in groups[0]["params"]} == own

    def test_statistics_are_saved(self) -> None:
        names = build_agent(
            change(AGENTS["lexa_temporal"], {f"{REACH}.reward.batch_norm": True}), reacher_task(), "debug"
        ).state_dict()
        assert any(name.endswith("reward_loss.distance.norms.0.running_mean") for name in names)


def test_hindsight_goals_never_cross_an_episode(make_agent: Any, records: TensorDict) -> None:
    """``records`` has a start at [1, 3]; positions tell frames apart."""
    agent = make_agent("dreamer_pcp", {f"{REACH}.goals": {"name": "future", "mean_offset": 3.0}})
    source = agent.behaviour().loss.goal_source
    assert isinstance(source, FutureGoals)
    assert (source.mean_offset, source.share) == (3.0, 1.0)
    position = agent.model.units(records["next", "object_position"]).squeeze(-2)
    for _ in range(20):
        goals = goals_in_imagination(agent, records)
        for sequence, at, end in ((0, 0, 6), (0, 3, 6), (1, 0, 3), (1, 1, 3), (1, 3, 6)):
            among = (goals[sequence, at] - position[sequence]).abs().amax(-1) < 1e-6
            assert among.sum() == 1
            assert at < int(among.float().argmax()) < end


def test_share_of_hindsight_goals_reaches_the_source(make_agent: Any) -> None:
    agent = make_agent("lexa_temporal", {f"{REACH}.goals": {"name": "future", "share": 0.25}})
    assert agent.behaviour().loss.goal_source.share == 0.25
    assert agent.behaviour().loss.goal_source.mean_offset == 10


@pytest.mark.parametrize("source", ["frames", "future"])
def test_goals_are_frames_that_show_the_object_that_it_is_about(source: str) -> None:
    """If they are about one: an image is a goal whatever it shows."""
    task = Task("x", 16, ("a", "b"), 4, 2, Workspace(low=(-1.0, -1.0), high=(1.0, 1.0)))
    records = random_records(task, 2, 6)
    hidden = records["next", "object_visible"]
    hidden[:, 3:, 0], hidden[:, ::2, 1] = False, False
    for name, changes, index in (
        ("dreamer_pcp", {f"{REACH}.object": "a"}, 0),
        ("dreamer_pcp", {f"{REACH}.object": "b"}, 1),
        ("lexa_temporal", {}, None),
    ):
        row = change(AGENTS[name], {**changes, f"{REACH}.goals": source})
        agent = build_agent(row, task, "debug")
        goals = torch.stack([goals_in_imagination(agent, records) for _ in range(10)]).flatten(0, 2)
        if index is None:
            known = agent.model.encoder.image(records["next", "pixels"])
        else:
            known = records["next", "object_position"][:, :, index]
        chosen = (goals.unsqueeze(1) - known.flatten(0, 1)).abs().amax(-1).argmin(1).unique()
        seen = torch.ones(12, dtype=torch.bool) if index is None else hidden[..., index].flatten()
        assert set(chosen.tolist()) <= set(seen.nonzero().flatten().tolist())
        assert (~seen[chosen]).sum() == 0
        assert len(chosen) == seen.sum() if source == "frames" else len(chosen) > seen.sum() / 2


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("lexa_cosine", {f"{REACH}.goals": "uniform"}, "goals='uniform' draws positions"),
        ("lexa_temporal", {f"{REACH}.goals": "mixed"}, "goals='uniform' draws positions.*use 'frames'"),
        ("lexa_cosine", {f"{REACH}.goal": "image_embedding"}, "compares whole latents: it needs goal='full_latent'"),
        ("dreamer_pcp", {f"{REACH}.reward": "full_latent_cosine"}, "compares whole latents"),
        ("dreamer", {f"{REACH}.reward": "temporal_distance"}, "is a distance to a goal; give the behaviour one"),
        ("focus_lcp", {f"{REACH}.goal": "full_latent"}, "world_model='object' has no image_latent"),
        ("lexa_temporal", {f"{REACH}.reward.units": 0}, "reward.units must be at least 1"),
        ("lexa_temporal", {f"{REACH}.goals": {"name": "future", "mean_offset": 1}}, "mean_offset must be above 1"),
    ],
)
def test_choices_that_do_not_fit(name: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        build_agent(change(AGENTS[name], changes), reacher_task(), "debug")


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("dreamer_pcp", {f"{REACH}.reward": "temporal_distance"}),
        ("focus_lcp", {f"{REACH}.reward": "temporal_distance"}),
        ("focus_pcp", {f"{REACH}": AGENTS["lexa_temporal"].behaviours["reach"]}),
    ],
)
def test_steps_to_goals_of_other_kinds(name: str, changes: dict[str, Any]) -> None:
    """The head predicts which goal a frame would be, whatever goals are made of."""
    agent = build_agent(change(AGENTS[name], changes), reacher_task(), "debug")
    losses = agent.loss(random_records(reacher_task(), 2, 4))
    loss = agent.behaviour().loss
    assert loss.reward_loss.head(torch.zeros(1, 16), torch.zeros(1, 16)).shape[-1] == agent.behaviour().goal.features
    assert losses["loss_embedding"] > 0
    assert trained(agent, [losses["loss_actor"]]) == {"actor"}
