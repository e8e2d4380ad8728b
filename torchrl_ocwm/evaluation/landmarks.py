"""Quick scores while an agent is trained."""

from __future__ import annotations

import torch

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.evaluation.episodes import EvaluationEnvs, goal_images, measure
from torchrl_ocwm.settings import SettingsError


class LandmarkEvaluation:
    """Evaluate an agent on its task's landmark goals, in this process.

    An agent that takes goals as images only is given images of them.

    The paper draws its training curves with episodes to random ones of ten such goals. The environments are made at the
    first call and kept until it is closed.

    Args:
        agent: The agent in training.
        episodes: Episodes, to as many of the landmarks, drawn anew at each call.
        episode_steps: Steps of each.

    Raises:
        SettingsError: if there are more episodes than landmarks.
    """

    def __init__(self, agent: Agent, *, episodes: int, episode_steps: int) -> None:
        landmarks = agent.task.workspace.landmarks
        if episodes > len(landmarks):
            raise SettingsError(f"eval_episodes={episodes}, but {agent.task.name} has {len(landmarks)} landmark goals")
        self.policy, self.goals, self.episodes = agent.policy(), torch.tensor(landmarks), episodes
        self.images = (
            None
            if self.policy.takes_positions
            else goal_images(agent.task, self.goals, object_index=self.policy.object_index)
        )
        self.envs = EvaluationEnvs(agent.task, episode_steps=episode_steps, workers=0, envs=episodes)

    def __call__(self, updates: int) -> dict[str, float]:
        """Scores to log; the number of updates decides which landmarks are drawn."""
        chosen = torch.randperm(len(self.goals), generator=torch.Generator().manual_seed(updates))
        chosen = chosen[: self.episodes].sort().values
        images = None if self.images is None else self.images[chosen]
        episodes = self.envs.run(self.policy, self.goals[chosen], images=images, numbers=chosen)
        scores = measure(episodes, object_index=self.policy.object_index)
        return {f"evaluation/{name}": float(values.nanmean()) for name, values in scores.items()}

    def close(self) -> None:
        """Close the environments; a later call makes them again."""
        self.envs.close()

    def __enter__(self) -> LandmarkEvaluation:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
