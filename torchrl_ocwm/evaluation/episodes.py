"""Run a policy towards many goals at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from math import ceil
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from torchrl_ocwm.data.records import episode_to_records
from torchrl_ocwm.data.seeds import episode_seed
from torchrl_ocwm.envs import Task, environment_of, make_scene
from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.envs.task import SUCCESS_DISTANCE
from torchrl_ocwm.evaluation.randomness import EpisodeRandomness
from torchrl_ocwm.evaluation.scores import normalized_score
from torchrl_ocwm.processes import Worker, make_worker

with needs("an evaluation", "recipes"):
    from tqdm import tqdm

Policy = Callable[[TensorDictBase], TensorDictBase]
Observation = dict[str, np.ndarray]
Inspect = Callable[[TensorDictBase], dict[str, Any]]
_TRUE = ("object_position_true",)
_KEPT = ("object_position", *_TRUE, "reward")
_SEEN = ("pixels", "masks", "proprio", "object_position", "object_visible", "goal_position")


class SteppedEnvs:
    """Environments that are stepped one after the other, made when they are first needed.

    They are gymnasium's: what TorchRL adds to a single step of a single environment takes longer than its physics.

    Args:
        make: Makes one.
        alive: Called after each step.
    """

    def __init__(self, make: Callable[[], Any], alive: Callable[[], None]) -> None:
        self.make, self.alive = make, alive
        self.envs: list[Any] = []
        self._dropped: tuple[str, ...] = ()

    def reset(self, starts: list[dict[str, Any]], blind: bool = False) -> TensorDictBase:
        """Reset as many environments as there are arguments; the first observations ``[E]``.

        Args:
            starts: Arguments of each.
            blind: Until the next reset nothing is rendered (:class:`~torchrl_ocwm.envs.PositioningEnv`), and images
                are left out.
        """
        while len(self.envs) < len(starts):
            self.envs.append(self.make())
            self.alive()
        self._dropped = ("pixels", "masks") if blind else ()
        observations = []
        for env, start in zip(self.envs, starts, strict=False):
            env.blind = blind
            observations.append(env.reset(**start)[0])
            self.alive()
        return self._batch(observations, is_init=True)

    def step(self, actions: Tensor) -> TensorDictBase:
        """Do the actions ``[E, A]``; what comes next ``[E]``."""
        results = []
        for env, action in zip(self.envs, actions.numpy(), strict=False):
            results.append(env.step(action))
            self.alive()
        observations, rewards, terminated, truncated, _ = zip(*results, strict=True)
        ends = torch.tensor([terminated, truncated]).unsqueeze(-1)
        next_ = self._batch(
            observations, is_init=False, reward=torch.tensor(rewards, dtype=torch.float32).unsqueeze(-1)
        )
        return next_.update({"terminated": ends[0], "truncated": ends[1], "done": ends.any(0)})

    def _batch(self, observations: Sequence[Observation], *, is_init: bool, **more: Tensor) -> TensorDictBase:
        keys = [key for key in observations[0] if key not in self._dropped]
        seen = {key: torch.from_numpy(np.stack([one[key] for one in observations])) for key in keys}
        begins = torch.full((len(observations), 1), is_init)
        return TensorDict({**seen, "is_init": begins, **more}, [len(observations)])

    def close(self) -> None:
        """Close the environments."""
        while self.envs:
            self.envs.pop().close()


class EvaluationEnvs:
    """Environments of one task, stepped together, each with a goal of its own.

    Args:
        task: The task.
        episode_steps: Steps per episode.
        workers: Processes; 0 steps all environments in this process.
        envs: Environments per process.
        timeout: Seconds without a step after which a process counts as hanging.

    Close it, or use it in a ``with`` block.
    """

    def __init__(
        self, task: Task, *, episode_steps: int, workers: int = 2, envs: int = 10, timeout: float = 120.0
    ) -> None:
        self.task, self.episode_steps, self.envs = task, episode_steps, envs
        options = {**task.options, "horizon": episode_steps, "privileged": True}
        make = partial(SteppedEnvs, partial(make_scene, environment_of(task), **options))
        self._workers: list[Worker] = []
        try:
            for _ in range(max(workers, 1)):
                self._workers.append(make_worker(make, process=workers > 0, timeout=timeout))
            for worker in self._workers:
                worker.ready()
        except BaseException:
            self.close()
            raise

    def run(
        self,
        policy: Policy,
        goals: Tensor,
        *,
        images: Tensor | None = None,
        seed: int = 0,
        numbers: Tensor | None = None,
        keep: tuple[Any, ...] = (),
        inspect: Inspect | None = None,
        blind: bool = False,
        progress: bool = False,
    ) -> TensorDict:
        """One episode for each goal, acting without exploration.

        The start of an episode, and what the policy draws in it (states of the world model, random actions), come from
        the seed and the goal's number alone. So the episodes do not depend on how many environments there are, up to
        the rounding of sums, and none of them starts like one that was collected.

        Args:
            policy: The policy.
            goals: ``[N, D]`` metres; the environments judge by them.
            images: ``[N, 3, H, W]`` or ``[N, F, 3, H, W]`` uint8; given to the policy instead of the positions
                (:class:`~torchrl_ocwm.modules.GivenGoals`).
            seed: Seeds the episodes, together with the goals' numbers.
            numbers: ``[N]`` int64, the goals' numbers; 0, 1, 2, … by default.
            keep: More keys to keep of each step.
            inspect: Called with each step's tensordict ``[E]`` after the policy, in which ``goal_number`` ``[E]`` says
                whose episodes these are; what it returns is kept too.
            blind: Render nothing, for a policy that looks at nothing: several times faster. No image is made, all
                objects are hidden, and only ``object_position_true`` is kept by itself.
            progress: Show a progress bar.

        Returns:
            ``[N, T]`` with ``object_position_true`` and ``object_position`` ``[O, D]``, ``reward`` (of the first
            object) and what else was asked for, after each step, and ``goal_position``.

        Raises:
            ValueError: for goals outside the workspace.
            WorkerError: if a process ends or hangs.
        """
        goals = self.task.workspace.check(goals)
        numbers = torch.arange(len(goals)) if numbers is None else numbers
        kept = (*(_TRUE if blind else _KEPT), *keep)
        batches = []
        with tqdm(total=len(goals), unit="goal", desc="evaluate", disable=not progress) as bar:
            for chunk in torch.arange(len(goals)).split(self.envs * len(self._workers)):
                given = TensorDict({"goal_number": numbers[chunk]}, [len(chunk)])
                if images is not None:
                    given["goal", "pixels"] = images[chunk]
                seeds = [episode_seed("evaluate", seed, number) for number in numbers[chunk].tolist()]
                batches.append(self._episodes(policy, goals[chunk], seeds, given, kept, inspect, blind))
                bar.update(len(chunk))
        return TensorDict.cat(batches)

    @torch.no_grad()
    def _episodes(
        self,
        policy: Policy,
        goals: Tensor,
        seeds: list[int],
        given: TensorDictBase,
        kept: tuple[Any, ...],
        inspect: Inspect | None,
        blind: bool,
    ) -> TensorDict:
        starts = [
            {"seed": seed, "options": {"goal_position": goal.numpy()}} for seed, goal in zip(seeds, goals, strict=True)
        ]
        tensordict = self._together("reset", starts, blind).update(given)
        steps = []
        randomness = EpisodeRandomness(seeds)
        for _ in range(self.episode_steps):
            with set_exploration_type(ExplorationType.DETERMINISTIC), randomness:
                tensordict = policy(tensordict)
            tensordict["next"] = self._together("step", tensordict["action"])
            step = tensordict["next"].select(*kept).clone()
            if inspect is not None:
                step.update(inspect(tensordict))
            steps.append(step)
            tensordict = step_mdp(tensordict, keep_other=True, exclude_action=False)
        episodes = TensorDict.stack(steps, 1)
        return episodes.set("goal_position", goals.unsqueeze(1).expand(-1, self.episode_steps, -1).clone())

    def _together(self, method: str, arguments: Any, *shared: Any) -> TensorDictBase:
        """Call a method of the environments of every process at the same time, each with its part of the arguments."""
        size = ceil(len(arguments) / len(self._workers))
        parts = [arguments[start : start + size] for start in range(0, len(arguments), size)]
        at_work = self._workers[: len(parts)]
        for worker, part in zip(at_work, parts, strict=True):
            worker.request(method, part, *shared)
        return torch.cat([worker.answer() for worker in at_work])

    def close(self) -> None:
        """Close the environments and end the processes."""
        for worker in self._workers:
            worker.close()

    def __enter__(self) -> EvaluationEnvs:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def transition(step: TensorDictBase) -> dict[str, TensorDictBase]:
    """What a dataset keeps of a step, for ``inspect`` of :meth:`EvaluationEnvs.run`; see :func:`episode_records`."""
    ends = [("next", name) for name in ("reward", "done", "terminated")]
    return {"transition": step.select("action", *_SEEN, *(("next", name) for name in _SEEN), *ends).clone()}


class Footage:
    """Keeps all of a few goals' episodes while many are run, for ``inspect`` of :meth:`EvaluationEnvs.run`.

    Args:
        numbers: ``[K]`` int64, the goals' numbers, in the order of the run.
    """

    def __init__(self, numbers: Tensor) -> None:
        self.numbers = numbers
        self._together: dict[tuple[int, ...], list[TensorDictBase]] = {}

    def __call__(self, step: TensorDictBase) -> None:
        """Keep the rows of these goals of a step's tensordict ``[E]``."""
        seen = step[torch.isin(step["goal_number"], self.numbers)]
        if len(seen):
            kept = TensorDict({"latent": seen["latent"], **transition(seen)}, seen.batch_size)
            self._together.setdefault(tuple(seen["goal_number"].tolist()), []).append(kept)

    def episodes(self) -> TensorDictBase:
        """What was kept, ``[K, T]``, with the policy's ``latent`` and the ``transition`` of each step."""
        return torch.cat([torch.stack(steps, 1) for steps in self._together.values()])


