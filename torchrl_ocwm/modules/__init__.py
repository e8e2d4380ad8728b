"""What predicts: encoders, world models, goals, imagined rewards, the imagination environment, acting."""

from torchrl_ocwm.modules.acting import ActingLatent
from torchrl_ocwm.modules.actor import BoundedNormalActor, CategoricalActor
from torchrl_ocwm.modules.architecture import Architecture
from torchrl_ocwm.modules.ensemble import DisagreementReward, OneStepEnsemble, disagreement
from torchrl_ocwm.modules.future_goals import FutureGoals
from torchrl_ocwm.modules.goals import FrameGoals, GivenGoals, MixedGoals, UniformGoals, UnitRMS
from torchrl_ocwm.modules.imagination import ImaginationEnv
from torchrl_ocwm.modules.latent import FullLatent, InitialLatent, LatentOfImages, LatentsInImages
from torchrl_ocwm.modules.normalization import MovingCentre, StreamingNorm
from torchrl_ocwm.modules.object_world_model import ObjectWorldModel
from torchrl_ocwm.modules.objects import LatentPositionalEncoder, ObjectDecoder, ObjectLatentExtractor
from torchrl_ocwm.modules.observation import ObservationEncoder
from torchrl_ocwm.modules.particles import EntropyReward, particle_entropy
from torchrl_ocwm.modules.rewards import (
    FullLatentReward,
    LatentSimilarityReward,
    PositionDistance,
    PositionDistanceReward,
    position_distance,
)
from torchrl_ocwm.modules.temporal_distance import TemporalDistance, TemporalDistanceReward
from torchrl_ocwm.modules.units import WorkspaceUnits
from torchrl_ocwm.modules.world_model import FlatWorldModel, RSSMWorldModel

__all__ = [
    "ActingLatent",
    "Architecture",
    "BoundedNormalActor",
    "CategoricalActor",
    "DisagreementReward",
    "EntropyReward",
    "FlatWorldModel",
    "FrameGoals",
    "FullLatent",
    "FullLatentReward",
    "FutureGoals",
    "GivenGoals",
    "ImaginationEnv",
    "InitialLatent",
    "LatentOfImages",
    "LatentPositionalEncoder",
    "LatentSimilarityReward",
    "LatentsInImages",
    "MixedGoals",
    "MovingCentre",
    "ObjectDecoder",
    "ObjectLatentExtractor",
    "ObjectWorldModel",
    "ObservationEncoder",
    "OneStepEnsemble",
    "PositionDistance",
    "PositionDistanceReward",
    "RSSMWorldModel",
    "StreamingNorm",
    "TemporalDistance",
    "TemporalDistanceReward",
    "UniformGoals",
    "UnitRMS",
    "WorkspaceUnits",
    "disagreement",
    "particle_entropy",
    "position_distance",
]
