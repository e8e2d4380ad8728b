from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.model_based import DreamerEnv
from torchrl.modules import IndependentNormal, WorldModelWrapper
from torchrl.objectives import DreamerV3ActorLoss, DreamerV3Loss, DreamerV3ValueLoss, ValueEstimators

from torchrl_ocwm.agents import Agent
from torchrl_ocwm.modules import UniformGoals
from torchrl_ocwm.objectives import BehaviourLoss, GoalConditionedDreamerLoss, WeightedModelLoss


def network(module: Any, index: int = 0) -> nn.Module:
    return module.module[index].module


def torchrl_loss(agent: Agent, replay_weight: float) -> DreamerV3Loss:
    """TorchRL's own DreamerV3 over the networks of an agent, with TorchRL's flat keys."""
    model, keys = agent.model, ["state", "belief"]
    transition = TensorDictSequential(
        TensorDictModule(lambda a: a / a.detach().abs().clamp_min(1), ["action"], ["bounded"]),
        TensorDictModule(model.prior, [*keys, "bounded"], ["_", *keys]),
    )
    reward = TensorDictSequential(
        TensorDictModule(model.reward_head, keys, ["reward_logits"]),
        TensorDictModule(model.two_hot, ["reward_logits"], ["reward"]),
    )
    env = DreamerEnv(WorldModelWrapper(transition, reward), prior_shape=(model.state,), belief_shape=(model.belief,))
    env.observation_spec = Composite(state=Unbounded(model.state), belief=Unbounded(model.belief))
    env.state_spec = env.observation_spec.clone()
    env.action_spec, env.reward_spec = Bounded(-1, 1, (model.action,)), Unbounded((1,))
    actor = ProbabilisticTensorDictSequential(
        TensorDictModule(network(agent.actor), keys, ["loc", "scale"]),
        ProbabilisticTensorDictModule(
            ["loc", "scale"],
            ["action"],
            distribution_class=IndependentNormal,
            distribution_kwargs={"tanh_loc": False},
        ),
    )
    critic = agent.behaviour().loss.actor_loss.value_model
    value = TensorDictSequential(
        TensorDictModule(network(critic), keys, ["state_value_logits"]),
        TensorDictModule(network(critic, 1), ["state_value_logits"], ["state_value"]),
    )
    continuation = TensorDictSequential(
        TensorDictModule(model.continue_head, keys, ["continue_pred"]),
        TensorDictModule(torch.sigmoid, ["continue_pred"], ["continuation"]),
    )
    actor_loss = DreamerV3ActorLoss(actor, value, env, continuation_model=continuation, imagination_horizon=3)
    actor_loss.make_value_estimator(ValueEstimators.TDLambda, gamma=0.99, lmbda=0.95)
    value_loss = DreamerV3ValueLoss(value, value_loss="two_hot", actor_loss=actor_loss, slow_critic_regularization=1.0)
    return DreamerV3Loss(
        WeightedModelLoss(model.records()), actor_loss, value_loss, replay_value_loss_weight=replay_weight
    )


@pytest.mark.parametrize("replay_weight", [0.0, 0.3])
def test_without_a_goal_it_is_torchrls_loss(make_agent: Any, records: TensorDict, replay_weight: float) -> None:
    """Same parameters, same noise, same numbers, same gradients."""
    agent = make_agent("dreamer", {"world_model.lambda_object_position": 1.0})
    parts = agent.behaviour().loss
    behaviour = BehaviourLoss(parts.actor_loss, parts.value_loss, replay_value_loss_weight=replay_weight)
    ours = GoalConditionedDreamerLoss(agent.loss.model_loss, behaviour, return_context=True)
    torch.manual_seed(1)
    got = ours(records)
    total(got).backward()
    gradients = {name: p.grad.clone() for name, p in agent.named_parameters() if p.grad is not None}
    agent.zero_grad()
    torch.manual_seed(1)
    expected = torchrl_loss(agent, replay_weight)(records)
    total(expected).backward()
    compared = {name for name in got.keys() if name != "replay_context"}
    assert {"loss_actor", "loss_value", "loss_model_reward"} <= compared
    assert ("loss_replay_value" in compared) == bool(replay_weight)
    for name in compared:
        torch.testing.assert_close(got[name], expected[name], rtol=1e-5, atol=1e-6, msg=name)
    torch.testing.assert_close(got["replay_context", "state"], expected["replay_context", "state"])
    # TorchRL's target critic is a copy in each loss, so only what both share is compared.
    for name, parameter in agent.named_parameters():
        if parameter.grad is not None:
            torch.testing.assert_close(gradients[name], parameter.grad, rtol=1e-4, atol=1e-5, msg=name)
    assert len(gradients) > 20


def total(losses: TensorDict) -> Tensor:
    return sum(value for name, value in losses.items() if name.startswith("loss_"))


def gradient_norm(module: nn.Module) -> float:
    return sum(float(p.grad.abs().sum()) for p in module.parameters() if p.grad is not None)


