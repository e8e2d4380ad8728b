"""How well it did: goals in a grid, scores, reconstruction errors, reports, pictures and videos.

Needs the extra ``recipes``; ``plots`` and ``videos`` are imported from their modules.
"""

from torchrl_ocwm.evaluation.episodes import EvaluationEnvs, episode_records, goal_images, measure, transition
from torchrl_ocwm.evaluation.imagined import imagined_distance, imagined_rollout
from torchrl_ocwm.evaluation.landmarks import LandmarkEvaluation
from torchrl_ocwm.evaluation.reconstruction import ReconstructionError
from torchrl_ocwm.evaluation.report import Report
from torchrl_ocwm.evaluation.scores import mean_and_error, normalized_score

__all__ = [
    "EvaluationEnvs",
    "LandmarkEvaluation",
    "ReconstructionError",
    "Report",
    "episode_records",
    "goal_images",
    "imagined_distance",
    "imagined_rollout",
    "mean_and_error",
    "measure",
    "normalized_score",
    "transition",
]
