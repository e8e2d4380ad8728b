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
        ValueError: when called, if there are more episodes than landmarks.
    """

    def __init__(self, agent: Agent, *, episodes: int, episode_steps: int) -> None:
        self.policy, self.task = agent.policy(), agent.task
        self.episodes, self.episode_steps = episodes, episode_steps
        self.envs: EvaluationEnvs | None = None

    def __call__(self, updates: int) -> dict[str, float]:  # noqa: ARG002
        """Scores to log."""
        landmarks = self.task.workspace.landmarks
        if self.episodes > len(landmarks):
            raise ValueError(
                f"{self.episodes} evaluation episodes, but {self.task.name} has {len(landmarks)} landmarks"
            )
        if self.envs is None:
            self.envs = EvaluationEnvs(self.task, episode_steps=self.episode_steps, workers=0, envs=self.episodes)
        scores = measure(self.envs.run(self.policy, torch.tensor(landmarks[: self.episodes])))
        return {f"evaluation/{name}": float(values.mean()) for name, values in scores.items()}