@pytest.mark.parametrize("name", ["dreamer", "dreamer_pcp"])
def test_actor_and_critic_leave_the_world_model_alone(make_agent: Any, records: TensorDict, name: str) -> None:
    agent = make_agent(name)
    losses = agent.loss(records)
    (losses["loss_actor"] + losses["loss_value"]).backward()
    assert gradient_norm(agent.model) == 0
    assert gradient_norm(agent.actor) > 0
    assert sum(float(g.abs().sum()) for g in grads(agent.behaviour().loss.value_loss.value_model_params)) > 0


def grads(params: Any) -> list[Tensor]:
    return [p.grad for p in params.parameters() if p.grad is not None]


def test_actor_loss_leaves_the_critic_alone(make_agent: Any, records: TensorDict) -> None:
    agent = make_agent()
    agent.loss(records)["loss_actor"].backward()
    assert gradient_norm(agent.actor) > 0
    assert not any(float(g.abs().sum()) for g in grads(agent.behaviour().loss.value_loss.value_model_params))


def test_critic_loss_leaves_the_actor_alone(make_agent: Any, records: TensorDict) -> None:
    agent = make_agent()
    agent.loss(records)["loss_value"].backward()
    assert gradient_norm(agent.actor) == 0


def test_imagined_reward_teaches_the_actor_through_the_dynamics(make_agent: Any, records: TensorDict) -> None:
    """The gradient of the imagined reward alone, without critic and entropy, reaches the actor."""
    agent = make_agent()
    latent = agent.model.records()(records)["next"].select("state", "belief")
    start = agent.behaviour().loss.imagination_start(latent)
    rollout = agent.imagination.rollout(3, agent.actor, auto_reset=False, tensordict=start, break_when_any_done=False)
    rollout["next", "reward"][:, -1].sum().backward()
    assert gradient_norm(agent.actor) > 0


def test_every_imagined_start_has_a_goal_of_its_own(make_agent: Any, records: TensorDict) -> None:
    agent = make_agent()
    latent = agent.model.records()(records)["next"].select("state", "belief")
    start = agent.behaviour().loss.imagination_start(latent)
    assert not any(value.requires_grad for value in start.values(True, True))
    goals = start["latent", "goal"]
    assert goals.shape == (12, 2)
    assert len(goals.unique(dim=0)) == 12
    assert goals.abs().max() <= 1


def test_the_goal_stays_through_imagination(make_agent: Any, records: TensorDict) -> None:
    agent = make_agent()
    latent = agent.model.records()(records)["next"].select("state", "belief")
    start = agent.behaviour().loss.imagination_start(latent)
    rollout = agent.imagination.rollout(3, agent.actor, auto_reset=False, tensordict=start, break_when_any_done=False)
    goal = start["latent", "goal"].unsqueeze(1).expand(-1, 3, -1)
    torch.testing.assert_close(rollout["latent", "goal"], goal, rtol=0, atol=0)
    torch.testing.assert_close(rollout["next", "latent", "goal"], goal, rtol=0, atol=0)


def test_imagined_reward_is_the_distance_of_the_decoded_position(make_agent: Any, records: TensorDict) -> None:
    agent = make_agent()
    latent = agent.model.records()(records)["next"].select("state", "belief")
    start = agent.behaviour().loss.imagination_start(latent)
    rollout = agent.imagination.rollout(3, agent.actor, auto_reset=False, tensordict=start, break_when_any_done=False)
    after = rollout["next", "latent"]
    decoded = agent.model.vector_decoders["object_position"](after["state"], after["belief"])
    metres = 0.24 * (decoded - after["goal"])  # the workspace is 0.24 m to each side
    torch.testing.assert_close(rollout["next", "reward"].squeeze(-1), -metres.norm(dim=-1))


def test_replay_value_needs_recorded_rewards(make_agent: Any) -> None:
    loss = make_agent().behaviour().loss
    with pytest.raises(ValueError, match="set it to 0 or drop the goal source"):
        BehaviourLoss(loss.actor_loss, loss.value_loss, goal_source=UniformGoals(2), replay_value_loss_weight=0.3)


def test_set_keys_nested(make_agent: Any, records: TensorDict) -> None:
    """The world model may write its latents anywhere."""
    loss = make_agent().loss
    torch.manual_seed(1)
    expected = loss(records)
    agent = make_agent()
    move = TensorDictModule(
        lambda s, b: (s, b), [("next", "state"), ("next", "belief")], [("next", "my", "s"), ("next", "my", "b")]
    )
    spoil = TensorDictModule(torch.zeros_like, [("next", "state")], [("next", "state")])
    agent.loss.model_loss.world_model = TensorDictSequential(agent.loss.model_loss.world_model, move, spoil)
    agent.loss.set_keys(state=("my", "s"), belief=("my", "b"))
    torch.manual_seed(1)
    torch.testing.assert_close(total(agent.loss(records)), total(expected))


def test_in_keys_suffice(make_agent: Any, records: TensorDict) -> None:
    loss = make_agent("dreamer").loss
    torch.manual_seed(1)
    expected = loss(records)
    loss = make_agent("dreamer").loss  # each call moves the statistics of the returns
    torch.manual_seed(1)
    got = loss(records.select(*loss.in_keys))
    torch.testing.assert_close(total(got), total(expected))
