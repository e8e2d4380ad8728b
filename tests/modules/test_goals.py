from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_ocwm.agents import SIZES, Agent, build_agent
from torchrl_ocwm.modules import FrameGoals, GivenGoals, MixedGoals, UnitRMS, WorkspaceUnits
from torchrl_ocwm.modules.rewards import LatentSimilarity
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import STYLES, random_records, reacher_task

UNITS = WorkspaceUnits((-0.2, -0.2), (0.2, 0.2))

MSE = {
    "behaviours.reach.goal.distance": "mse",
    "behaviours.reach.reward": {"name": "latent_similarity", "distance": "mse"},
}


def observation(number: int) -> TensorDict:
    """What a policy sees at the first step of ``number`` episodes."""
    after = random_records(reacher_task(), number, 1)["next"][:, 0]
    first = torch.ones(number, 1, dtype=torch.bool)
    return after.select("pixels", "proprio", "object_position", "goal_position").set("is_init", first)


def test_frame_goals_are_a_permutation_of_the_frames() -> None:
    frames = TensorDict({"frame": torch.arange(60.0).reshape(3, 10, 2)}, [3, 10])
    frames["object_visible"] = torch.ones(3, 10, 1, dtype=torch.bool)
    source = FrameGoals(TensorDictModule(nn.Identity(), ["frame"], [("latent", "goal")]))
    goals = source(frames.clone())["latent", "goal"]
    assert sorted(goals.flatten(0, 1).tolist()) == frames["frame"].flatten(0, 1).tolist()
    assert not torch.equal(goals, frames["frame"])


@pytest.mark.parametrize("index", [0, 1])
def test_hidden_frames_are_no_goals(index: int) -> None:
    """Those that are seen are used equally often, in random order."""
    frames = TensorDict({"frame": torch.arange(12.0).reshape(2, 6, 1)}, [2, 6])
    frames["object_visible"] = torch.zeros(2, 6, 2, dtype=torch.bool)
    frames["object_visible"][..., index] = frames["frame"].squeeze(-1) % 3 == 0
    source = FrameGoals(TensorDictModule(nn.Identity(), ["frame"], [("latent", "goal")]), object_index=index)
    goals = [source(frames.clone())["latent", "goal"].flatten() for _ in range(2)]
    for drawn in goals:
        assert drawn.unique(return_counts=True)[0].tolist() == [0, 3, 6, 9]
        assert drawn.unique(return_counts=True)[1].tolist() == [3, 3, 3, 3]
    assert not torch.equal(*goals)


@pytest.mark.parametrize("key", [None, "object_visible"])
def test_all_frames_are_goals_if_none_or_nobody_says_more(key: Any) -> None:
    frames = TensorDict({"frame": torch.arange(12.0).reshape(2, 6, 1)}, [2, 6])
    frames["object_visible"] = torch.zeros(2, 6, 1, dtype=torch.bool)
    source = FrameGoals(TensorDictModule(nn.Identity(), ["frame"], [("latent", "goal")]), object_visible=key)
    assert sorted(source(frames)["latent", "goal"].flatten().tolist()) == list(range(12))


@pytest.mark.parametrize("source", ["frames", "mixed"])
@pytest.mark.parametrize("name", ["dreamer_pcp", "focus_lcp"])
def test_an_agent_has_no_goals_that_nobody_saw(make_agent: Any, records: TensorDict, name: str, source: str) -> None:
    records["next", "object_visible"][:, 3:] = False
    agent = make_agent(name, {"behaviours.reach.goals": source})
    after = agent.loss.model_loss(records.select(*agent.loss.in_keys))[1]["next"]
    goals = agent.behaviour().loss.imagination_start(after)["latent", "goal"]
    known = UnitRMS()(after["image_latent"][:, :, 0]) if name == "focus_lcp" else after["object_units"]
    among = (goals.unsqueeze(1) == known[:, 3:].flatten(0, 1)).all(-1).any(1)
    seen = (goals.unsqueeze(1) == known[:, :3].flatten(0, 1)).all(-1).any(1)
    assert not among.any()
    assert seen.any()


