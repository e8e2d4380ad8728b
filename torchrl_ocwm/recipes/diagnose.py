"""Look into a world model: ``ocwm diagnose checkpoint=.../checkpoint.zip dataset=data/reacher``.

How well it sees and imagines masks and positions of the objects, and whether goal latents match what they stand for.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import Agent, Policy
from torchrl_ocwm.data import DatasetError, EpisodeDataset
from torchrl_ocwm.envs import Task
from torchrl_ocwm.evaluation import (
    Diagnosis,
    check_ffmpeg,
    draw_errors,
    draw_goal_latents,
    latent_pairs,
    match,
    object_errors,
    picture_objects,
    predict_objects,
    random_sequences,
    to_json,
    write_html,
    writing,
)
from torchrl_ocwm.modules import ObjectWorldModel
from torchrl_ocwm.recipes.config import kept, recipe
from torchrl_ocwm.recipes.diagnosis_tables import error_table, goal_table
from torchrl_ocwm.settings import differences
from torchrl_ocwm.signals import ended_by_signals


@dataclass(frozen=True, kw_only=True)
class Diagnose(Diagnosis):
    """Settings of the recipe.

    Args:
        checkpoint: Checkpoint of the agent whose world model is examined.
        dataset: Folder of a dataset of the same task.
        output: Folder for table, numbers, pictures, video, and a page with all of them.
    """

    checkpoint: str
    dataset: str
    output: str = "outputs/diagnosis"


@recipe("diagnose")
@ended_by_signals()
def main(config: Diagnose) -> None:
    """Measure, draw, and write it all down."""
    settings, output = config, Path(config.output)
    if settings.video_sequences:
        check_ffmpeg("video_sequences")
    policy = load_agent(config.checkpoint, behaviour=settings.behaviour, device=settings.device)
    agent = policy.agent
    records = _records(Path(config.dataset), config.checkpoint, agent.task, settings)
    torch.manual_seed(settings.seed)
    errors, goals = _errors(agent, records, settings, output), _goals(policy, records, settings, output)
    table = "\n\n".join(part for part in (error_table(errors, agent.task.objects), goal_table(goals)) if part)
    numbers = {"objects": agent.task.objects, "errors": errors, "goal_latents": goals}
    with writing(output / "diagnosis.json") as file:
        file.write_text(to_json({"settings": kept(config, output), **numbers}), encoding="utf-8")
    with writing(output / "diagnosis.md") as file:
        file.write_text(table + "\n", encoding="utf-8")
    print(table)
    drawn = _drawn(agent, settings, imagined=bool(errors["imagined"]), latents=bool(goals))
    page = write_html(output, f"Diagnosis of a world model of {agent.task.name}", table, drawn, kept(config, output))
    print(f"\ntable, numbers, pictures: {output}; all on one page: {page}")


def _records(path: Path, checkpoint: str, task: Task, settings: Diagnosis) -> TensorDictBase:
    dataset = EpisodeDataset.open(path)
    there = dataset.task
    if there != task:
        different = differences(there, task, "in the dataset", "in that of the agent")
        raise DatasetError(f"{dataset.path}: is of another task than the agent in {checkpoint} ({different})")
    records = random_sequences(dataset, settings.sequences, settings.length, seed=settings.seed)
    return records.to(settings.device)


def _errors(agent: Agent, records: TensorDictBase, settings: Diagnosis, output: Path) -> dict[str, dict[str, Tensor]]:
    """Masks and positions; the pictures of each object, if the world model has any."""
    model, names = agent.model, agent.task.objects
    errors = object_errors(model, records, settings.context)
    if errors["imagined"]:
        draw_errors(output / "errors.png", errors, names)
    if isinstance(model, ObjectWorldModel) and settings.video_sequences:
        pictured = records[: settings.video_sequences]
        views = predict_objects(model, pictured, settings.context)
        picture_objects(output, pictured, views, settings.context, names)
    return errors


def _drawn(agent: Agent, settings: Diagnosis, *, imagined: bool, latents: bool) -> list[str]:
    """Names of the pictures and videos of this diagnosis; earlier ones may lie in the same folder."""
    objects = isinstance(agent.model, ObjectWorldModel) and settings.video_sequences > 0
    names = {"errors.png": imagined, "objects.png": objects, "objects.mp4": objects, "goal_latents.png": latents}
    return [name for name, there in names.items() if there]


def _goals(policy: Policy, records: TensorDictBase, settings: Diagnosis, output: Path) -> dict[str, dict[str, float]]:
    """Goal latents of the object that is to be positioned, if the agent has such."""
    model, index = policy.agent.model, policy.object_index
    if not isinstance(model, ObjectWorldModel) or model.positional_encoder is None:
        return {}
    pairs, positions = latent_pairs(model, records, frames=settings.frames, object_index=index, seed=settings.seed)
    draw_goal_latents(output / "goal_latents.png", pairs, positions)
    return {name: match(*pair, positions) for name, pair in pairs.items()}
