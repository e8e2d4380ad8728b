from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.objectives import DreamerV3ModelLoss, symlog

from torchrl_ocwm.agents import AGENTS, SIZES, build_agent
from torchrl_ocwm.objectives import WeightedModelLoss
from torchrl_ocwm.objectives.world_model import image_reconstruction, symlog_reconstruction
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import STYLES, reacher_task

VECTORS = ("proprio", "object_units", "goal_units")


def torchrl_loss(world_model: TensorDictModule) -> DreamerV3ModelLoss:
    loss = DreamerV3ModelLoss(
        world_model,
        lambda_continue=1.0,
        kl_mode="separate",
        unimix=0.01,
        reco_symlog=[False, True, True, True],
        detach_output=False,
    )
    loss.set_keys(pixels=["pixels", *VECTORS], reco_pixels=["reco_pixels", *(f"reco_{name}" for name in VECTORS)])
    return loss


def test_sums_to_torchrls_loss(make_agent: Any, records: TensorDict) -> None:
    world_model = make_agent("dreamer").model.records()
    torch.manual_seed(1)
    ours, _ = WeightedModelLoss(world_model)(records)
    torch.manual_seed(1)
    theirs, _ = torchrl_loss(world_model)(records)
    parts = ("pixels", "proprio", "object_position", "goal_position")
    torch.testing.assert_close(sum(ours[f"loss_model_{part}"] for part in parts), theirs["loss_model_reco"].squeeze())
    for name in ("dynamic", "representation", "reward", "continue"):
        torch.testing.assert_close(ours[f"loss_model_{name}"], theirs[f"loss_model_{name}"].squeeze())


def test_each_weight_scales_its_own_loss(make_agent: Any, records: TensorDict) -> None:
    world_model = make_agent("dreamer").model.records()

    def losses(**weights: float) -> TensorDict:
        torch.manual_seed(1)
        return WeightedModelLoss(world_model, **weights)(records)[0]

    plain = losses()
    for name in plain.keys():
        part = name.removeprefix("loss_model_")
        before = 0.1 if part == "representation" else 1.0
        scaled = losses(**{f"lambda_{part}": 7.0})
        torch.testing.assert_close(scaled[name], plain[name] * 7 / before)
        for other in set(plain.keys()) - {name}:
            torch.testing.assert_close(scaled[other], plain[other])


@pytest.mark.parametrize(
    "part", ["pixels", "proprio", "object_position", "goal_position", "reward", "continue", "dynamic", "representation"]
)
def test_gradients(make_agent: Any, records: TensorDict, part: str) -> None:
    """Each loss alone reaches its own head and the RSSM, and no other head."""
    agent = make_agent("dreamer")
    losses, _ = WeightedModelLoss(agent.model.records(), free_nats=0.0)(records)
    losses[f"loss_model_{part}"].backward()
    reached = {
        name.split(".")[0] if not name.startswith("vector_decoders") else name.split(".")[1]
        for name, parameter in agent.model.named_parameters()
        if parameter.grad is not None and parameter.grad.abs().sum() > 0
    }
    heads = {"pixels": "image_decoder", "reward": "reward_head", "continue": "continue_head"}
    expected = {"prior", "posterior", "encoder"}
    if part not in ("dynamic", "representation"):
        expected.add(heads.get(part, part))
    if part == "dynamic":  # the posterior is the target: it learns only through the states it led to
        assert {"prior"} <= reached <= expected
    else:
        assert reached == expected


def test_a_missing_prediction_is_left_out(make_agent: Any, records: TensorDict) -> None:
    losses, _ = WeightedModelLoss(make_agent("dreamer_pcp").model.records())(records)
    assert not {"loss_model_goal_position", "loss_model_reward"} & set(losses.keys())


def test_free_nats_act_on_each_step() -> None:
    """Two steps, one with no KL and one with ln 2: with one free nat each counts as one."""
    logits = torch.tensor([[[[0.0, 0.0]], [[50.0, -50.0]]]])
    prior = torch.zeros(1, 2, 1, 2)
    model = TensorDictModule(
        lambda x: (x, prior), in_keys=["logits"], out_keys=[("next", "posterior_logits"), ("next", "prior_logits")]
    )
    records = TensorDict({"logits": logits, "next": {}}, [1, 2])
    loss, _ = WeightedModelLoss(model, free_nats=1.0, unimix=0.0)(records)
    torch.testing.assert_close(loss["loss_model_dynamic"], torch.tensor(1.0))
    loss, _ = WeightedModelLoss(model, free_nats=0.0, unimix=0.0)(records)
    torch.testing.assert_close(loss["loss_model_dynamic"], torch.tensor(2.0).log() / 2)