def test_mixed_goals_choose_for_each_element() -> None:
    zeros, ones = (TensorDictModule(like, ["x"], [("latent", "goal")]) for like in (torch.zeros_like, torch.ones_like))
    goals = MixedGoals(zeros, ones, share=0.25)(TensorDict({"x": torch.rand(4000, 3)}, [4000]))["latent", "goal"]
    assert (goals.std(-1) == 0).all()  # never half of one and half of the other
    assert goals[:, 0].mean() == pytest.approx(0.25, abs=0.03)


@pytest.mark.parametrize("source", ["uniform", "frames", "mixed"])
@pytest.mark.parametrize("name", ["dreamer_pcp", "focus_pcp", "focus_lcp"])
def test_where_goals_come_from(make_agent: Any, records: TensorDict, name: str, source: str) -> None:
    agent = make_agent(name, {"behaviours.reach.goals": source})
    _, after = agent.loss.model_loss(records)
    goals = agent.behaviour().loss.imagination_start(after["next"])["latent", "goal"]
    key = "image_latent" if name == "focus_lcp" else "object_units"
    known = after["next", key].flatten(0, 1)
    known = UnitRMS()(known[:, 0]) if name == "focus_lcp" else known
    among = (goals.unsqueeze(1) == known).all(-1).any(1)
    assert not goals.requires_grad
    assert among.all() if source == "frames" else not among.any() if source == "uniform" else among.any()


def test_positions_of_the_environment_count_when_nothing_is_given() -> None:
    goals = GivenGoals(UNITS, nn.Identity())(TensorDict({"goal_position": torch.tensor([[0.1, -0.2]])}, [1]))
    torch.testing.assert_close(goals["latent", "goal"], torch.tensor([[0.5, -1.0]]))


def test_a_given_position_wins_over_that_of_the_environment() -> None:
    data = TensorDict({"goal_position": torch.zeros(1, 2), "goal": {"position": torch.tensor([[0.1, -0.2]])}}, [1])
    torch.testing.assert_close(GivenGoals(UNITS, nn.Identity())(data)["latent", "goal"], torch.tensor([[0.5, -1.0]]))


@pytest.mark.parametrize(
    ("goal", "image", "message"),
    [
        ({"pixels": torch.zeros(2, 3, 4, 4)}, None, "takes goals as positions"),
        ({"pixels": torch.zeros(2, 3, 4)}, nn.Identity(), r"goal images are \[\*batch"),
        ({}, nn.Identity(), "has neither"),
    ],
)
def test_goals_that_are_not_understood(goal: dict[str, Any], image: nn.Module | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GivenGoals(UNITS, nn.Identity(), image)(TensorDict({"goal": TensorDict(goal, [2])}, [2]))


@pytest.mark.usefixtures("no_noise")
def test_policy_takes_position_or_image_for_each_environment(make_agent: Any) -> None:
    policy = make_agent("focus_lcp").policy()
    images = random_records(reacher_task(), 4, 1, seed=1)["next", "pixels"][:, 0]
    positions = torch.tensor([[0.1, 0.1], [-0.1, 0.1], [0.1, -0.1], [0.0, 0.1]])

    def goal(**given: torch.Tensor) -> torch.Tensor:
        return policy(observation(4).set("goal", TensorDict(given, [4])))["latent", "goal"]

    of_positions, of_images = goal(position=positions), goal(pixels=images)
    some = positions.clone()
    some[[1, 3]] = torch.nan
    mixed = goal(position=some, pixels=images)
    torch.testing.assert_close(mixed[[0, 2]], of_positions[[0, 2]])
    torch.testing.assert_close(mixed[[1, 3]], of_images[[1, 3]])
    assert not torch.allclose(of_positions, of_images)


@pytest.mark.usefixtures("no_noise")
def test_an_image_is_encoded_as_in_training(make_agent: Any, records: TensorDict) -> None:
    agent = make_agent("focus_lcp")
    trained = agent.loss.model_loss(records)[1]["next", "image_latent"][:, :4].flatten(0, 1)[:, 0]
    images = records["next", "pixels"][:, :4].flatten(0, 1)
    acting = agent.policy()(observation(8).set("goal", TensorDict({"pixels": images}, [8])))["latent", "goal"]
    torch.testing.assert_close(acting, UnitRMS()(trained))


def goals_of_every_kind(agent: Agent, records: TensorDict) -> dict[str, torch.Tensor]:
    """The goal latents that reach the actor: of a policy's positions and images, and in imagination."""
    images = records["next", "pixels"].flatten(0, 1)
    number, seen = len(images), []
    hook = agent.actor[0].module.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[2]))
    policy = agent.policy()
    policy(observation(number))
    policy(observation(number).set("goal", TensorDict({"pixels": images}, [number])))
    agent.actor(agent.behaviour().loss.imagination_start(agent.loss.model_loss(records)[1]["next"]))
    hook.remove()
    return dict(zip(("position", "image", "imagination"), seen, strict=True))


