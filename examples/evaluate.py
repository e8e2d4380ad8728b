"""Evaluate agents on a grid of goals: ``python examples/evaluate.py checkpoint=.../checkpoint.zip goals=100``.

``checkpoint='[a/checkpoint.zip,b/checkpoint.zip]'`` evaluates several; those of one agent count as its seeds.
"""

from __future__ import annotations

from pathlib import Path

import gymnasium
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import Agent, Policy, agent_name
from torchrl_ocwm.data import SmoothRandomPolicy
from torchrl_ocwm.envs import ENVIRONMENTS, Task
from torchrl_ocwm.evaluation import (
    EvaluationEnvs,
    ReconstructionError,
    Report,
    episode_records,
    goal_images,
    imagined_distance,
    imagined_rollout,
    measure,
    transition,
)
from torchrl_ocwm.evaluation.object_pictures import draw_errors, picture_objects
from torchrl_ocwm.evaluation.objects import object_errors
from torchrl_ocwm.evaluation.plots import heatmap, learning_curves
from torchrl_ocwm.evaluation.videos import decode_video, mark, tile, write_video
from torchrl_ocwm.modules import ObjectWorldModel
from torchrl_ocwm.training.config import recipe
from torchrl_ocwm.training.offline import CHECKPOINT

CONTEXT = 5  # frames that are seen before the objects are imagined
IMAGE_GOALS = ", image goals"
CURVES = {
    "evaluation/final_score": "final score, landmark goals",
    "return_high": "imagined return, 95th percentile",
    "loss_model_object_position": "object position loss",
    "loss_model_pixels": "image loss",
}


@recipe(Path(__file__).parent / "config", "evaluate")
def main(config: DictConfig) -> None:
    files = [Path(one) for one in ([config.checkpoint] if isinstance(config.checkpoint, str) else config.checkpoint)]
    policies = [load_agent(file) for file in files]
    task = _one_task(policies, files)
    size = round(config.goals**0.5)
    if size * size != config.goals or size < 1:
        raise ValueError(f"goals={config.goals} is not a square grid; try {size * size}")
    goals = task.workspace.grid(size).flatten(0, 1)
    images = goal_images(task, goals) if config.image_goals else None
    output = Path(config.output)
    report = Report(goals, {key: config[key] for key in ("goals", "episode_steps", "seed")})
    for file in config.include:
        report.include(Report.load(file))
    torch.manual_seed(config.seed)
    envs = EvaluationEnvs(
        task, episode_steps=config.episode_steps, workers=config.workers, envs=min(config.envs, config.goals)
    )
    with envs:
        if config.random:
            report.add("random", measure(envs.run(SmoothRandomPolicy(task.action), goals)), source="smooth actions")
        for policy, file in zip(policies, files, strict=True):
            name = agent_name(policy.agent.config)
            report.add(name, _evaluate(policy, envs, goals, config.seed), source=str(file))
            if images is not None and policy.takes_images:
                seen = _evaluate(policy, envs, goals, config.seed, images)
                report.add(name + IMAGE_GOALS, seen, source=str(file))
        report.save(output)
        heatmap(output / "heatmap.png", report.per_goal("final_score"), task.workspace, title="final score")
        if config.video_goals:
            chosen = torch.linspace(0, len(goals) - 1, config.video_goals).round().long()
            episodes = _film(policies[-1], envs, goals[chosen], output / "episodes.mp4")
            _picture_objects(policies[-1].agent, episodes, output)
            if images is not None and policies[-1].takes_images:
                _film(policies[-1], envs, goals[chosen], output / "episodes_image_goals.mp4", images[chosen])
    runs = {name: _folders(sources) for name, sources in report.sources.items() if not name.endswith(IMAGE_GOALS)}
    learning_curves(output / "learning_curve.png", runs, CURVES)
    print(report.markdown())
    print(f"\ntable, numbers, heatmap, learning curve, videos: {output}")


def _one_task(policies: list[Policy], files: list[Path]) -> Task:
    tasks = [policy.agent.task for policy in policies]
    for task, file in zip(tasks, files, strict=True):
        if task != tasks[0]:
            raise ValueError(f"{file} is of {task}, {files[0]} of {tasks[0]}; evaluate them one after the other")
    return tasks[0]


def _folders(sources: list[str]) -> list[Path]:
    """Where the runs of a row logged; random actions have no run."""
    return [Path(source).parent for source in sources if source.endswith(CHECKPOINT)]


def _evaluate(
    policy: Policy, envs: EvaluationEnvs, goals: Tensor, seed: int, images: Tensor | None = None
) -> dict[str, Tensor]:
    reconstruct = ReconstructionError(policy.agent)

    def inspect(step: TensorDictBase) -> dict[str, Tensor | TensorDictBase]:
        return {**reconstruct(step), "latent": step["latent"].select("state", "belief", "goal", strict=False)}

    episodes = envs.run(policy, goals, images=images, seed=seed, inspect=inspect, progress=True)
    errors = {name: episodes[name].mean(1) for name in ("entity_error", "goal_error") if name in episodes}
    if "object_position" in policy.agent.config.observed:
        errors["imagined_distance"] = imagined_distance(
            policy.agent, episodes["latent"][:, 0], goals, envs.episode_steps
        )
    return {**measure(episodes), **errors}


def _film(
    policy: Policy, envs: EvaluationEnvs, goals: Tensor, file: Path, images: Tensor | None = None
) -> TensorDictBase:
    """What happened, the goal as a cross; below, what the agent imagined would happen, from the first frame.

    Above both the goal image, where the agent was given one.
    """
    task = policy.agent.task

    def inspect(step: TensorDictBase) -> dict[str, TensorDictBase]:
        return {"latent": step["latent"], **transition(step)}

    episodes = envs.run(policy, goals, images=images, inspect=inspect)
    latents = imagined_rollout(policy.agent, episodes["latent"][:, 0], envs.episode_steps)["latent"]
    imagined = decode_video(policy.agent.model, latents)
    with gymnasium.make(ENVIRONMENTS[task.name].id, **task.options) as env:
        points = torch.as_tensor(env.unwrapped.project(goals.numpy()))
    rows = [mark(episodes["transition", "next", "pixels"], points), mark(imagined, points)]
    if images is not None:
        rows.insert(0, images.unsqueeze(1).expand_as(rows[0]))
    write_video(file, tile(rows))
    return episodes


def _picture_objects(agent: Agent, episodes: TensorDictBase, output: Path) -> None:
    """What an object-centric world model sees and imagines of the objects in these episodes."""
    if isinstance(agent.model, ObjectWorldModel):
        records = episode_records(episodes)
        context = min(CONTEXT, records.shape[1] - 1)
        picture_objects(output, agent.model, records, context, agent.task.objects)
        draw_errors(output / "errors.png", object_errors(agent.model, records, context), agent.task.objects)


if __name__ == "__main__":
    main()
