"""Which agents there are: rows of choices, and the builder that wires them."""

from torchrl_ocwm.agents.agent import Agent, Policy
from torchrl_ocwm.agents.build import build_agent
from torchrl_ocwm.agents.checkpoint import load_agent, save_agent
from torchrl_ocwm.agents.config import AgentConfig, Size
from torchrl_ocwm.agents.presets import AGENTS, SIZES, agent_name

__all__ = [
    "AGENTS",
    "SIZES",
    "Agent",
    "AgentConfig",
    "Policy",
    "Size",
    "agent_name",
    "build_agent",
    "load_agent",
    "save_agent",
]
