from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_ocwm.agents import SIZES, build_agent
from torchrl_ocwm.modules import UnitRMS
from torchrl_ocwm.objectives import (
    AnnealedWeight,
    FOCUSModelLoss,
    mask_nll,
    object_reconstruction,
    positional_latent_loss,
)
from torchrl_ocwm.objectives.world_model import visible_position_reconstruction
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import STYLES, reacher_task


@pytest.fixture
def scene() -> dict[str, torch.Tensor]:
    masks = torch.zeros(2, 2, 4, 5, dtype=torch.bool)
    masks[0, 0, :2] = True
    masks[0, 1, 1:3, :2] = True  # overlaps the first object, which goes before it
    masks[1, 1, 0] = True  # the first object is hidden
    return {
        "masks": masks,
        "logits": torch.randn(2, 3, 4, 5),
        "colours": torch.rand(2, 3, 3, 4, 5),
        "pixels": torch.randint(0, 256, (2, 3, 4, 5), dtype=torch.uint8),
    }


def instance(masks: torch.Tensor, batch: int, row: int, column: int) -> int:
    for index in range(masks.shape[1]):
        if masks[batch, index, row, column]:
            return index
    return masks.shape[1]


def test_mask_nll_pixel_by_pixel(scene: dict[str, torch.Tensor]) -> None:
    total = 0.0
    for batch in range(2):
        for row in range(4):
            for column in range(5):
                logits = scene["logits"][batch, :, row, column].tolist()
                true = instance(scene["masks"], batch, row, column)
                total -= math.log(math.exp(logits[true]) / sum(map(math.exp, logits)))
    assert float(mask_nll(scene["logits"], scene["masks"])) == pytest.approx(total / 2, rel=1e-5)


def test_object_reconstruction_pixel_by_pixel(scene: dict[str, torch.Tensor]) -> None:
    total = 0.0
    for batch in range(2):
        for row in range(4):
            for column in range(5):
                true = instance(scene["masks"], batch, row, column)
                for channel in range(3):
                    seen = int(scene["pixels"][batch, channel, row, column]) / 255
                    total += (float(scene["colours"][batch, true, channel, row, column]) - seen) ** 2
    got = float(object_reconstruction(scene["colours"], scene["pixels"], scene["masks"]))
    assert got == pytest.approx(total / 2, rel=1e-5)


def test_hidden_objects_add_nothing(scene: dict[str, torch.Tensor]) -> None:
    """No colour outside its mask, no position while hidden, and finite gradients."""
    colours = scene["colours"].clone().requires_grad_()
    object_reconstruction(colours, scene["pixels"], scene["masks"]).backward()
    assert colours.grad[1, 0].abs().max() == 0
    assert colours.grad[1, 1].abs().max() > 0
    position = torch.tensor([[1.0, 1.0, 2.0, 2.0]], requires_grad=True)
    visible_position_reconstruction(position, torch.zeros(1, 4), torch.tensor([[False, True]])).backward()
    assert position.grad[0, :2].abs().max() == 0
    assert position.grad[0, 2:].abs().min() > 0


def test_everything_hidden_is_finite(make_agent: Any, records: TensorDict) -> None:
    records["next", "masks"].zero_()
    records["next", "object_visible"].zero_()
    agent = make_agent("focus_lcp")
    losses, _ = agent.loss.model_loss(records)
    sum(losses.values()).backward()
    assert losses["loss_model_object_position"] == 0
    assert losses["loss_model_positional"] == 0
    assert all(parameter.grad.isfinite().all() for parameter in agent.model.parameters() if parameter.grad is not None)


@pytest.mark.parametrize("distance", ["cosine", "mse"])
def test_positional_loss_object_by_object(distance: Any) -> None:
    predicted, extracted = torch.randn(4, 2, 3), torch.randn(4, 2, 3)
    visible = torch.tensor([[True, False], [True, True], [False, False], [True, True]])
    total = 0.0
    for i in range(4):
        for j in range(2):
            if visible[i, j]:
                a, b = predicted[i, j], extracted[i, j]
                cosine = float((a * b).sum()) / math.sqrt(float((a * a).sum()) * float((b * b).sum()))
                total += -cosine if distance == "cosine" else float(((a - b) ** 2).sum()) / 3
    got = positional_latent_loss(predicted, extracted, visible, distance=distance)
    assert float(got) == pytest.approx(total / 4, rel=1e-5)


