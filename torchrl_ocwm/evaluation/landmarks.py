"""Quick scores while an agent is trained."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from copy import deepcopy
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.envs import ENVIRONMENTS, Task, environment_of
from torchrl_ocwm.envs.registry import Environment
from torchrl_ocwm.evaluation.episodes import EvaluationEnvs, goal_images, measure
from torchrl_ocwm.processes import Worker, make_worker
from torchrl_ocwm.settings import SettingsError

_TIMEOUT = 300.0  # seconds without a step; where training uses all cores, an environment may take long to load


def can_play(task: Task) -> bool:
    """Whether a task's environment is registered, so that agents can be evaluated in it; warns if it is not.

    Examples:
        >>> from torchrl_ocwm.testing import reacher_task
        >>> can_play(reacher_task())
        True
    """
    try:
        environment_of(task)
    except SettingsError:
        warnings.warn(
            f"no evaluations during training: no environment {task.name!r} is registered, only recordings are there; "
            "diagnose examines the world model on them, and training.eval_interval=0 silences this",
            stacklevel=2,
        )
        return False
    return True


class LandmarkEvaluation:
    """Evaluate an agent on its task's landmark goals, in this process or beside it: a copy of its weights, on the CPU.

    An agent that takes goals as images only is given images of them.

    The paper draws its training curves with episodes to random ones of ten such goals. The environments are made at the
    first call and kept until it is closed.

    TorchRL's ``Evaluator`` also evaluates in a process of its own. It has no starts and no random numbers that belong
    to a goal, so its scores would not be those of :class:`EvaluationEnvs`.

    Args:
        agent: The agent in training.
        episodes: Episodes, to as many of the landmarks, drawn anew at each call.
        episode_steps: Steps of each.
        beside: Evaluate in a process of its own. It starts at once.

    Raises:
        SettingsError: if there are more episodes than landmarks.
    """

    def __init__(self, agent: Agent, *, episodes: int, episode_steps: int, beside: bool = False) -> None:
        task, landmarks = agent.task, agent.task.workspace.landmarks
        if episodes > len(landmarks):
            raise SettingsError(f"eval_episodes={episodes}, but {task.name} has {len(landmarks)} landmark goals")
        self.policy, self.goals, self.episodes = agent.policy(), torch.tensor(landmarks), episodes
        self.beside, index = beside, self.policy.object_index
        images = None if self.policy.takes_positions else goal_images(task, self.goals, object_index=index)
        # A copy where the environments are, wherever the agent learns; without the agent that a policy knows.
        acts = deepcopy(TensorDictSequential(*self.policy.module)).cpu()
        make = partial(LandmarkEpisodes, acts, environment_of(task), task, self.goals, images, index)
        self._worker: Worker = make_worker(partial(make, episode_steps, episodes), process=beside, timeout=_TIMEOUT)
        self._is_ready = False

    def __call__(self, updates: int) -> dict[str, float] | Worker:
        """Scores to log, or what will answer with them; the number of updates decides which landmarks are drawn."""
        if not self._is_ready:
            self._worker.ready()
            self._is_ready = True
        drawn = torch.randperm(len(self.goals), generator=torch.Generator().manual_seed(updates))
        weights = {name: value.cpu() for name, value in self.policy.state_dict().items()}
        self._worker.request("scores", weights, drawn[: self.episodes].sort().values)
        return self._worker if self.beside else self._worker.answer()

    def close(self) -> None:
        """Close the environments, and end the process."""
        self._worker.close()

    def __enter__(self) -> LandmarkEvaluation:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class LandmarkEpisodes:
    """Plays the episodes of a :class:`LandmarkEvaluation`.

    Args:
        policy: Acts.
        environment: The environment, which another process need not know.
        task: The task.
        goals: ``[N, D]`` metres.
        images: ``[N, 3, H, W]`` uint8, what the policy is given instead.
        object_index: Which object is to go there.
        episode_steps: Steps of an episode.
        episodes: Episodes at a time.
        alive: Called after each step.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        environment: Environment,
        task: Task,
        goals: Tensor,
        images: Tensor | None,
        object_index: int,
        episode_steps: int,
        episodes: int,
        alive: Callable[[], None],
    ) -> None:
        ENVIRONMENTS.setdefault(environment.name, environment)
        self.policy, self.goals, self.images, self.object_index = policy, goals, images, object_index
        self.envs = EvaluationEnvs(task, episode_steps=episode_steps, workers=0, envs=episodes)
        self.alive = alive

    def scores(self, weights: dict[str, Tensor], chosen: Tensor) -> dict[str, float]:
        """Means over the goals of these numbers ``[E]``, with these weights of the policy."""
        self.policy.load_state_dict(weights)
        images = None if self.images is None else self.images[chosen]
        episodes = self.envs.run(self._act, self.goals[chosen], images=images, numbers=chosen)
        scores = measure(episodes, object_index=self.object_index)
        return {f"evaluation/{name}": float(values.nanmean()) for name, values in scores.items()}

    def _act(self, step: TensorDictBase) -> TensorDictBase:
        self.alive()
        return self.policy(step)

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()
