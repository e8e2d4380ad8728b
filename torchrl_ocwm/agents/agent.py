"""An agent: a world model, an actor and a critic, wired as a row of choices says."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, SymExpTwoHot
from torchrl.objectives import DreamerV3ActorLoss, DreamerV3ValueLoss, ValueEstimators

from torchrl_ocwm.agents.config import AgentConfig, Size
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.modules import (
    ActingLatent,
    Actor,
    FlatWorldModel,
    FrameGoals,
    GivenGoals,
    ImaginationEnv,
    LatentPositionalEncoder,
    LatentSimilarityReward,
    MixedGoals,
    ObjectWorldModel,
    PositionDistanceReward,
    UniformGoals,
    UnitRMS,
    WorkspaceUnits,
    WorldModel,
)
from torchrl_ocwm.modules.acting import refuse_export_without_latent
from torchrl_ocwm.modules.goals import GOAL
from torchrl_ocwm.modules.networks import make_mlp
from torchrl_ocwm.objectives import FOCUSModelLoss, GoalConditionedDreamerLoss, WorldModelLoss

LAMBDA = 0.95


class WorldModelChoice(NamedTuple):
    """How a world model is built, and the loss that trains it."""

    build: Callable[[Task, AgentConfig, Size], WorldModel]
    loss: Callable[[WorldModel, AgentConfig, Size], WorldModelLoss]


def flat_world_model(task: Task, config: AgentConfig, size: Size) -> FlatWorldModel:
    """A world model with one latent for the whole scene."""
    return FlatWorldModel(**_scene(task, config, size))


def object_world_model(task: Task, config: AgentConfig, size: Size) -> ObjectWorldModel:
    """A world model with a latent for each object (FOCUS)."""
    return ObjectWorldModel(
        **_scene(task, config, size),
        positional_encoder=config.goal == "object_latent",
        object_features=size.object_features,
        extractor_units=size.extractor_units,
    )


def flat_loss(model: WorldModel, config: AgentConfig, size: Size) -> WorldModelLoss:
    """What trains a world model with one latent."""
    return WorldModelLoss(model.records(), **_weights(config, size))


def object_loss(model: WorldModel, config: AgentConfig, size: Size) -> FOCUSModelLoss:
    """What trains a world model with object latents."""
    positional: dict[str, Any] = {
        "lambda_positional": config.lambda_positional,
        "positional_distance": config.latent_distance,
        "positional_gradient": config.positional_gradient,
    }
    return FOCUSModelLoss(
        model.records(), **(positional if config.goal == "object_latent" else {}), **_weights(config, size)
    )


def _weights(config: AgentConfig, size: Size) -> dict[str, Any]:
    names = [f"lambda_{name}" for name in config.observed]  # the weight of anything else would do nothing
    return {"lambda_dynamic": size.lambda_dynamic, **{name: getattr(config, name) for name in names}}


def _scene(task: Task, config: AgentConfig, size: Size) -> dict[str, Any]:
    """What every world model is built from."""
    return {
        "image_size": task.image_size,
        "proprio": task.proprio,
        "objects": len(task.objects),
        "action": task.action,
        "units": WorkspaceUnits(task.workspace.low, task.workspace.high),
        "observed": config.observed,
        "reward_head": config.reward == "head",
        **size.architecture(),
    }


class Goal(NamedTuple):
    """What a goal is for policy and critic, and how it is made of what there is.

    Args:
        features: How many numbers it is.
        position: Encodes positions ``[..., D]`` in workspace units.
        image: Encodes images ``[..., F, 3, H, W]`` uint8, if it can be done.
        frame: Writes ``("latent", "goal")``, the goal that a frame of the records is.
    """

    features: int
    position: nn.Module
    image: nn.Module | None
    frame: TensorDictModuleBase


def position_goal(model: WorldModel, _: AgentConfig) -> Goal:
    """The goal position itself (paper, section PCP)."""
    objects = nn.Unflatten(-1, (-1, model.units.dim))
    frame = TensorDictModule(nn.Sequential(objects, _First()), ["object_units"], [GOAL])
    return Goal(model.units.dim, nn.Identity(), None, frame)


def object_latent_goal(model: WorldModel, config: AgentConfig) -> Goal:
    """The latent that the object to be positioned would have at the goal (paper, section LCP).

    Positions and images are encoded by different networks, which are trained to agree in direction only. All goals are
    brought to one length here, so that an actor trained on the one kind knows the other. With
    ``latent_distance="mse"`` training and reward compare lengths too, so that they stay as they are.
    """
    model = _object_centric(model)
    assert model.positional_encoder is not None
    features = model.positional_encoder.features
    length = UnitRMS() if config.latent_distance == "cosine" else nn.Identity()
    position = nn.Sequential(_LatentAtGoal(model.positional_encoder), length)
    image = nn.Sequential(model.latents_in_images(), _First(), length)
    frame = TensorDictModule(nn.Sequential(_First(), length), ["image_latent"], [GOAL])
    return Goal(features, position, image, frame)


def no_goal(model: WorldModel, _: AgentConfig) -> None:
    """Nothing: the world model has to remember the goal that it observed."""


def no_source(model: WorldModel, goal: Goal | None) -> None:
    """Goals are in the observations."""


def uniform_goals(model: WorldModel, goal: Goal) -> TensorDictModuleBase:
    """Positions anywhere in the workspace."""
    return TensorDictSequential(UniformGoals(model.units.dim), TensorDictModule(goal.position, ["goal_units"], [GOAL]))


def frame_goals(model: WorldModel, goal: Goal) -> TensorDictModuleBase:  # noqa: ARG001
    """What other frames of the batch show."""
    return FrameGoals(goal.frame)


def mixed_goals(model: WorldModel, goal: Goal) -> TensorDictModuleBase:
    """Both, half and half."""
    return MixedGoals(uniform_goals(model, goal), frame_goals(model, goal))


def learned_reward(model: WorldModel, _: AgentConfig) -> TensorDictModuleBase:
    """What the reward head predicts."""
    return model.reward()


def position_distance_reward(model: WorldModel, _: AgentConfig) -> TensorDictModuleBase:
    """The distance between decoded position and goal position (paper, equation 3)."""
    return TensorDictSequential(model.object_position(), PositionDistanceReward(model.units))


def latent_similarity_reward(model: WorldModel, config: AgentConfig) -> TensorDictModuleBase:
    """The similarity of the object's latent and the goal latent (paper, r_LCP)."""
    reward = LatentSimilarityReward(distance=config.latent_distance)
    return TensorDictSequential(_object_centric(model).object_latent(1), reward)


