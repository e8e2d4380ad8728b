"""What a scripted policy would do, beside the observations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import Transform

if TYPE_CHECKING:
    from torchrl_ocwm.envs.positioning import PositioningEnv

_ARRIVED = 0.02  # metres


class ScriptedAction(Transform):
    """Write the action of an environment's scripted policy, which carries the first object from target to target.

    The policy sees the simulator's true state, so this is for collecting data only. The first target of an episode is
    its goal. Where the object has arrived, or when it takes too long, the next target is drawn uniformly in the
    workspace, so that the object keeps moving through an episode.

    Args:
        patience: Steps until a target is given up.
        action_key: Key written, ``[A]`` float32 in [−1, 1].

    Raises:
        NotImplementedError: at the first reset, if the environment has no scripted policy.

    Examples:
        >>> from torchrl_ocwm.envs import make_env
        >>> env = make_env("reacher", horizon=20).append_transform(ScriptedAction())
        >>> env.rollout(20, lambda tensordict: tensordict.set("action", tensordict["scripted_action"])).shape
        torch.Size([20])
        >>> env.close()
    """

    def __init__(self, *, patience: int = 60, action_key: NestedKey = "scripted_action") -> None:
        super().__init__(in_keys=["object_position_true"], out_keys=[action_key])
        if patience < 1:
            raise ValueError(f"patience must be at least 1 step, got {patience}")
        self.patience = patience
        self._target, self._left = torch.empty(0), 0

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        self._target, self._left = tensordict_reset["goal_position"], self.patience
        return self._write(tensordict_reset)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._left -= 1
        position = next_tensordict.get(self.in_keys[0])[0]
        if self._left == 0 or (position - self._target).norm() < _ARRIVED:
            self._target, self._left = self._simulator.workspace.sample(), self.patience
        return self._write(next_tensordict)

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self._simulator.scripted_action(self._target.numpy())
        return tensordict.set(self.out_keys[0], torch.from_numpy(action))

    @property
    def _simulator(self) -> PositioningEnv:
        return self.parent.base_env._env.unwrapped

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the key that is written."""
        shape = self.parent.full_action_spec["action"].shape
        observation_spec[self.out_keys[0]] = Unbounded(shape)
        return observation_spec
