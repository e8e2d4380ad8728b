"""What is minimised: loss modules."""

from torchrl_ocwm.objectives.dreamer import GoalConditionedDreamerLoss
from torchrl_ocwm.objectives.world_model import WorldModelLoss, image_reconstruction, symlog_reconstruction

__all__ = ["GoalConditionedDreamerLoss", "WorldModelLoss", "image_reconstruction", "symlog_reconstruction"]