def latent_chord_reward(model: WorldModel, _: AgentConfig) -> TensorDictModuleBase:
    """Minus the distance between the directions of the object's latent and the goal latent."""
    return TensorDictSequential(_object_centric(model).object_latent(1), LatentSimilarityReward(distance="chord"))


def _object_centric(model: WorldModel) -> ObjectWorldModel:
    if not isinstance(model, ObjectWorldModel):
        raise ValueError("goals and rewards on object latents need world_model='object'")
    return model


#: The choices by name. A new world model, goal, reward or goal source is one function and one entry here.
WORLD_MODELS = {
    "flat": WorldModelChoice(flat_world_model, flat_loss),
    "object": WorldModelChoice(object_world_model, object_loss),
}
GOALS: dict[str, Callable[[WorldModel, AgentConfig], Goal | None]] = {
    "none": no_goal,
    "position": position_goal,
    "object_latent": object_latent_goal,
}
REWARDS: dict[str, Callable[[WorldModel, AgentConfig], TensorDictModuleBase]] = {
    "head": learned_reward,
    "position_distance": position_distance_reward,
    "latent_similarity": latent_similarity_reward,
    "latent_chord": latent_chord_reward,
}
GOAL_SOURCES: dict[str, Callable[[WorldModel, Any], TensorDictModuleBase | None]] = {
    "environment": no_source,
    "uniform": uniform_goals,
    "frames": frame_goals,
    "mixed": mixed_goals,
}


class Policy(TensorDictSequential):
    """The policy of an agent, as a module that runs in any rollout of an environment of the agent's task.

    Reads the observations, ``is_init`` and a goal: ``goal_position`` ``[..., D]`` in metres as the environment gives
    it, or a position or images under ``goal`` (:class:`~torchrl_ocwm.modules.GivenGoals`). Writes ``action``, and
    ``latent``, which it reads back at the next step. Actions are drawn from the actor, or are its mean under
    ``set_exploration_type(ExplorationType.DETERMINISTIC)``.

    Attributes:
        agent: The agent that it belongs to.
        takes_images: Whether goals can be given as images.
    """

    def __init__(self, agent: Agent, *modules: TensorDictModuleBase) -> None:
        super().__init__(*modules)
        self.register_forward_pre_hook(refuse_export_without_latent, with_kwargs=True)
        self.__dict__["agent"] = agent  # not a submodule: the modules hold the parameters

    @property
    def takes_images(self) -> bool:
        goal = self.agent.goal
        return goal is not None and goal.image is not None


