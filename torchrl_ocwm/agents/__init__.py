"""Which agents there are: parts with settings, rows of them, and the builder that wires them."""

from torchrl_ocwm.agents.agent import Agent, Policy
from torchrl_ocwm.agents.behaviour import LearntBehaviour
from torchrl_ocwm.agents.build import build_agent
from torchrl_ocwm.agents.checkpoint import collecting_policy, describe, load_agent, save_agent
from torchrl_ocwm.agents.config import AgentConfig, Behaviour, Learning, Size
from torchrl_ocwm.agents.explorers import Disagreement, ExplorationReward, ObjectEntropy, StateEntropy
from torchrl_ocwm.agents.export import export_policy, policy_inputs, policy_outputs
from torchrl_ocwm.agents.goal_sources import (
    EnvironmentGoals,
    FrameGoalSource,
    FutureGoalSource,
    GoalSource,
    MixedGoalSource,
    UniformGoalSource,
)
from torchrl_ocwm.agents.goals import FullLatent, Goal, GoalEncoding, ImageEmbedding, NoGoal, ObjectLatent, Position
from torchrl_ocwm.agents.optimizers import Adam, DreamerV3, OptimizerPart
from torchrl_ocwm.agents.presets import AGENTS, EXPLORERS, SIZES, agent_name
from torchrl_ocwm.agents.requirements import lacking, remedies, ruled_out
from torchrl_ocwm.agents.rewards import (
    FullLatentCosine,
    ImaginedReward,
    LatentChord,
    LatentSimilarity,
    LearnedReward,
    PositionDistance,
    Reward,
    TemporalDistance,
)
from torchrl_ocwm.agents.scene import Scene
from torchrl_ocwm.agents.sources import agent_file, shipped_agents
from torchrl_ocwm.agents.weights import AgentWeights
from torchrl_ocwm.agents.world_models import Flat, ObjectCentric, WorldModelPart
from torchrl_ocwm.modules.architecture import Architecture
from torchrl_ocwm.parts import register

__all__ = [
    "AGENTS",
    "EXPLORERS",
    "SIZES",
    "Adam",
    "Agent",
    "AgentConfig",
    "AgentWeights",
    "Architecture",
    "Behaviour",
    "Disagreement",
    "DreamerV3",
    "EnvironmentGoals",
    "ExplorationReward",
    "Flat",
    "FrameGoalSource",
    "FullLatent",
    "FullLatentCosine",
    "FutureGoalSource",
    "Goal",
    "GoalEncoding",
    "GoalSource",
    "ImageEmbedding",
    "ImaginedReward",
    "LatentChord",
    "LatentSimilarity",
    "LearnedReward",
    "Learning",
    "LearntBehaviour",
    "MixedGoalSource",
    "NoGoal",
    "ObjectCentric",
    "ObjectEntropy",
    "ObjectLatent",
    "OptimizerPart",
    "Policy",
    "Position",
    "PositionDistance",
    "Reward",
    "Scene",
    "Size",
    "StateEntropy",
    "TemporalDistance",
    "UniformGoalSource",
    "WorldModelPart",
    "agent_file",
    "agent_name",
    "build_agent",
    "collecting_policy",
    "describe",
    "export_policy",
    "lacking",
    "load_agent",
    "policy_inputs",
    "policy_outputs",
    "register",
    "remedies",
    "ruled_out",
    "save_agent",
    "shipped_agents",
]
