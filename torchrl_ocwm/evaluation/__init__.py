"""How well it did: goals in a grid, scores, errors of a world model, reports, pictures and videos.

Needs the extra ``recipes``. What draws and films is imported when it is asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchrl_ocwm.evaluation.episodes import (
    EvaluationEnvs,
    Footage,
    episode_records,
    goal_images,
    measure,
    transition,
)
from torchrl_ocwm.evaluation.goal_latents import latent_pairs, match
from torchrl_ocwm.evaluation.html import write_html
from torchrl_ocwm.evaluation.imagined import imagined_distance, imagined_rollout, predicted_return
from torchrl_ocwm.evaluation.landmarks import LandmarkEvaluation, can_play
from torchrl_ocwm.evaluation.objects import object_errors, predict_latents, predict_objects
from torchrl_ocwm.evaluation.open_loop import posterior, random_sequences
from torchrl_ocwm.evaluation.output import writing
from torchrl_ocwm.evaluation.reconstruction import ReconstructionError
from torchrl_ocwm.evaluation.report import Report, to_json
from torchrl_ocwm.evaluation.scores import mean_and_error, normalized_score
from torchrl_ocwm.evaluation.settings import Diagnosis, Evaluation
from torchrl_ocwm.lazy import lazily

if TYPE_CHECKING:
    from torchrl_ocwm.evaluation.object_pictures import draw_errors, draw_goal_latents, picture_objects
    from torchrl_ocwm.evaluation.plots import heatmap, learning_curves, metric_lines, save_figure
    from torchrl_ocwm.evaluation.videos import (
        OpenLoopFilm,
        WriteVideo,
        check_ffmpeg,
        decode_video,
        mark,
        tile,
        videos_beside,
        write_video,
    )

__all__ = [
    "Diagnosis",
    "Evaluation",
    "EvaluationEnvs",
    "Footage",
    "LandmarkEvaluation",
    "OpenLoopFilm",
    "ReconstructionError",
    "Report",
    "WriteVideo",
    "can_play",
    "check_ffmpeg",
    "decode_video",
    "draw_errors",
    "draw_goal_latents",
    "episode_records",
    "goal_images",
    "heatmap",
    "imagined_distance",
    "imagined_rollout",
    "latent_pairs",
    "learning_curves",
    "mark",
    "match",
    "mean_and_error",
    "measure",
    "metric_lines",
    "normalized_score",
    "object_errors",
    "picture_objects",
    "posterior",
    "predict_latents",
    "predict_objects",
    "predicted_return",
    "random_sequences",
    "save_figure",
    "tile",
    "to_json",
    "transition",
    "videos_beside",
    "write_html",
    "write_video",
    "writing",
]

# These need matplotlib or ffmpeg.
__getattr__ = lazily(
    __name__,
    {
        "OpenLoopFilm": "videos",
        "WriteVideo": "videos",
        "check_ffmpeg": "videos",
        "decode_video": "videos",
        "draw_errors": "object_pictures",
        "draw_goal_latents": "object_pictures",
        "heatmap": "plots",
        "learning_curves": "plots",
        "mark": "videos",
        "metric_lines": "plots",
        "picture_objects": "object_pictures",
        "save_figure": "plots",
        "tile": "videos",
        "videos_beside": "videos",
        "write_video": "videos",
    },
)
