"""What there is to choose: agents as a world model and behaviours, and sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from torchrl_ocwm.agents.goal_sources import EnvironmentGoals, GoalSource
from torchrl_ocwm.agents.goals import Goal, NoGoal
from torchrl_ocwm.agents.optimizers import DreamerV3, OptimizerPart
from torchrl_ocwm.agents.rewards import LearnedReward, Reward
from torchrl_ocwm.agents.world_models import Flat, WorldModelPart
from torchrl_ocwm.modules.architecture import Architecture
from torchrl_ocwm.settings import Settings, SettingsError, setting

#: The behaviour that acts unless another is asked for.
REACH = "reach"
#: The behaviour that explores, where there is one.
EXPLORE = "explore"


@dataclass(frozen=True)
class Behaviour(Settings):
    """What is learnt in a world model's imagination: an actor and a critic of their own, for a goal and a reward.

    Args:
        goal: How a goal becomes what policy and critic see beside the latent.
        reward: The reward in imagination.
        goals: Where goals in imagination come from.
        object: Which object it is about, by the task's names; ``None``: the first. The reward of an explorer is about
            it only with ``objects="one"``; its scores always are.
    """

    goal: Goal = field(default_factory=NoGoal)
    reward: Reward = field(default_factory=LearnedReward)
    goals: GoalSource = field(default_factory=EnvironmentGoals)
    object: str | None = None


@dataclass(frozen=True)
class AgentConfig(Settings):
    """One row of the table of agents (docs/agents.md): a world model, and the behaviours learnt in it by name.

    Args:
        world_model: What observes, remembers and predicts.
        behaviours: What is learnt in it, in the order of ``reach`` and then the other names; the first acts unless
            another is asked for.
    """

    world_model: WorldModelPart = field(default_factory=Flat)
    behaviours: Mapping[str, Behaviour] = field(default_factory=lambda: {REACH: Behaviour()})

    def __post_init__(self) -> None:
        super().__post_init__()
        # A file does not keep an order; parameters and random numbers have to come in the same one.
        names = sorted(self.behaviours, key=lambda name: (name != REACH, name))
        object.__setattr__(self, "behaviours", {name: self.behaviours[name] for name in names})

    def validate(self) -> None:
        """There is something to learn, and names fit into those of losses."""
        if not self.behaviours:
            raise SettingsError("behaviours must have at least one")
        if odd := [name for name in self.behaviours if not name.isidentifier()]:
            raise SettingsError(f"behaviours have names like 'reach', got {odd[0]!r}")

    @property
    def acting(self) -> str:
        """The behaviour that acts: ``reach``, or the first by name if there is none of this name."""
        return next(iter(self.behaviours))

    def and_behaviours(self, **behaviours: Behaviour) -> AgentConfig:
        """The same row with more behaviours beside its own, by name.

        Examples:
            >>> from torchrl_ocwm.agents import AGENTS, EXPLORERS
            >>> list(AGENTS["dreamer_pcp"].and_behaviours(explore=EXPLORERS["plan2explore"]).behaviours)
            ['reach', 'explore']
        """
        return replace(self, behaviours={**self.behaviours, **behaviours})


@dataclass(frozen=True, kw_only=True)
class Learning(Settings):
    """How much an agent sees per update, and how fast it learns.

    Args:
        batch_size: Sequences per update.
        slice_len: Frames per sequence.
        imagination_horizon: Imagined steps from each frame.
        model_lr: Learning rate of the world model.
        actor_lr: Learning rate of the actors.
        value_lr: Learning rate of the critics.
        gamma: Discount of a step in imagination.
        entropy_bonus: Weight of the actor's entropy.
        lambda_dynamic: Weight of the KL that trains the prior; that which trains the posterior has 0.1.
        optimizer: How parameters follow their gradients.
    """

    batch_size: int = setting(at_least=1)
    slice_len: int = setting(at_least=2)
    imagination_horizon: int = setting(at_least=1)
    model_lr: float = setting(at_least=0)
    actor_lr: float = setting(at_least=0)
    value_lr: float = setting(at_least=0)
    gamma: float = setting(0.99, at_least=0, at_most=1)
    entropy_bonus: float = setting(3e-4, at_least=0)
    lambda_dynamic: float = setting(1.0, at_least=0)
    optimizer: OptimizerPart = field(default_factory=DreamerV3)


@dataclass(frozen=True)
class Size(Settings):
    """How large an agent is, and how it learns.

    Args:
        architecture: Shapes of its networks.
        learning: Batches, horizon, learning rates.
    """

    architecture: Architecture
    learning: Learning
