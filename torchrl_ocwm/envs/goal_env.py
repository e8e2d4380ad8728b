"""A gymnasium environment in TorchRL that takes the goal of an episode from the tensordict given to ``reset``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Binary
from torchrl.envs import GymEnv, default_info_dict_reader


class GoalEnv(GymEnv):
    """TorchRL's :class:`~torchrl.envs.GymEnv` for environments whose reset has the option ``goal_position``.

    ``reset(tensordict)`` starts an episode with the ``goal_position`` of the tensordict, if it has one; a goal in
    ``options`` goes before it. Resets inside a rollout draw new goals.

    ``success`` ``[1]`` bool of the environment's info is among the observations; false for one that does not say.

    Examples:
        >>> import torch, torchrl_ocwm.envs
        >>> from tensordict import TensorDict
        >>> env = GoalEnv("ocwm/Reacher-v0", image_size=16)
        >>> env.reset(TensorDict({"goal_position": torch.tensor([0.1, -0.2])}))["goal_position"]
        tensor([ 0.1000, -0.2000])
        >>> env.close()
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.set_info_dict_reader(_Success())

    def _make_specs(self, env: Any, batch_size: Any = None) -> None:
        super()._make_specs(env, batch_size)
        # TorchRL's transforms hand a reset only what is part of the state.
        self.state_spec.set("goal_position", self.observation_spec["goal_position"].clone())

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        goal = None if tensordict is None else tensordict.get("goal_position", None)
        if goal is not None:
            kwargs["options"] = {"goal_position": goal.numpy(force=True), **(kwargs.get("options") or {})}
        return super()._reset(tensordict, **kwargs)


class _Success(default_info_dict_reader):
    def __init__(self) -> None:
        super().__init__(["success"], {"success": Binary(1, (1,), dtype=torch.bool)})

    def __call__(self, info_dict: dict[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        success = np.array([bool(info_dict.get("success", False))])
        return super().__call__({"success": success}, tensordict)
