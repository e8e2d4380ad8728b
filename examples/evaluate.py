"""Evaluate agents on a grid of goals: ``python examples/evaluate.py checkpoint=.../checkpoint.zip goals=100``.

``checkpoint='[a/checkpoint.zip,b/checkpoint.zip]'`` evaluates several; those of one agent count as its seeds.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import Agent, Policy, agent_file, agent_name, describe
from torchrl_ocwm.data import SmoothRandomPolicy
from torchrl_ocwm.envs import Task, find_environment, make_scene
from torchrl_ocwm.evaluation import (
    Evaluation,
    EvaluationEnvs,
    Footage,
    ReconstructionError,
    Report,
    check_ffmpeg,
    decode_video,
    draw_errors,
    episode_records,
    goal_images,
    heatmap,
    imagined_distance,
    imagined_rollout,
    learning_curves,
    mark,
    measure,
    object_errors,
    picture_objects,
    predicted_return,
    tile,
    write_video,
)
from torchrl_ocwm.modules import ObjectWorldModel
from torchrl_ocwm.recipes import recipe
from torchrl_ocwm.settings import SettingsError
from torchrl_ocwm.signals import ended_by_signals
from torchrl_ocwm.training import CHECKPOINT

CONTEXT = 5  # frames that are seen before the objects are imagined
IMAGE_GOALS = ", image goals"  # after the name of a row; without it goals are positions
FILMS = {"": "episodes.mp4", IMAGE_GOALS: "episodes_image_goals.mp4"}
CURVES = {
    "evaluation/final_score": "final score, landmark goals",
    "return_high": "imagined return, 95th percentile",
    "loss_model_object_position": "object position loss",
    "loss_model_pixels": "image loss",
}


@dataclass(frozen=True, kw_only=True)
class Evaluate(Evaluation):
    """Settings of the recipe.

    Args:
        checkpoint: Checkpoint or trained agent, as ``load_agent`` takes it, or list of them: those of one agent count
            as its seeds, each agent is a row.
        include: ``results.json`` of earlier evaluations with the same goals and settings, whose rows come first.
        output: Folder for table, numbers, heatmaps, learning curve and video.
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
    settings = config
    if settings.video_goals:
        check_ffmpeg("video_goals")
    files = [
        agent_file(one) for one in ([config.checkpoint] if isinstance(config.checkpoint, str) else config.checkpoint)
    ]
    policies = [load_agent(file, behaviour=settings.behaviour) for file in files]
    task, about, output = _one_task(policies, files), policies[0].object_index, Path(config.output)
    goals = task.workspace.grid(settings.grid_size).flatten(0, 1)
    images = None
    if settings.image_goals or not all(policy.takes_positions for policy in policies):
        images = goal_images(task, goals, object_index=about)
    report = _report(goals, settings, config.include, {"object": task.objects[about]} if about else {})
    runs = _runs(files, policies, report)
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
            for kind in _goal_kinds(policy, settings.image_goals):
                seen = images if kind == IMAGE_GOALS else None
                footage[kind] = Footage(chosen)  # in the end that of the last policy
                scores = _evaluate(policy, envs, goals, settings.seed, seen, footage[kind])
                report.add(name + kind, scores, **run)
    report.save(output)
    print(report.markdown())
    _draw(report, task, output)
    if settings.video_goals:
        films = {kind: footage[kind].episodes() for kind in _goal_kinds(policies[-1], settings.image_goals)}
        for kind, episodes in films.items():
            seen = images[chosen] if images is not None and kind == IMAGE_GOALS else None
            _film(policies[-1], episodes, goals[chosen], settings.seed, output / FILMS[kind], seen)
        _picture_objects(policies[-1].agent, next(iter(films.values())), output)
    print(f"\ntable, numbers, heatmap, learning curve, videos: {output}")


def _goal_kinds(policy: Policy, image_goals: bool) -> list[str]:
    """What goals a policy is evaluated with, by the end of its row's name: images too, or if it takes nothing else."""
    positions = [""] if policy.takes_positions else []
    return positions + [IMAGE_GOALS] * (policy.takes_images and (image_goals or not positions))


def _report(goals: Tensor, settings: Evaluation, include: Sequence[str], more: dict[str, Any]) -> Report:
    """An empty report, or one with the rows of earlier ones."""
    kept = {"goals": settings.goals, "episode_steps": settings.episode_steps, "seed": settings.seed, **more}
    report = Report(goals, {**kept, "starts": "by goal"})  # earlier releases: by place among the environments
    for file in include:
        report.include(Report.load(file))
    return report


