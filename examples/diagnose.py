"""Look into a world model: ``python examples/diagnose.py checkpoint=.../checkpoint.zip dataset=data/reacher``.

How well it sees and imagines masks and positions of the objects, and whether goal latents match what they stand for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import Agent
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
    random_sequences,
    to_json,
    writing,
)
from torchrl_ocwm.modules import ObjectWorldModel
from torchrl_ocwm.recipes import recipe
from torchrl_ocwm.settings import to_dict
from torchrl_ocwm.signals import ended_by_signals

GOALS = {
    "cosine": ("cosine", 3),
    "cosine_with_others": ("cosine with others", 3),
    "median_rank": ("median rank", 1),
    "mean_rank": ("mean rank", 2),
    "ranked_first": ("ranked first", 2),
    "distance": ("distance of the best match, m", 4),
    "distance_to_others": ("distance of others, m", 4),
}


@dataclass(frozen=True, kw_only=True)
class Diagnose(Diagnosis):
    """Settings of the recipe.

    Args:
        checkpoint: Checkpoint of the agent whose world model is examined.
        dataset: Folder of a dataset of the same task.
        output: Folder for table, numbers, pictures and video.
    """

    checkpoint: str
    dataset: str
    output: str = "outputs/diagnosis"


@recipe("diagnose")
@ended_by_signals()
def main(config: Diagnose) -> None:
    settings, output = config, Path(config.output)
    if settings.video_sequences:
        check_ffmpeg("video_sequences")
    agent = load_agent(config.checkpoint, device=settings.device).agent
    records = _records(Path(config.dataset), config.checkpoint, agent.task, settings)
    torch.manual_seed(settings.seed)
    errors, goals = _errors(agent, records, settings, output), _goals(agent, records, settings, output)
    table = "\n\n".join(part for part in (_error_table(errors, agent.task.objects), _goal_table(goals)) if part)
    numbers = {"settings": to_dict(config), "objects": agent.task.objects, "errors": errors, "goal_latents": goals}
    with writing(output / "diagnosis.json") as file:
        file.write_text(to_json(numbers))
    with writing(output / "diagnosis.md") as file:
        file.write_text(table + "\n")
    print(table)
    print(f"\ntable, numbers, pictures: {output}")


def _records(path: Path, checkpoint: str, task: Task, settings: Diagnosis) -> TensorDictBase:
    dataset = EpisodeDataset.open(path)
    there = dataset.task
    if there != task:
        raise DatasetError(f"{dataset.path}: holds {there}, but the agent in {checkpoint} is of {task}")
    records = random_sequences(dataset, settings.sequences, settings.length, seed=settings.seed)
    return records.to(settings.device)


def _errors(agent: Agent, records: TensorDictBase, settings: Diagnosis, output: Path) -> dict[str, dict[str, Tensor]]:
    """Masks and positions; the pictures of each object, if the world model has any."""
    model, names = agent.model, agent.task.objects
    errors = object_errors(model, records, settings.context)
    if errors["imagined"]:
        draw_errors(output / "errors.png", errors, names)
    if isinstance(model, ObjectWorldModel) and settings.video_sequences:
        picture_objects(output, model, records[: settings.video_sequences], settings.context, names)
    return errors


def _goals(agent: Agent, records: TensorDictBase, settings: Diagnosis, output: Path) -> dict[str, dict[str, float]]:
    """Goal latents of the object that is to be positioned, if the agent has such."""
    model = agent.model
    if not isinstance(model, ObjectWorldModel) or model.positional_encoder is None:
        return {}
    index = agent.policy().object_index
    pairs, positions = latent_pairs(model, records, frames=settings.frames, object_index=index, seed=settings.seed)
    draw_goal_latents(output / "goal_latents.png", pairs, positions)
    return {name: match(*pair, positions) for name, pair in pairs.items()}


def _error_table(errors: dict[str, dict[str, Tensor]], names: tuple[str, ...]) -> str:
    """Rows: object, view and a few steps; columns: overlap of masks, median and quartiles of the position error."""
    if not errors["imagined"]:
        return ""
    steps = next(iter(errors["imagined"].values())).shape[-1]
    shown = sorted({1, math.ceil(steps / 3), steps})
    lines = ["| object | view | step | mask IoU | position error, m | quartiles |", "|---|---|---|---|---|---|"]
    for index, name in enumerate(names):
        for view, curves in errors.items():
            for step in shown:
                at = {key: float(values[index, step - 1]) for key, values in curves.items()}
                overlap = f"{at['mask_overlap']:.2f}" if "mask_overlap" in at else "–"
                error = f"{at['median']:.4f} | {at['lower']:.4f} to {at['upper']:.4f}" if "median" in at else "– | –"
                lines.append(f"| {name} | {view} | {step} | {overlap} | {error} |")
    return "\n".join(lines)


def _goal_table(goals: dict[str, dict[str, float]]) -> str:
    if not goals:
        return ""
    titles = [title for title, _ in GOALS.values()]
    lines = ["| goal, compared with | " + " | ".join(titles) + " |", "|---|" + "---|" * len(titles)]
    for name, values in goals.items():
        cells = [f"{values[key]:.{digits}f}" for key, (_, digits) in GOALS.items()]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
