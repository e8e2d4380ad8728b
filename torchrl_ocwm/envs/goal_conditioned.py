"""Positioning as hindsight replay knows it: an achieved goal, a desired goal, and the reward of any two of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_ocwm.envs.missing import needs
from torchrl_ocwm.envs.task import SUCCESS_DISTANCE

with needs("an environment", "dm-control"):
    import gymnasium
    from gymnasium import spaces


class GoalConditioned(gymnasium.ObservationWrapper, gymnasium.utils.RecordConstructorArgs):
    """An environment with the interface of gymnasium-robotics, for hindsight replay of TorchRL or Stable-Baselines3.

    Observations are ``observation`` (P + O * D,) float32, proprioception and all object positions in metres;
    ``achieved_goal`` (D,), where the object is; and ``desired_goal`` (D,), where it is to be, metres. The reward is
    minus their distance.

    Args:
        env: An environment with the keys of the data contract, such as ``gymnasium.make("ocwm/Reacher-v0")``.
        object_index: Which object is to be positioned.
        sparse: Rewards of 0 within 5 cm of the goal, and −1 elsewhere, instead of the distance.
        pixels: Also observe the image, ``pixels`` (3, H, W) uint8.

    Examples:
        >>> import torchrl_ocwm.envs
        >>> env = GoalConditioned(gymnasium.make("ocwm/Reacher-v0", image_size=16))
        >>> seen, _ = env.reset(seed=0)
        >>> sorted(seen)
        ['achieved_goal', 'desired_goal', 'observation']
        >>> float(env.compute_reward(seen["desired_goal"], seen["desired_goal"], {}))
        -0.0
        >>> env.close()
    """

    def __init__(
        self, env: gymnasium.Env, *, object_index: int = 0, sparse: bool = False, pixels: bool = False
    ) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self, object_index=object_index, sparse=sparse, pixels=pixels)
        super().__init__(env)
        self.object_index, self.sparse, self.pixels = object_index, sparse, pixels
        inner: Any = env.observation_space
        objects = inner["object_position"].shape[0]
        if not 0 <= object_index < objects:
            raise ValueError(f"object_index must be one of the {objects} objects, got {object_index}")
        size = inner["proprio"].shape[0] + int(np.prod(inner["object_position"].shape))
        goal = inner["goal_position"]
        shown: dict[str, spaces.Space] = {
            "observation": spaces.Box(-np.inf, np.inf, (size,), np.float32),
            "achieved_goal": spaces.Box(-np.inf, np.inf, goal.shape, np.float32),
            "desired_goal": goal,
        }
        self.observation_space = spaces.Dict({**shown, "pixels": inner["pixels"]} if pixels else shown)

    def observation(self, observation: Any) -> dict[str, np.ndarray]:
        """What was observed, by the names of this interface."""
        positions = observation["object_position"]
        shown = {
            "observation": np.concatenate([observation["proprio"], positions.ravel()]),
            "achieved_goal": positions[self.object_index],
            "desired_goal": observation["goal_position"],
        }
        return {**shown, "pixels": observation["pixels"]} if self.pixels else shown

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """A step, with reward and success of the object that is meant."""
        observation, _, terminated, truncated, info = super().step(action)
        reward = float(self.compute_reward(observation["achieved_goal"], observation["desired_goal"], info))
        success = self._distance(observation["achieved_goal"], observation["desired_goal"]) <= SUCCESS_DISTANCE
        return (
            observation,
            reward,
            terminated,
            truncated,
            {**info, "success": bool(success), "is_success": bool(success)},
        )

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, info: Any) -> Any:
        """The reward ``[...]`` for goals ``[..., D]`` in metres, arrays or tensors, whatever goal was meant (Eq. 1)."""
        del info
        distance = self._distance(achieved_goal, desired_goal)
        return (distance <= SUCCESS_DISTANCE) * 1.0 - 1.0 if self.sparse else -distance

    @staticmethod
    def _distance(achieved_goal: Any, desired_goal: Any) -> Any:
        return ((achieved_goal - desired_goal) ** 2).sum(-1) ** 0.5
