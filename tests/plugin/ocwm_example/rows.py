"""A row of parts that there are."""

from torchrl_ocwm.agents import AGENTS
from torchrl_ocwm.settings import change

AGENTS["remembering"] = change(AGENTS["dreamer_pcp"], {"behaviours.reach.goals": "remembered"})
