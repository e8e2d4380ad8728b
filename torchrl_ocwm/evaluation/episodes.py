"""Run a policy towards many goals at once."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp
from tqdm import tqdm

from torchrl_ocwm.data.records import episode_to_records
from torchrl_ocwm.envs import ENVIRONMENTS, Task, make_env
from torchrl_ocwm.envs.task import SUCCESS_DISTANCE
from torchrl_ocwm.evaluation.scores import normalized_score

Policy = Callable[[TensorDictBase], TensorDictBase]
_KEPT = ("object_position", "object_position_true", "reward")
_SEEN = ("pixels", "masks", "proprio", "object_position", "object_visible", "goal_position")


class EvaluationEnvs:
    """Environments of one task, stepped together, each with a goal of its own.

    Args:
        task: The task.
        episode_steps: Steps per episode.
        workers: Processes; 0 steps all environments in this process.
        envs: Environments per process.

    Close it, or use it in a ``with`` block.
    """

    def __init__(self, task: Task, *, episode_steps: int, workers: int = 2, envs: int = 10) -> None:
        make = partial(make_env, task.name, horizon=episode_steps, privileged=True, **task.options)
        serial = partial(SerialEnv, envs, make)
        self.task, self.episode_steps, self.shape = task, episode_steps, (max(workers, 1), envs)
        self.env: EnvBase = ParallelEnv(workers, serial, mp_start_method="spawn") if workers else SerialEnv(1, serial)

    def run(
        self,
        policy: Policy,
        goals: Tensor,
        *,
        images: Tensor | None = None,
        seed: int = 0,
        keep: tuple[Any, ...] = (),
        inspect: Callable[[TensorDictBase], dict[str, Tensor]] | None = None,
        progress: bool = False,
    ) -> TensorDict:
        """One episode for each goal, acting without exploration.

        Args:
            policy: The policy.
            goals: ``[N, D]`` metres; the environments judge by them.
            images: ``[N, 3, H, W]`` or ``[N, F, 3, H, W]`` uint8; given to the policy instead of the positions
                (:class:`~torchrl_ocwm.modules.GivenGoals`).
            seed: Seeds the environments.
            keep: More keys to keep of each step.
            inspect: Called with each step's tensordict ``[E]`` after the policy; what it returns is kept too.
            progress: Show a progress bar.

        Returns:
            ``[N, T]`` with ``object_position_true`` and ``object_position`` ``[O, D]``, ``reward`` and what else was
            asked for, after each step, and ``goal_position``.
        """
        goals = self.task.workspace.check(goals)
        size = self.shape[0] * self.shape[1]
        self.env.set_seed(seed)
        batches = []
        with tqdm(total=len(goals), unit="goal", desc="evaluate", disable=not progress) as bar:
            for chunk in torch.arange(len(goals)).split(size):
                # The last chunk is filled up with copies of its last goal.
                full = torch.cat([chunk, chunk[-1:].expand(size - len(chunk))])
                seen = None if images is None else images[full]
                batches.append(self._episodes(policy, goals[full], seen, keep, inspect)[: len(chunk)])
                bar.update(len(chunk))
        return TensorDict.cat(batches)

    @torch.no_grad()
    def _episodes(
        self,
        policy: Policy,
        goals: Tensor,
        images: Tensor | None,
        keep: tuple[Any, ...],
        inspect: Callable[[TensorDictBase], dict[str, Tensor]] | None,
    ) -> TensorDict:
        options = [{"options": {"goal_position": goal.numpy()}} for goal in goals]
        per_worker = [{"list_of_kwargs": options[i : i + self.shape[1]]} for i in range(0, len(goals), self.shape[1])]
        tensordict = self.env.reset(list_of_kwargs=per_worker)
        if images is not None:
            tensordict["goal"] = TensorDict({"pixels": images.unflatten(0, self.shape)}, self.shape)
        steps = []
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            for _ in range(self.episode_steps):
                tensordict = self.env.step(policy(tensordict))
                kept = tensordict["next"].select(*_KEPT, *keep).clone()
                if inspect is not None:
                    kept.update(inspect(tensordict))
                steps.append(kept.reshape(-1))
                tensordict = step_mdp(tensordict, keep_other=True, exclude_action=False)
        episodes = TensorDict.stack(steps, 1)
        return episodes.set("goal_position", goals.unsqueeze(1).expand(-1, self.episode_steps, -1).clone())

    def close(self) -> None:
        """Stop the processes."""
        if not self.env.is_closed:
            self.env.close()

    def __enter__(self) -> EvaluationEnvs:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def transition(step: TensorDictBase) -> dict[str, TensorDictBase]:
    """What a dataset keeps of a step, for ``inspect`` of :meth:`EvaluationEnvs.run`; see :func:`episode_records`."""
    ends = [("next", name) for name in ("reward", "done", "terminated")]
    return {"transition": step.select("action", *_SEEN, *(("next", name) for name in _SEEN), *ends).clone()}


def episode_records(episodes: TensorDictBase) -> TensorDictBase:
    """Records ``[N, T + 1]`` of episodes ``[N, T]`` that were run with ``inspect=transition``."""
    return torch.stack([episode_to_records(episode) for episode in episodes["transition"]])


def goal_images(task: Task, goals: Tensor) -> Tensor:
    """What would be seen with the object at each goal, its robot "teleported" there (paper, "Visual goals").

    Args:
        task: The task.
        goals: ``[N, D]`` metres. Where the robot cannot reach one, the nearest reachable position is shown.

    Returns:
        ``[N, 3, H, W]`` uint8.
    """
    env = gymnasium.make(ENVIRONMENTS[task.name].id, **task.options)
    env.reset(seed=0)
    scene: Any = env.unwrapped
    images = [torch.from_numpy(scene.goal_observation(goal)["pixels"]) for goal in goals.numpy()]
    env.close()
    return torch.stack(images)


def measure(episodes: TensorDictBase, *, object_index: int = 0) -> dict[str, Tensor]:
    """Scores of episodes ``[N, T]``, each ``[N]``: judged by the simulator's positions, not the estimated ones.

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