@pytest.mark.parametrize(("gradient", "sides"), [("encoder", "p"), ("latent", "e"), ("both", "pe")])
def test_positional_loss_trains_the_chosen_side(gradient: Any, sides: str) -> None:
    predicted, extracted = (torch.randn(4, 1, 3, requires_grad=True) for _ in range(2))
    positional_latent_loss(predicted, extracted, torch.ones(4, 1, dtype=torch.bool), gradient=gradient).backward()
    assert (predicted.grad is not None) == ("p" in sides)
    assert (extracted.grad is not None) == ("e" in sides)


@pytest.mark.parametrize("setting", ["distance", "gradient"])
def test_positional_loss_refuses_what_it_does_not_know(setting: str) -> None:
    latent, visible = torch.randn(4, 1, 3), torch.ones(4, 1, dtype=torch.bool)
    with pytest.raises(ValueError, match=f"{setting} must be one of .*, got 'other'"):
        positional_latent_loss(latent, latent, visible, **{setting: "other"})  # type: ignore[arg-type]


def moved(module: nn.Module) -> bool:
    return any(float(p.grad.abs().sum()) > 0 for p in module.parameters() if p.grad is not None)


def reached(agent: Any) -> set[str]:
    return {name for name, child in agent.model.named_children() if moved(child)}


BODY = {"encoder", "prior", "posterior", "extractor"}


@pytest.mark.parametrize(
    ("gradient", "parts"),
    [("encoder", {"positional_encoder"}), ("latent", BODY), ("both", BODY | {"positional_encoder"})],
)
def test_l_pos_moves_what_it_should_and_nothing_else(
    make_agent: Any, records: TensorDict, gradient: str, parts: set[str]
) -> None:
    agent = make_agent("focus_lcp", {"behaviours.reach.goal.gradient": gradient})
    agent.loss.model_loss(records)[0]["loss_model_positional"].backward()
    assert reached(agent) == parts


@pytest.mark.parametrize(("part", "parts"), [("latent", BODY), ("position", BODY | {"position_decoder"})])
def test_what_images_alone_train(make_agent: Any, records: TensorDict, part: str, parts: set[str]) -> None:
    agent = make_agent("focus_lcp")
    agent.loss.model_loss(records)[0][f"loss_model_image_{part}"].backward()
    assert reached(agent) == parts
    assert not moved(agent.model.encoder.mlp)  # no vectors


@pytest.mark.usefixtures("no_noise")
def test_image_losses_frame_by_frame(make_agent: Any, records: TensorDict) -> None:
    agent = make_agent("focus_lcp", {"world_model.lambda_object_position": 7.0})
    records["next", "object_visible"][1, 2] = False
    losses, after = agent.loss.model_loss(records)
    model, latents, positions = agent.model, [], []
    for frame in range(12):
        where = divmod(frame, 6)
        embedding = model.encoder(records["next", "pixels"][where][None])  # zeros for the vectors
        belief = model.prior._update_belief(*(torch.zeros(1, n) for n in (model.state, model.belief, model.action)))
        latent = model.extractor(model.posterior(belief, embedding)[1], belief)[0]
        torch.testing.assert_close(after["next", "image_latent"][where], latent)
        if where != (1, 2):
            target = after["next", "object_latent"][where][0]
            latents.append(-torch.dot(latent[0], target) / latent[0].norm() / target.norm())
            true = records["next", "object_position"][where][0] / 0.24
            symlog = [torch.sign(x) * torch.log(1 + x.abs()) for x in (model.position_decoder.mlp(latent[0]), true)]
            positions.append((symlog[0] - symlog[1]).square().sum())
    torch.testing.assert_close(losses["loss_model_image_latent"], torch.stack(latents).sum() / 12)
    torch.testing.assert_close(losses["loss_model_image_position"], 7 * torch.stack(positions).sum() / 12)


