"""What an evaluation draws and films."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_ocwm.agents import Agent, Policy
from torchrl_ocwm.envs import Task, environment_of, make_scene
from torchrl_ocwm.evaluation import (
    Report,
    WriteVideo,
    decode_video,
    draw_errors,
    episode_records,
    heatmap,
    imagined_rollout,
    learning_curves,
    mark,
    object_errors,
    picture_objects,
    predict_objects,
    tile,
    write_video,
)
from torchrl_ocwm.modules import ObjectWorldModel
from torchrl_ocwm.recipes.scores import IMAGE_GOALS
from torchrl_ocwm.training import CHECKPOINT

CONTEXT = 5  # frames that are seen before the objects are imagined
FILMS = {"": "episodes.mp4", IMAGE_GOALS: "episodes_image_goals.mp4"}
CURVES = {
    "evaluation/final_score": "final score, landmark goals",
    "return_high": "imagined return, 95th percentile",
    "loss_model_object_position": "object position loss",
    "loss_model_pixels": "image loss",
}


def draw(report: Report, task: Task, output: Path) -> list[str]:
    """Scores over the workspace, and how the agents of each row learnt, if that was logged; names of the files."""
    heatmap(output / "heatmap.png", report.per_goal("final_score"), task.workspace, title="final score")
    runs: dict[str, list[Path]] = {}
    for name, row in report.rows.items():
        runs.setdefault(name.removesuffix(IMAGE_GOALS), _folders(row.sources))
    learnt = learning_curves(output / "learning_curve.png", runs, CURVES)
    return ["heatmap.png", *["learning_curve.png"] * bool(learnt)]


def film(
    policy: Policy,
    episodes: TensorDictBase,
    goals: Tensor,
    seed: int,
    file: Path,
    images: Tensor | None = None,
    *,
    write: WriteVideo = write_video,
) -> None:
    """A few of the episodes that were scored: what happened, the goal as a cross.

    Below, what the agent imagined would happen, from the first frame.
    Above both the goal image, where the agent was given one.
    """
    task = policy.agent.task
    latents = imagined_rollout(policy.behaviour, episodes["latent"][:, 0], episodes.shape[1], seed=seed)["latent"]
    imagined = decode_video(policy.agent.model, latents)
    with closing(make_scene(environment_of(task), **task.options)) as scene:
        points = torch.as_tensor(scene.project(goals.numpy()))
    rows = [mark(episodes["transition", "next", "pixels"], points), mark(imagined, points)]
    if images is not None:
        rows.insert(0, images.unsqueeze(1).expand_as(rows[0]))
    write(file, tile(rows))


def picture_episodes(
    agent: Agent, episodes: TensorDictBase, output: Path, *, write: WriteVideo = write_video
) -> tuple[str, ...]:
    """What an object-centric world model sees and imagines of the objects in these episodes; names of the files."""
    if not isinstance(agent.model, ObjectWorldModel):
        return ()
    records = episode_records(episodes)
    context = min(CONTEXT, records.shape[1] - 1)
    views = predict_objects(agent.model, records, context)
    picture_objects(output, records, views, context, agent.task.objects, write=write)
    draw_errors(output / "errors.png", object_errors(agent.model, records, context, views=views), agent.task.objects)
    return ("objects.png", "objects.mp4", "errors.png")


def _folders(sources: list[str | Path]) -> list[Path]:
    """Where the runs of a row logged; random actions have no run."""
    return [Path(source).parent for source in sources if str(source).endswith(CHECKPOINT)]