def episode_records(episodes: TensorDictBase) -> TensorDictBase:
    """Records ``[N, T + 1]`` of episodes ``[N, T]`` that were run with ``inspect=transition``."""
    return torch.stack([episode_to_records(episode) for episode in episodes["transition"]])


def goal_images(task: Task, goals: Tensor, *, object_index: int = 0) -> Tensor:
    """What would be seen with an object at each goal, its robot "teleported" there (paper, "Visual goals").

    Args:
        task: The task.
        goals: ``[N, D]`` metres. Where the robot cannot reach one, the nearest reachable position is shown.
        object_index: Which object; the others stay where an episode starts.

    Returns:
        ``[N, 3, H, W]`` uint8.
    """
    with closing(make_scene(environment_of(task), **task.options)) as scene:
        scene.reset(seed=0)
        images = [scene.goal_observation(goal, object_index)["pixels"] for goal in goals.numpy()]
        return torch.stack([torch.from_numpy(image) for image in images])


def measure(episodes: TensorDictBase, *, object_index: int = 0) -> dict[str, Tensor]:
    """Scores of episodes ``[N, T]``, each ``[N]``: judged by the simulator's positions, not the estimated ones.

    Args:
        episodes: What :meth:`EvaluationEnvs.run` gave.
        object_index: Which object was to go to the goals.

    Returns:
        ``final_score`` and ``mean_score`` (normalised score after the last step, and averaged over the episode),
        ``success`` (within 5 cm after the last step), ``final_distance`` (metres).
    """
    position = episodes["object_position_true"][..., object_index, :]
    score = normalized_score(position, episodes["goal_position"])
    distance = torch.linalg.vector_norm(position - episodes["goal_position"], dim=-1)
    return {
        "final_score": score[:, -1],
        "mean_score": score.mean(1),
        "success": (distance[:, -1] <= SUCCESS_DISTANCE).float(),
        "final_distance": distance[:, -1],
    }
