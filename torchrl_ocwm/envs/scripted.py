"""What a scripted policy would do, beside the observations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import Transform

if TYPE_CHECKING:
    from torchrl_ocwm.envs.positioning import PositioningEnv

_ARRIVED = 0.02  # metres
_MISS = ((-0.06, 0.06), (-0.06, 0.06), (0.0, 0.08))  # of the place where the object is believed to be, metres


class ScriptedAction(Transform):
    """Write the action of an environment's scripted policy, which carries the first object from target to target.

    The policy sees the simulator's true state, so this is for collecting data only. The first target of an episode is
    its goal. Where the object has arrived, or when it takes too long, the next target is drawn uniformly in the
    workspace, so that the object keeps moving through an episode.

    For some targets the policy misjudges where the object is, by up to 6 cm to each side and 8 cm upwards, closes the
    hand on nothing and carries on without the object. Without such data a world model learns that an object follows
    whatever the hand does. Targets and misses depend on nothing but the seed of the episode.

    Args:
        patience: Steps until a target is given up.
        misses: Share of the targets for which the object is misjudged.
        action_key: Key written, ``[A]`` float32 in [−1, 1].

    Raises:
        NoScriptedPolicyError: at the first reset, if the environment has no scripted policy.

    Examples:
        >>> from torchrl_ocwm.envs import make_env
        >>> env = make_env("reacher", horizon=20).append_transform(ScriptedAction())
        >>> env.rollout(20, lambda tensordict: tensordict.set("action", tensordict["scripted_action"])).shape
        torch.Size([20])
        >>> env.close()
    """

    def __init__(self, *, patience: int = 60, misses: float = 0.3, action_key: NestedKey = "scripted_action") -> None:
        super().__init__(in_keys=["goal_position"], out_keys=[action_key])
        if patience < 1:
            raise ValueError(f"patience must be at least 1 step, got {patience}")
        if not 0 <= misses <= 1:
            raise ValueError(f"misses must be a share between 0 and 1, got {misses}")
        self.patience, self.misses = patience, misses
        self._target, self._error, self._left = np.empty(0), np.zeros(3), 0
        self._random = np.random.default_rng()

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        self._random = self._simulator.np_random.spawn(1)[0]
        self._aim(tensordict_reset[self.in_keys[0]].numpy(force=True))
        return self._write(tensordict_reset)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._left -= 1
        position = self._simulator.true_position()[0]
        if self._left == 0 or np.linalg.norm(position - self._target) < _ARRIVED:
            workspace = self._simulator.workspace
            self._aim(self._random.uniform(workspace.low, workspace.high))
        return self._write(next_tensordict)

    def _aim(self, target: np.ndarray) -> None:
        self._target, self._left = target, self.patience
        misses = self._random.random() < self.misses
        self._error = misses * self._random.uniform(*np.transpose(_MISS))

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self._simulator.scripted_action(self._target, self._error)
        return tensordict.set(self.out_keys[0], torch.from_numpy(action))

    @property
    def _simulator(self) -> PositioningEnv:
        return self.parent.base_env._env.unwrapped

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the key that is written."""
        shape = self.parent.full_action_spec["action"].shape
        observation_spec[self.out_keys[0]] = Unbounded(shape)
        return observation_spec
