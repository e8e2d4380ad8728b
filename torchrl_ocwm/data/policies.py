"""Policies that fill datasets."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey


class SmoothRandomPolicy(TensorDictModuleBase):
    """Random actions that change slowly, so that a robot travels instead of trembling.

    A first-order autoregressive process, x' = ρ x + √(1 − ρ²) ε with ε standard normal, whose value times ``scale`` is
    clipped to [−1, 1]. ρ is drawn anew at each episode start, log-uniformly in its time constant 1/(1 − ρ), so that
    a dataset holds slow sweeps and quick jitter. The process lives in the tensordict, which rollouts and collectors
    carry from step to step.

    Args:
        action_dim: Number of actions A.
        scale: Standard deviation before clipping.
        shortest: Shortest time constant, steps.
        longest: Longest time constant, steps.
        action_key: Key written, ``[*batch, A]`` float32 in [−1, 1].
        init_key: Key of the flag that marks the first step of an episode, ``[*batch, 1]`` bool.

    Examples:
        >>> from torchrl_ocwm.envs import make_env
        >>> env = make_env("reacher", horizon=20)
        >>> env.rollout(20, SmoothRandomPolicy(2))["action"].shape
        torch.Size([20, 2])
        >>> env.close()
    """

    def __init__(
        self,
        action_dim: int,
        *,
        scale: float = 1.0,
        shortest: float = 2.0,
        longest: float = 50.0,
        action_key: NestedKey = "action",
        init_key: NestedKey = "is_init",
    ) -> None:
        super().__init__()
        if not 1 <= shortest <= longest:
            raise ValueError(f"time constants need 1 <= shortest <= longest, got {shortest} and {longest}")
        self.action_dim, self.scale = action_dim, scale
        self.shortest, self.longest = shortest, longest
        self.in_keys, self.out_keys = [init_key], [action_key, ("exploration", "noise"), ("exploration", "memory")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next action."""
        start = tensordict.get(self.in_keys[0])
        fresh = torch.randn(*tensordict.batch_size, self.action_dim, device=start.device)
        ratio = torch.rand(*tensordict.batch_size, 1, device=start.device)
        fresh_memory = 1 - 1 / (self.shortest * (self.longest / self.shortest) ** ratio)
        noise = tensordict.get(self.out_keys[1], fresh)
        memory = torch.where(start, fresh_memory, tensordict.get(self.out_keys[2], fresh_memory))
        noise = torch.where(start, fresh, memory * noise + (1 - memory.square()).sqrt() * fresh)
        tensordict.set(self.out_keys[1], noise)
        tensordict.set(self.out_keys[2], memory)
        return tensordict.set(self.out_keys[0], (self.scale * noise).clamp(-1, 1))
