"""Evaluate agents on a grid of goals: ``ocwm evaluate checkpoint=.../checkpoint.zip goals=100``.

``checkpoint='[a/checkpoint.zip,b/checkpoint.zip]'`` evaluates several; those of one agent count as its seeds.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import Policy, agent_file, agent_name, describe
from torchrl_ocwm.data import SmoothRandomPolicy
from torchrl_ocwm.envs import Task
from torchrl_ocwm.evaluation import (
    Evaluation,
    EvaluationEnvs,
    Footage,
    Report,
    check_ffmpeg,
    goal_images,
    measure,
    videos_beside,
    write_html,
)
from torchrl_ocwm.recipes.config import kept, recipe
from torchrl_ocwm.recipes.pictures import FILMS, draw, film, picture_episodes
from torchrl_ocwm.recipes.scores import IMAGE_GOALS, goal_kinds, score
from torchrl_ocwm.settings import SettingsError, differences
from torchrl_ocwm.signals import ended_by_signals


@dataclass(frozen=True, kw_only=True)
class Evaluate(Evaluation):
    """Settings of the recipe.

    Args:
        checkpoint: Checkpoint or trained agent, as ``load_agent`` takes it, or list of them: those of one agent count
            as its seeds, each agent is a row.
        include: ``results.json`` of earlier evaluations with the same goals and settings, whose rows come first.
        output: Folder for table, numbers, heatmap, learning curve, videos, and a page with all of them.
    """

    checkpoint: str | tuple[str, ...]
    include: tuple[str, ...] = ()
    output: str = "outputs/evaluation"

    def validate(self) -> None:
        """There is something to evaluate."""
        super().validate()
        if not self.checkpoint:
            raise SettingsError(f"checkpoint must name a file or several, got {self.checkpoint!r}")


@recipe("evaluate")
@ended_by_signals()
def main(config: Evaluate) -> None:
    """Play, score, draw, and write it all down."""
    settings = config
    if settings.video_goals:
        check_ffmpeg("video_goals")
    names = (config.checkpoint,) if isinstance(config.checkpoint, str) else config.checkpoint
    files = [agent_file(one) for one in names]
    policies = [load_agent(file, behaviour=settings.behaviour) for file in files]
    task, about, output = _one_task(policies, files), policies[0].object_index, Path(config.output)
    goals = task.workspace.grid(settings.grid_size).flatten(0, 1)
    images = None
    if settings.image_goals or not all(policy.takes_positions for policy in policies):
        images = goal_images(task, goals, object_index=about)
    report = _report(goals, settings, config.include, {"object": task.objects[about]} if about else {})
    runs = _runs(names, files, policies, report)
    chosen = torch.linspace(0, len(goals) - 1, min(settings.video_goals, settings.goals)).round().long()
    footage: dict[str, Footage] = {}
    with EvaluationEnvs(
        task,
        episode_steps=settings.episode_steps,
        workers=settings.workers,
        envs=settings.envs,
        timeout=settings.timeout,
    ) as envs:
        if settings.random and "random" not in report.rows:
            played = envs.run(SmoothRandomPolicy(task.action), goals, seed=settings.seed, blind=True, progress=True)
            report.add("random", measure(played, object_index=about), source="smooth actions")
        for policy, run in zip(policies, runs, strict=True):
            name = agent_name(policy.agent.config) + (f", {settings.behaviour}" if settings.behaviour else "")
            for kind in goal_kinds(policy, settings.image_goals):
                seen = images if kind == IMAGE_GOALS else None
                footage[kind] = Footage(chosen)  # in the end that of the last policy
                scores = score(policy, envs, goals, settings.seed, seen, footage[kind])
                report.add(name + kind, scores, **run)
    report.save(output)
    print(report.markdown())
    drawn = [*draw(report, task, output)]
    if settings.video_goals:
        films = {kind: footage[kind].episodes() for kind in goal_kinds(policies[-1], settings.image_goals)}
        with videos_beside() as write:
            for kind, episodes in films.items():
                seen = images[chosen] if images is not None and kind == IMAGE_GOALS else None
                film(policies[-1], episodes, goals[chosen], settings.seed, output / FILMS[kind], seen, write=write)
            drawn += [FILMS[kind] for kind in films]
            drawn += picture_episodes(policies[-1].agent, next(iter(films.values())), output, write=write)
    page = write_html(output, f"Evaluation on {task.name}", report.markdown(), drawn, kept(config, output))
    print(f"\ntable, numbers, pictures, videos: {output}; all on one page: {page}")


def _report(goals: Tensor, settings: Evaluation, include: Sequence[str], more: dict[str, Any]) -> Report:
    """An empty report, or one with the rows of earlier ones."""
    kept = {"goals": settings.goals, "episode_steps": settings.episode_steps, "seed": settings.seed, **more}
    report = Report(goals, {**kept, "starts": "by goal"})  # earlier releases: by place among the environments
    for file in include:
        report.include(Report.load(file))
    return report


def _runs(names: Sequence[str], files: list[Path], policies: list[Policy], report: Report) -> list[dict[str, Any]]:
    """What a report keeps of each checkpoint: where it is, what is in it, and of what kind its agent is.

    Raises:
        SettingsError: for one that would count twice.
    """
    seen: dict[str, str | Path] = {
        run: source for row in report.rows.values() for run, source in zip(row.runs, row.sources, strict=True)
    }
    runs = []
    for name, file, policy in zip(names, files, policies, strict=True):
        run = sha256(file.read_bytes()).hexdigest()
        if run in seen:
            raise SettingsError(f"{file}: the same run as {seen[run]}, which counts already; leave one of them out")
        seen[run] = file
        kind = sha256(json.dumps(describe(policy.agent), sort_keys=True).encode()).hexdigest()
        runs.append({"source": file if Path(name).exists() else name, "run": run, "kind": kind})
    return runs


def _one_task(policies: list[Policy], files: list[Path]) -> Task:
    """The task of all of them; scores of different objects are not to be compared either."""
    tasks = [policy.agent.task for policy in policies]
    about = [
        {"object": task.objects[policy.object_index], **task.to_dict()}
        for task, policy in zip(tasks, policies, strict=True)
    ]
    for file, one in zip(files, about, strict=True):
        if different := differences(one, about[0], "there", "here"):
            raise SettingsError(
                f"{file} is about something else than {files[0]} ({different}); evaluate them one after the other"
            )
    return tasks[0]