def test_set_keys_nested(make_agent: Any, records: TensorDict) -> None:
    model = make_agent("dreamer").model
    torch.manual_seed(1)
    expected, _ = WeightedModelLoss(model.records())(records)
    rename = TensorDictModule(nn.Identity(), [("next", "reco_proprio")], [("next", "predicted", "proprio")])
    moved = records.clone()
    moved["next", "reward_of", "task"] = moved["next"].pop("reward")
    loss = WeightedModelLoss(TensorDictSequential(model.records(), rename))
    loss.set_keys(reward=("reward_of", "task"), reco_proprio=("predicted", "proprio"))
    torch.manual_seed(1)
    losses, _ = loss(moved)
    for name, value in expected.items():
        torch.testing.assert_close(losses[name], value)


def test_the_batch_is_left_alone(make_agent: Any, records: TensorDict) -> None:
    before = records.clone()
    WeightedModelLoss(make_agent("dreamer").model.records())(records)
    assert (records == before).all()
    assert set(records.keys(True, True)) == set(before.keys(True, True))


def test_a_missing_key_is_named(make_agent: Any, records: TensorDict) -> None:
    del records["next", "proprio"]
    with pytest.raises(KeyError, match=r"lacks next.proprio, which the world model reads.*it has action, is_init,"):
        WeightedModelLoss(make_agent().model.records())(records)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        (("next", "pixels"), torch.zeros(2, 6, 3, 32, 32, dtype=torch.uint8), r"\(3, 64, 64\)\), got \(.*3, 32, 32\)"),
        (("next", "proprio"), torch.zeros(2, 6, 4), r"vectors of 7 values in all"),
        (("next", "object_position"), torch.zeros(2, 6, 1, 3), r"positions have 2 coordinates here, got shape"),
    ],
)
def test_wrong_shapes(make_agent: Any, records: TensorDict, key: Any, value: torch.Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WeightedModelLoss(make_agent().model.records())(records.set(key, value))


def test_reconstructions_by_hand() -> None:
    target = torch.tensor([[[[255, 0]]]], dtype=torch.uint8)
    torch.testing.assert_close(image_reconstruction(torch.tensor([[[[0.5, 0.25]]]]), target), torch.tensor(0.3125))
    prediction, target = torch.tensor([[1.0, 0.0]]), torch.tensor([[-1.0, 0.0]])
    torch.testing.assert_close(symlog_reconstruction(prediction, target), torch.tensor(2.0).log().mul(2).square())


@pytest.mark.parametrize("name", AGENTS)
def test_in_keys_are_what_is_read(make_agent: Any, records: TensorDict, name: str) -> None:
    """All of them are needed, and no other."""
    loss = make_agent(name).loss.model_loss
    records["next", "reward"] += 3.0  # not what the fresh reward head predicts
    torch.manual_seed(1)
    expected, _ = loss(records)
    torch.manual_seed(1)
    got, _ = loss(records.select(*loss.in_keys))
    for key, value in expected.items():
        torch.testing.assert_close(got[key], value)
    assert list(expected.keys()) == loss.out_keys
    for key in loss.in_keys:
        name = key if isinstance(key, str) else ".".join(key)
        with pytest.raises(KeyError, match=f"the batch lacks {name}, which the world model reads"):
            loss(records.exclude(key))


def test_the_recorded_reward_is_the_target(make_agent: Any, records: TensorDict) -> None:
    """Not the predicted one, which the world model writes in its place."""
    loss = make_agent("dreamer").loss.model_loss
    values = []
    for reward in (0.0, 5.0):
        torch.manual_seed(1)
        values.append(loss(records.clone().set(("next", "reward"), torch.full((2, 6, 1), reward)))[0])
    assert (values[0]["loss_model_reward"] - values[1]["loss_model_reward"]).abs() > 1e-3


@pytest.mark.parametrize("name", ["dreamer_pcp", "focus_pcp"])
def test_positions_of_hidden_objects_are_no_targets(make_agent: Any, records: TensorDict, name: str) -> None:
    """They are old: the object is where it was last seen."""
    loss = make_agent(name).loss.model_loss
    records["next", "object_visible"][0, 2] = False
    torch.manual_seed(1)
    losses, after = loss(records)
    after = after["next"]
    error = symlog(after["reco_object_units"]) - symlog(after["object_units"])
    error[0, 2] = 0
    torch.testing.assert_close(losses["loss_model_object_position"], 200 * error.square().sum() / 12)


@pytest.mark.parametrize("true", [1, 255])
@pytest.mark.parametrize("name", ["dreamer", "focus_lcp"])
def test_flags_as_integers(make_agent: Any, records: TensorDict, name: str, true: int) -> None:
    records["next", "object_visible"][0, :3] = False
    loss, as_integers = make_agent(name).loss.model_loss, records.clone()
    for key in ("masks", "object_visible", "terminated"):
        as_integers["next", key] = as_integers["next", key].to(torch.uint8) * true
    torch.manual_seed(1)
    expected, _ = loss(records)
    torch.manual_seed(1)
    got, _ = loss(as_integers)
    for key, value in expected.items():
        torch.testing.assert_close(got[key], value)


@pytest.mark.parametrize("key", ["masks", "object_visible", "terminated"])
def test_flags_as_floating_point_are_refused(make_agent: Any, records: TensorDict, key: str) -> None:
    records["next", key] = records["next", key].float()
    with pytest.raises(TypeError, match=rf"{key} must be bool, or integers .* got torch.float32, use {key} > 0.5"):
        make_agent("focus_pcp").loss.model_loss(records)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("style", ["dreamer_v3", "dreamer_v2"])
@pytest.mark.parametrize("name", ["dreamer_pcp", "focus_lcp"])
def test_images_in_floating_point(records: TensorDict, name: str, style: Any, dtype: torch.dtype) -> None:
    """0.5 in floating point is what 127.5 would be in uint8, for every network and loss that sees an image."""
    loss = build_agent(name, reacher_task(), change(SIZES["debug"], STYLES[style])).loss.model_loss
    torch.manual_seed(1)
    expected, _ = loss(records)
    records["next", "pixels"] = records["next", "pixels"].to(dtype) / 255
    torch.manual_seed(1)
    got, _ = loss(records)
    for key, value in expected.items():
        torch.testing.assert_close(got[key], value, rtol=1e-4, atol=1e-5)


def test_a_weight_without_its_term_is_refused(make_agent: Any, records: TensorDict) -> None:
    world_model = make_agent("dreamer_pcp").model.records()
    with pytest.raises(ValueError, match=r"lambda_goal_position does nothing.*not write next.reco_goal_units"):
        WeightedModelLoss(world_model, lambda_goal_position=9.0)(records)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"reco_proprio": "reco_propio"},
            r"reco_proprio='reco_propio'.*does not write next.reco_propio; it writes.*next.reco_pixels",
        ),
        ({"posterior_logits": "logits"}, "does not write next.logits"),
        ({"reco_goal_position": ("a", "b")}, "does not write next.a.b"),
        ({"true_reward": "reward"}, "WeightedModelLoss does not use the key 'true_reward'"),
    ],
)
def test_keys_that_would_do_nothing(make_agent: Any, keys: Any, message: str) -> None:
    loss = WeightedModelLoss(make_agent("dreamer_pcp").model.records())
    with pytest.raises(ValueError, match=message):
        loss.set_keys(**keys)


def test_a_mistyped_target_is_named(make_agent: Any, records: TensorDict) -> None:
    loss = WeightedModelLoss(make_agent("dreamer_pcp").model.records())
    loss.set_keys(proprio="propio")
    with pytest.raises(KeyError, match=r"lacks next.propio, which the world model reads or learns to predict"):
        loss(records)


@pytest.mark.parametrize("name", AGENTS)
def test_everything_can_be_printed(make_agent: Any, name: str) -> None:
    agent = make_agent(name)
    for part in (*agent.modules(), agent.policy()):
        assert type(part).__name__ in repr(part)
    assert f"out_keys={agent.loss.out_keys}" in repr(agent)
