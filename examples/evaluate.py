"""Evaluate agents on a grid of goals: ``python examples/evaluate.py checkpoint=.../checkpoint.zip goals=100``.

``checkpoint='[a/checkpoint.zip,b/checkpoint.zip]'`` evaluates several; those of one agent count as its seeds.
"""

from __future__ import annotations

from pathlib import Path

import gymnasium
import torch
from omegaconf import DictConfig
from torch import Tensor

from torchrl_ocwm import load_agent
from torchrl_ocwm.agents import Policy, agent_name
from torchrl_ocwm.data import SmoothRandomPolicy
from torchrl_ocwm.envs import ENVIRONMENTS, Task
from torchrl_ocwm.evaluation import EvaluationEnvs, ReconstructionError, Report, measure
from torchrl_ocwm.evaluation.plots import heatmap, learning_curves
from torchrl_ocwm.evaluation.videos import imagined_rollout, mark, tile, write_video
from torchrl_ocwm.training.config import recipe

CURVES = {
    "evaluation/final_score": "final score, landmark goals",
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
    output = Path(config.output)
    report = Report(goals, {key: config[key] for key in ("goals", "episode_steps", "seed")})
    torch.manual_seed(config.seed)
    envs = EvaluationEnvs(
        task, episode_steps=config.episode_steps, workers=config.workers, envs=min(config.envs, config.goals)
    )
    with envs:
        if config.random:
            report.add("random", measure(envs.run(SmoothRandomPolicy(task.action), goals)), source="smooth actions")
        for policy, file in zip(policies, files, strict=True):
            report.add(agent_name(policy.agent.config), _evaluate(policy, envs, goals, config.seed), source=str(file))
        report.save(output)
        heatmap(output / "heatmap.png", report.per_goal("final_score"), task.workspace, title="final score")
        if config.video_goals:
            _film(policies[-1], envs, goals, config.video_goals, output / "episodes.mp4")
    runs: dict[str, list[Path]] = {}
    for policy, file in zip(policies, files, strict=True):
        runs.setdefault(agent_name(policy.agent.config), []).append(file.parent)
    learning_curves(output / "learning_curve.png", runs, CURVES)
    print(report.markdown())
    print(f"\ntable, numbers, heatmap.png, learning_curve.png, episodes.mp4: {output}")


def _one_task(policies: list[Policy], files: list[Path]) -> Task:
    tasks = [policy.agent.task for policy in policies]
    for task, file in zip(tasks, files, strict=True):
        if task != tasks[0]:
            raise ValueError(f"{file} is of {task}, {files[0]} of {tasks[0]}; evaluate them one after the other")
    return tasks[0]


def _evaluate(policy: Policy, envs: EvaluationEnvs, goals: Tensor, seed: int) -> dict[str, Tensor]:
    episodes = envs.run(policy, goals, seed=seed, inspect=ReconstructionError(policy.agent), progress=True)
    errors = {name: episodes[name].mean(1) for name in ("entity_error", "goal_error") if name in episodes}
    return {**measure(episodes), **errors}


def _film(policy: Policy, envs: EvaluationEnvs, goals: Tensor, count: int, file: Path) -> None:
    """Above: what happened, the goal as a cross. Below: what the agent imagined would happen, from the first frame."""
    task = policy.agent.task
    chosen = goals[torch.linspace(0, len(goals) - 1, count).round().long()]
    episodes = envs.run(policy, chosen, keep=("pixels",), inspect=lambda step: {"latent": step["latent"]})
    imagined = imagined_rollout(policy.agent, episodes["latent"][:, 0], envs.episode_steps)
    with gymnasium.make(ENVIRONMENTS[task.name].id, **task.options) as env:
        points = torch.as_tensor(env.unwrapped.project(chosen.numpy()))
    write_video(file, tile([mark(episodes["pixels"], points), mark(imagined, points)]))


if __name__ == "__main__":
    main()