class Agent(nn.Module):
    """A world model, an actor and a critic for one task.

    Args:
        task: What the agent is for.
        config: The row of choices.
        size: How large it is.

    Attributes:
        model: The world model.
        imagination: The world model as an environment, with the goal in its state.
        loss: World model, actor and critic in one loss, as TorchRL's DreamerV3 stepper takes it.

    Raises:
        ValueError: if the choices do not fit together or an image of the task cannot be halved by the CNN.
    """

    def __init__(self, task: Task, config: AgentConfig, size: Size) -> None:
        super().__init__()
        self.task, self.config, self.size = task, config, size
        self.model = WORLD_MODELS[config.world_model].build(task, config, size)
        goal = self.goal = GOALS[config.goal](self.model, config)
        features = 0 if goal is None else goal.features
        if (config.goal_source == "environment") != (goal is None):
            raise ValueError(
                f"goal={config.goal!r} does not go with goal_source={config.goal_source!r}: a policy that sees a goal "
                "needs goals in imagination, and only that one"
            )
        reward = REWARDS[config.reward](self.model, config)
        if (GOAL in reward.in_keys) != bool(features):
            raise ValueError(
                f"reward={config.reward!r} does not go with goal={config.goal!r}: an imagined reward has to judge by "
                "the goal that the policy sees, and by no other"
            )
        self.actor = self._make_actor(features)
        self.imagination = ImaginationEnv(
            self.model.transition(),
            reward,
            state=self.model.state,
            belief=self.model.belief,
            action=task.action,
            goal=features,
        )
        source = GOAL_SOURCES[config.goal_source](self.model, goal)
        self.loss = self._make_loss(self._make_critic(features), source)

    def policy(self) -> Policy:
        """The policy, sharing the agent's parameters."""
        model, goal = self.model, self.goal
        encoder = [] if goal is None else [GivenGoals(model.units, goal.position, goal.image)]
        return Policy(
            self,
            ActingLatent(model.state, model.belief, self.task.action),
            model.filter(),
            *encoder,
            self.actor,
            # What is done is what the next step remembers.
            TensorDictModule(_clamp, ["action"], ["action"]),
            TensorDictModule(torch.clone, ["action"], [("latent", "action")]),
        )

    def _make_actor(self, goal_features: int) -> ProbabilisticTensorDictSequential:
        size = self.size
        network = Actor(
            self.model.latent_features + goal_features,
            self.task.action,
            layers=size.mlp_layers,
            units=size.mlp_units,
            style=size.style,
        )
        return ProbabilisticTensorDictSequential(
            TensorDictModule(network, _inputs(goal_features), ["loc", "scale"]),
            ProbabilisticTensorDictModule(
                ["loc", "scale"],
                ["action"],
                distribution_class=IndependentNormal,
                distribution_kwargs={"tanh_loc": False, "validate_args": False},
                return_log_prob=False,
            ),
        )

    def _make_critic(self, goal_features: int) -> TensorDictSequential:
        two_hot, size = SymExpTwoHot(), self.size
        network = make_mlp(
            size.style,
            self.model.latent_features + goal_features,
            two_hot.num_bins,
            layers=size.mlp_layers,
            units=size.mlp_units,
            outscale=0.0,
        )
        return TensorDictSequential(
            TensorDictModule(network, _inputs(goal_features), ["state_value_logits"]),
            TensorDictModule(two_hot, ["state_value_logits"], ["state_value"]),
        )

    def _make_loss(
        self, critic: TensorDictSequential, goal_source: TensorDictModuleBase | None
    ) -> GoalConditionedDreamerLoss:
        size = self.size
        model_loss = WORLD_MODELS[self.config.world_model].loss(self.model, self.config, size)
        actor_loss = DreamerV3ActorLoss(
            self.actor,
            critic,
            self.imagination,
            continuation_model=self.model.continuation(),
            imagination_horizon=size.imagination_horizon,
            entropy_bonus=size.entropy_bonus,
        )
        actor_loss.make_value_estimator(ValueEstimators.TDLambda, gamma=size.gamma, lmbda=LAMBDA)
        value_loss = DreamerV3ValueLoss(
            critic, value_loss="two_hot", actor_loss=actor_loss, slow_critic_regularization=1.0
        )
        return GoalConditionedDreamerLoss(model_loss, actor_loss, value_loss, goal_source=goal_source)


class _LatentAtGoal(nn.Module):
    """Goal positions ``[..., D]`` to the latent ``[..., L]`` of the first object there."""

    def __init__(self, encoder: LatentPositionalEncoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, goal_units: Tensor) -> Tensor:
        return self.encoder(goal_units.unsqueeze(-2), object_index=0).squeeze(-2)


class _First(nn.Module):
    """What belongs to the first object, ``[..., O, any]`` to ``[..., any]``."""

    def forward(self, objects: Tensor) -> Tensor:
        return objects[..., 0, :]


def _inputs(goal_features: int) -> list[NestedKey]:
    """What actor and critic see."""
    return [("latent", "state"), ("latent", "belief"), *([GOAL] if goal_features else [])]


def _clamp(action: Tensor) -> Tensor:
    return action.clamp(-1, 1)
