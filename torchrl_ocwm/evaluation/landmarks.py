"""Quick scores while an agent is trained."""

from __future__ import annotations

import torch

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.evaluation.episodes import EvaluationEnvs, measure


class LandmarkEvaluation:
    """Evaluate an agent on its task's landmark goals, in this process.

    The paper draws its training curves with ten such goals. The environments are made at the first call and kept.

    Args:
        agent: The agent in training.
        episodes: Episodes, one to each of the first landmarks.
        episode_steps: Steps of each.

    Raises:
        ValueError: for more episodes than the task has landmarks.
    """

    def __init__(self, agent: Agent, *, episodes: int, episode_steps: int) -> None:
        landmarks = agent.task.workspace.landmarks
        if episodes > len(landmarks):
            raise ValueError(f"eval_episodes is {episodes}, but {agent.task.name} has {len(landmarks)} landmark goals")
        self.policy, self.task, self.episode_steps = agent.policy(), agent.task, episode_steps
        self.goals = torch.tensor(landmarks[:episodes])
        self.envs: EvaluationEnvs | None = None

    def __call__(self, updates: int) -> dict[str, float]:  # noqa: ARG002
        """Scores to log."""
        if self.envs is None:
            self.envs = EvaluationEnvs(self.task, episode_steps=self.episode_steps, workers=0, envs=len(self.goals))
        scores = measure(self.envs.run(self.policy, self.goals))
        return {f"evaluation/{name}": float(values.mean()) for name, values in scores.items()}
