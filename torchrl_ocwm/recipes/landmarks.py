"""The evaluations of a training, by its settings."""

from __future__ import annotations

import warnings
from contextlib import AbstractContextManager, nullcontext

from torchrl_ocwm.agents import Agent
from torchrl_ocwm.evaluation import LandmarkEvaluation, can_play
from torchrl_ocwm.training import Training, evaluates_beside


def landmark_evaluation(agent: Agent, training: Training) -> AbstractContextManager[LandmarkEvaluation | None]:
    """What evaluates an agent while it is trained; nothing if that is not asked for, or there is nothing to score.

    It checks whether it can do its work when it is made.
    """
    if not training.eval_interval or not can_play(agent.task):
        return nullcontext()
    if not agent.task.workspace.landmarks:
        warnings.warn(
            f"no evaluations during training: the workspace of {agent.task.name!r} has no landmark goals; "
            "ocwm evaluate scores an agent on a grid of goals, and training.eval_interval=0 silences this",
            stacklevel=2,
        )
        return nullcontext()
    return LandmarkEvaluation(
        agent,
        episodes=training.eval_episodes,
        episode_steps=training.eval_steps,
        beside=evaluates_beside(training, agent.size),
    )
