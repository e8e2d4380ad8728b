"""What is minimised: loss modules."""

from torchrl_ocwm.objectives.annealing import AnnealedWeight
from torchrl_ocwm.objectives.dreamer import BehaviourLoss, GoalConditionedDreamerLoss
from torchrl_ocwm.objectives.ensemble import EnsembleLoss
from torchrl_ocwm.objectives.focus import FOCUSModelLoss, mask_nll, object_reconstruction, positional_latent_loss
from torchrl_ocwm.objectives.temporal_distance import TemporalDistanceLoss, temporal_pairs
from torchrl_ocwm.objectives.world_model import WeightedModelLoss, image_reconstruction, symlog_reconstruction

__all__ = [
    "AnnealedWeight",
    "BehaviourLoss",
    "EnsembleLoss",
    "FOCUSModelLoss",
    "GoalConditionedDreamerLoss",
    "TemporalDistanceLoss",
    "WeightedModelLoss",
    "image_reconstruction",
    "mask_nll",
    "object_reconstruction",
    "positional_latent_loss",
    "symlog_reconstruction",
    "temporal_pairs",
]