@pytest.mark.parametrize("name", ["focus", "focus_pcp", "focus_lcp"])
def test_policy_losses_leave_model_and_encoder_alone(make_agent: Any, records: TensorDict, name: str) -> None:
    agent = make_agent(name)
    losses = agent.loss(records)
    (losses["loss_actor"] + losses["loss_value"]).backward()
    assert not moved(agent.model)
    assert moved(agent.actor)


@pytest.mark.parametrize("part", ["masks", "object_pixels", "object_position"])
def test_object_terms_train_the_rssm(make_agent: Any, records: TensorDict, part: str) -> None:
    agent = make_agent("focus")
    agent.loss.model_loss(records)[0][f"loss_model_{part}"].backward()
    assert reached(agent) == BODY | {"position_decoder" if part == "object_position" else "object_decoder"}


def test_latent_reward_teaches_the_actor_through_the_dynamics(make_agent: Any, records: TensorDict) -> None:
    agent = make_agent("focus_lcp")
    latent = agent.model.records()(records)["next"].select("state", "belief")
    start = agent.behaviour().loss.imagination_start(latent)
    rollout = agent.imagination.rollout(3, agent.actor, auto_reset=False, tensordict=start, break_when_any_done=False)
    rollout["next", "reward"][:, -1].sum().backward()
    assert moved(agent.actor)


def test_goal_latents_are_encoded_positions(make_agent: Any, records: TensorDict) -> None:
    agent = make_agent("focus_lcp")
    latent = agent.model.records()(records)["next"].select("state", "belief")
    start = agent.behaviour().loss.imagination_start(latent)
    goals = agent.model.positional_encoder(start["goal_units"].unsqueeze(-2))[:, 0]
    torch.testing.assert_close(start["latent", "goal"], UnitRMS()(goals))
    assert not start["latent", "goal"].requires_grad


def test_weights_and_keys(make_agent: Any, records: TensorDict) -> None:
    world_model = make_agent("focus_lcp").model.records()

    def losses(loss: FOCUSModelLoss, batch: TensorDict = records) -> TensorDict:
        torch.manual_seed(1)
        return loss(batch)[0]

    plain = losses(FOCUSModelLoss(world_model))
    for part in ("masks", "object_pixels", "positional", "object_position"):
        scaled = losses(FOCUSModelLoss(world_model, **{f"lambda_{part}": 3.0}))
        torch.testing.assert_close(scaled[f"loss_model_{part}"], 3 * plain[f"loss_model_{part}"])
    nested = FOCUSModelLoss(world_model)
    nested.set_keys(masks=("seen", "masks"), object_visible=("seen", "flag"))
    batch = records.clone()
    batch["next", "seen"] = {"masks": batch["next"].pop("masks"), "flag": batch["next"].pop("object_visible")}
    got = losses(nested, batch)
    for name, value in plain.items():
        torch.testing.assert_close(got[name], value)


@pytest.mark.parametrize(
    ("weight", "scaled"),
    [
        ("image_latent", {"image_latent", "image_position"}),
        ("object_position", {"object_position", "image_position"}),
    ],
)
def test_weights_of_images_alone(make_agent: Any, records: TensorDict, weight: str, scaled: set[str]) -> None:
    world_model = make_agent("focus_lcp").model.records()
    losses = []
    for value in (1.0, 3.0):
        torch.manual_seed(1)
        losses.append(FOCUSModelLoss(world_model, **{f"lambda_{weight}": value})(records)[0])
    for name, before in losses[0].items():
        factor = 3 if name.removeprefix("loss_model_") in scaled else 1
        torch.testing.assert_close(losses[1][name], factor * before)


