"""What the parts of a behaviour are built from."""

from __future__ import annotations

from typing import NamedTuple

from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.modules import RSSMWorldModel
from torchrl_ocwm.modules.architecture import Architecture


class Scene(NamedTuple):
    """A world model, and which of its objects a behaviour is about.

    Args:
        model: The world model, built already.
        task: What the agent is for.
        architecture: How large its networks are.
        object_index: Which of the task's objects is to be positioned.
    """

    model: RSSMWorldModel
    task: Task
    architecture: Architecture
    object_index: int
