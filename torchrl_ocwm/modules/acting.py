"""The policy that acts in an environment."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase


class ActingLatent(TensorDictModuleBase):
    """Let a policy carry its latent through any rollout, without primers or state of its own.

    Rollouts and collectors carry the root of the tensordict from step to step, and with it ``latent``, which holds the
    state, the belief and the action of the step before. At the very first step there is none yet: zeros are written.

    Args:
        state: Features of the stochastic state S.
        belief: Features of the deterministic state H.
        action: Number of actions A.

    Raises:
        KeyError: if the environment does not mark the first steps of episodes.
    """

    def __init__(self, state: int, belief: int, action: int) -> None:
        super().__init__()
        self.sizes = {"state": state, "belief": belief, "action": action}
        self.in_keys = ["is_init"]
        self.out_keys = [("latent", name) for name in self.sizes]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write zeros where there is no latent yet."""
        start = tensordict.get("is_init", None)
        if start is None:
            raise KeyError(
                "the policy needs 'is_init' to know where episodes start; append torchrl.envs.InitTracker() to the "
                "environment, as torchrl_ocwm.envs.make_env does"
            )
        for name, size in self.sizes.items():
            if tensordict.get(("latent", name), None) is None:
                tensordict.set(("latent", name), torch.zeros(*tensordict.batch_size, size, device=start.device))
        return tensordict