@pytest.mark.parametrize("distance", ["cosine", "mse"])
def test_the_distance_reaches_what_encodes_goals(make_agent: Any, records: TensorDict, distance: Any) -> None:
    loss = FOCUSModelLoss(make_agent("focus_lcp").model.records(), positional_distance=distance)
    records["next", "object_visible"][0, 1] = False
    losses, after = loss(records)
    after = after["next"]
    latent, visible = after["object_latent"][..., :-1, :], after["object_visible"]
    for name, goal in (
        ("positional", after["positional_latent"]),
        ("image_latent", after["image_latent"][..., :-1, :]),
    ):
        expected = positional_latent_loss(goal, latent, visible, distance=distance)
        torch.testing.assert_close(losses[f"loss_model_{name}"], expected)


@pytest.mark.parametrize("settings", [(0.0, 1.0, 3), (1.0, 0.0, 3), (1.0, 2.0, 0)])
def test_a_weight_that_cannot_move(settings: tuple[float, float, int]) -> None:
    with pytest.raises(ValueError, match="moves between values above 0"):
        AnnealedWeight(*settings)


def test_an_annealed_weight_by_hand(make_agent: Any, records: TensorDict) -> None:
    """100, 100 · 10^(−2/3) … over three updates, and 1 from then on; what is evaluated is no update."""
    world_model = make_agent("focus_lcp").model.records()
    once = FOCUSModelLoss(world_model, lambda_positional=1.0)
    loss = FOCUSModelLoss(world_model, lambda_positional=100.0, positional_annealing=(1.0, 3))

    def weight() -> float:
        values = []
        for one in (once, loss):
            torch.manual_seed(1)
            values.append(one(records)[0]["loss_model_positional"])
        return (values[1] / values[0]).item()

    expected = [100.0, 100 ** (2 / 3), 100 ** (1 / 3), 1.0, 1.0]
    loss.train()
    first = [weight(), weight()]
    loss.eval()
    assert [weight(), weight()] == pytest.approx([expected[2]] * 2, rel=1e-4)
    again = FOCUSModelLoss(world_model, lambda_positional=100.0, positional_annealing=(1.0, 3))
    again.load_state_dict(loss.state_dict())
    loss = again.train()
    assert [*first, weight(), weight(), weight()] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"lambda_pixels": 0.0}, "lambda_pixels does nothing: FOCUSModelLoss has the terms .*object_pixels"),
        ({"lambda_positional": 1.0}, "lambda_positional does nothing.*not write next.positional_latent"),
        ({"lambda_image_latent": 1.0}, "lambda_image_latent does nothing.*not write next.image_latent"),
        ({"positional_distance": "cosine"}, "positional_distance does nothing"),
        ({"positional_gradient": "both"}, "positional_gradient does nothing"),
        ({"positional_annealing": (1.0, 5)}, "positional_annealing does nothing"),
        ({"positional_distance": "cos"}, "positional_distance must be one of 'cosine', 'mse', got 'cos'"),
        ({"positional_gradient": "all"}, "positional_gradient must be one of 'encoder', 'latent', 'both', got 'all'"),
    ],
)
def test_settings_that_would_do_nothing(make_agent: Any, records: TensorDict, settings: Any, message: str) -> None:
    world_model = make_agent("focus_pcp").model.records()
    with pytest.raises(ValueError, match=message):
        FOCUSModelLoss(world_model, **settings)(records)


def test_keys_of_the_whole_image_are_not_used(make_agent: Any) -> None:
    with pytest.raises(ValueError, match="FOCUSModelLoss does not use the key 'reco_pixels'"):
        make_agent("focus_pcp").loss.model_loss.set_keys(reco_pixels="reco_pixels")


@pytest.mark.parametrize("name", ["focus", "focus_pcp", "focus_lcp"])
def test_update_with_the_layers_of_the_paper(records: TensorDict, name: str) -> None:
    size = change(SIZES["debug"], STYLES["dreamer_v2"])
    agent = build_agent(name, reacher_task(), size)
    losses = agent.loss(records)
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    assert {part for part, child in agent.model.named_children() if not moved(child)} <= {"two_hot", "units"}