def _runs(files: list[Path], policies: list[Policy], report: Report) -> list[dict[str, str]]:
    """What a report keeps of each checkpoint: where it is, what is in it, and of what kind its agent is.

    Raises:
        SettingsError: for one that would count twice.
    """
    seen = {run: source for row in report.rows.values() for run, source in zip(row.runs, row.sources, strict=True)}
    runs = []
    for file, policy in zip(files, policies, strict=True):
        run = sha256(file.read_bytes()).hexdigest()
        if run in seen:
            raise SettingsError(f"{file}: the same run as {seen[run]}, which counts already; leave one of them out")
        seen[run] = str(file)
        kind = sha256(json.dumps(describe(policy.agent), sort_keys=True).encode()).hexdigest()
        runs.append({"source": str(file), "run": run, "kind": kind})
    return runs


def _draw(report: Report, task: Task, output: Path) -> None:
    """Scores over the workspace, and how the agents of each row learnt."""
    heatmap(output / "heatmap.png", report.per_goal("final_score"), task.workspace, title="final score")
    runs: dict[str, list[Path]] = {}
    for name, row in report.rows.items():
        runs.setdefault(name.removesuffix(IMAGE_GOALS), _folders(row.sources))
    learning_curves(output / "learning_curve.png", runs, CURVES)


def _one_task(policies: list[Policy], files: list[Path]) -> Task:
    """The task of all of them; scores of different objects are not to be compared either."""
    tasks = [(policy.agent.task, policy.object_index) for policy in policies]
    for (task, index), file in zip(tasks, files, strict=True):
        if (task, index) != tasks[0]:
            this, first = (f"the {one.objects[number]!r} of {one}" for one, number in ((task, index), tasks[0]))
            raise SettingsError(f"{file} is about {this}, {files[0]} about {first}; evaluate them one after the other")
    return tasks[0][0]


def _folders(sources: list[str]) -> list[Path]:
    """Where the runs of a row logged; random actions have no run."""
    return [Path(source).parent for source in sources if source.endswith(CHECKPOINT)]


def _evaluate(
    policy: Policy, envs: EvaluationEnvs, goals: Tensor, seed: int, images: Tensor | None, footage: Footage
) -> dict[str, Tensor]:
    reconstruct = ReconstructionError(policy.agent, object_index=policy.object_index)

    def inspect(step: TensorDictBase) -> dict[str, Tensor | TensorDictBase]:
        footage(step)
        return {**reconstruct(step), "latent": step["latent"].select("state", "belief", "goal", strict=False)}

    episodes = envs.run(policy, goals, images=images, seed=seed, inspect=inspect, progress=True)
    errors = {name: episodes[name].mean(1) for name in ("entity_error", "goal_error") if name in episodes}
    if "object_position" in policy.agent.model.decoded:
        errors["imagined_distance"] = imagined_distance(
            policy.behaviour,
            episodes["latent"][:, 0],
            goals,
            envs.episode_steps,
            object_index=policy.object_index,
            seed=seed,
        )
    if "reward_head" in policy.behaviour.config.reward.needs:  # which learns the rewards of the environment
        gamma, reward = policy.agent.size.learning.gamma, episodes["reward"].squeeze(-1)
        errors["predicted_return"] = predicted_return(policy.behaviour, episodes["latent"][:, 0])
        errors["obtained_return"] = (reward * gamma ** torch.arange(reward.shape[1])).sum(1)
    return {**measure(episodes, object_index=policy.object_index), **errors}


def _film(
    policy: Policy, episodes: TensorDictBase, goals: Tensor, seed: int, file: Path, images: Tensor | None = None
) -> None:
    """A few of the episodes that were scored: what happened, the goal as a cross.

    Below, what the agent imagined would happen, from the first frame.
    Above both the goal image, where the agent was given one.
    """
    task = policy.agent.task
    latents = imagined_rollout(policy.behaviour, episodes["latent"][:, 0], episodes.shape[1], seed=seed)["latent"]
    imagined = decode_video(policy.agent.model, latents)
    with closing(make_scene(find_environment(task.name), **task.options)) as scene:
        points = torch.as_tensor(scene.project(goals.numpy()))
    rows = [mark(episodes["transition", "next", "pixels"], points), mark(imagined, points)]
    if images is not None:
        rows.insert(0, images.unsqueeze(1).expand_as(rows[0]))
    write_video(file, tile(rows))


def _picture_objects(agent: Agent, episodes: TensorDictBase, output: Path) -> None:
    """What an object-centric world model sees and imagines of the objects in these episodes."""
    if isinstance(agent.model, ObjectWorldModel):
        records = episode_records(episodes)
        context = min(CONTEXT, records.shape[1] - 1)
        picture_objects(output, agent.model, records, context, agent.task.objects)
        draw_errors(output / "errors.png", object_errors(agent.model, records, context), agent.task.objects)


if __name__ == "__main__":
    main()