@pytest.mark.parametrize("source", ["uniform", "frames", "mixed"])
def test_goal_latents_of_every_kind_have_one_length(make_agent: Any, records: TensorDict, source: str) -> None:
    agent = make_agent("focus_lcp", {"behaviours.reach.goals": source})
    with torch.no_grad():  # the two encoders need not agree
        agent.model.positional_encoder.mlp.model[-1].weight.mul_(5)
    goals = goals_of_every_kind(agent, records)
    for kind, goal in goals.items():
        length = torch.full(goal.shape[:-1], goal.shape[-1] ** 0.5)
        torch.testing.assert_close(goal.norm(dim=-1), length, msg=kind)
        assert goal.std(0).max() > 0.01  # directions are kept


@pytest.mark.parametrize("distance", ["cosine", "chord"])
def test_rewards_do_not_see_the_length_of_a_goal(distance: Any) -> None:
    latents, goal = torch.randn(5, 2, 4), torch.randn(5, 4)
    reward = LatentSimilarity(distance=distance)
    torch.testing.assert_close(reward(latents, goal), reward(latents, UnitRMS()(goal)))


def test_lengths_stay_where_training_and_reward_compare_them(make_agent: Any, records: TensorDict) -> None:
    agent = make_agent(
        "focus_lcp",
        {
            "behaviours.reach.goal.distance": "mse",
            "behaviours.reach.reward": {"name": "latent_similarity", "distance": "mse"},
        },
    )
    goals = goals_of_every_kind(agent, records)
    metres = observation(len(goals["position"]))["goal_position"]
    encoded = agent.model.positional_encoder(agent.model.units(metres).unsqueeze(-2))[:, 0]
    torch.testing.assert_close(goals["position"], encoded)
    for kind, goal in goals.items():
        assert goal.norm(dim=-1).std() > 0.01, kind


@pytest.mark.usefixtures("no_noise")
@pytest.mark.parametrize("style", ["dreamer_v3", "dreamer_v2"])
def test_goal_images_in_floating_point(style: Any) -> None:
    policy = build_agent("focus_lcp", reacher_task(), change(SIZES["debug"], STYLES[style])).policy()
    image = random_records(reacher_task(), 4, 1, seed=1)["next", "pixels"][:, 0]
    goals = [
        policy(observation(4).set("goal", TensorDict({"pixels": pixels}, [4])))["latent", "goal"]
        for pixels in (image, image.float() / 255, image.double() / 255)
    ]
    torch.testing.assert_close(goals[1], goals[0])
    torch.testing.assert_close(goals[2], goals[0])


@pytest.mark.usefixtures("no_noise")
def test_several_images_are_taken_in_one_after_the_other(make_agent: Any) -> None:
    model = make_agent("focus_lcp").model
    images = random_records(reacher_task(), 2, 3)["next", "pixels"]
    state, belief = torch.zeros(2, model.state), torch.zeros(2, model.belief)
    for image in images.unbind(1):
        belief = model.prior._update_belief(state, belief, torch.zeros(2, model.action))
        state = model.posterior(belief, model.encoder(image))[1]
    torch.testing.assert_close(model.latents_in_images()(images), model.extractor(state, belief))
    assert not torch.allclose(model.latents_in_images()(images[:, :1]), model.latents_in_images()(images))
