"""A behaviour, built: actor, critic and what teaches them in imagination."""

from __future__ import annotations

from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.utils import NestedKey
from torch import nn
from torch.distributions import OneHotCategoricalStraightThrough
from torchrl.modules import IndependentNormal, SymExpTwoHot
from torchrl.objectives import DreamerV3ActorLoss, DreamerV3ValueLoss, ValueEstimators

from torchrl_ocwm.agents.config import Behaviour, Learning
from torchrl_ocwm.agents.goals import GoalEncoding
from torchrl_ocwm.agents.rewards import ImaginedReward
from torchrl_ocwm.agents.scene import Scene
from torchrl_ocwm.modules import BoundedNormalActor, CategoricalActor, ImaginationEnv, RSSMWorldModel
from torchrl_ocwm.modules.goals import GOAL
from torchrl_ocwm.modules.networks import make_mlp
from torchrl_ocwm.objectives import BehaviourLoss
from torchrl_ocwm.parts import Part
from torchrl_ocwm.settings import SettingsError

LAMBDA = 0.95


class LearntBehaviour(nn.Module):
    """Actor and critic of one behaviour, and the loss that trains them in a world model's imagination.

    Args:
        config: The choices.
        scene: The world model, and the object that it is about.
        learning: How it learns.
        prefix: Put before the names of its losses.

    Attributes:
        actor: Writes ``action`` from ``latent``.
        reward: Writes the imagined ``reward``.
        imagination: The world model as an environment, with the goal in its state.
        goal: How goals are encoded; ``None`` for a behaviour that sees none.
        loss: The loss.

    Raises:
        SettingsError: if the choices do not fit together.
    """

    def __init__(self, config: Behaviour, scene: Scene, learning: Learning, *, prefix: str = "") -> None:
        super().__init__()
        self.config, self.scene = config, scene
        self.goal = config.goal.build(scene)
        features = 0 if self.goal is None else self.goal.features
        _check_goals(config, self.goal)
        reward = config.reward.build(scene, self.goal)
        _check_reward(config, reward, features)
        self.actor, self.reward = make_actor(scene, features), reward.module
        self.imagination = ImaginationEnv(
            scene.model.transition(),
            reward.module,
            state=scene.model.state,
            belief=scene.model.belief,
            action=scene.task.action,
            goal=features,
        )
        source = None if self.goal is None else config.goals.build(scene.model.units.dim, self.goal)
        self.reward_lr = reward.lr
        self.loss = self._make_loss(make_critic(scene, features), source, reward, learning, prefix)

    @property
    def model(self) -> RSSMWorldModel:
        """The world model that it is learnt in."""
        return self.scene.model

    def _make_loss(
        self,
        critic: TensorDictSequential,
        source: TensorDictModuleBase | None,
        reward: ImaginedReward,
        learning: Learning,
        prefix: str,
    ) -> BehaviourLoss:
        actor_loss = DreamerV3ActorLoss(
            self.actor,
            critic,
            self.imagination,
            continuation_model=self.scene.model.continuation(),
            imagination_horizon=learning.imagination_horizon,
            entropy_bonus=learning.entropy_bonus,
        )
        actor_loss.make_value_estimator(ValueEstimators.TDLambda, gamma=learning.gamma, lmbda=LAMBDA)
        value_loss = DreamerV3ValueLoss(
            critic, value_loss="two_hot", actor_loss=actor_loss, slow_critic_regularization=1.0
        )
        return BehaviourLoss(actor_loss, value_loss, goal_source=source, reward_loss=reward.loss, prefix=prefix)


def make_actor(scene: Scene, goal_features: int) -> ProbabilisticTensorDictSequential:
    """A policy on ``latent = {state, belief, goal}``: a bounded normal, or categorical for discrete actions.

    Its mean or its likeliest action acts, unless actions are drawn. Gradients go through the actions that are drawn,
    through discrete ones straight.
    """
    kind, parameters, distribution = (
        (CategoricalActor, ["probs"], {"distribution_class": OneHotCategoricalStraightThrough})
        if scene.task.discrete
        else (
            BoundedNormalActor,
            ["loc", "scale"],
            {
                "distribution_class": IndependentNormal,
                "distribution_kwargs": {"validate_args": False},
            },
        )
    )
    network = kind(scene.model.latent_features + goal_features, scene.task.action, **scene.architecture.mlp)
    return ProbabilisticTensorDictSequential(
        TensorDictModule(network, _inputs(goal_features), parameters),
        ProbabilisticTensorDictModule(parameters, ["action"], return_log_prob=False, **distribution),
    )


def make_critic(scene: Scene, goal_features: int) -> TensorDictSequential:
    """A two-hot critic on ``latent = {state, belief, goal}``, which starts at zero."""
    two_hot, size = SymExpTwoHot(), scene.architecture
    network = make_mlp(
        in_features=scene.model.latent_features + goal_features,
        out_features=two_hot.num_bins,
        outscale=0.0,
        **size.mlp,
    )
    return TensorDictSequential(
        TensorDictModule(network, _inputs(goal_features), ["state_value_logits"]),
        TensorDictModule(two_hot, ["state_value_logits"], ["state_value"]),
    )


def _inputs(goal_features: int) -> list[NestedKey]:
    """What actor and critic see."""
    return [("latent", "state"), ("latent", "belief"), *([GOAL] if goal_features else [])]


def _check_goals(config: Behaviour, goal: GoalEncoding | None) -> None:
    if config.goals.gives != (goal is not None):
        raise SettingsError(
            f"goal={_name(config.goal)} does not go with goals={_name(config.goals)}: a policy that sees a goal "
            "needs goals in imagination, and only that one"
        )


def _check_reward(config: Behaviour, reward: ImaginedReward, features: int) -> None:
    judges = GOAL in reward.module.in_keys
    if judges != bool(features):
        raise SettingsError(
            f"reward={_name(config.reward)} does not go with goal={_name(config.goal)}: an imagined reward has to "
            "judge by the goal that the policy sees, and by no other"
        )


def _name(part: Part) -> str:
    known = part.name_and_kind()
    return repr(known[0] if known else type(part).__name__)
