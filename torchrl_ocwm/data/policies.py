"""Policies that fill datasets."""

from __future__ import annotations

from collections.abc import Callable

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


class ScriptedPolicy(TensorDictModuleBase):
    """Scripted actions with noise, interrupted by stretches of smooth random actions.

    The script shows what moving the object looks like, the noise and the random stretches show what lies around it:
    a dropped object, an empty grasp. :class:`~torchrl_ocwm.envs.ScriptedAction` writes the scripted actions.

    Args:
        action_dim: Number of actions A.
        noise: Largest standard deviation of the noise on scripted actions; each episode draws its own below it.
        random_share: Share of the steps that lie in random stretches, at least 0 and below 1.
        stretch: Mean length of a random stretch, steps.
        scripted_key: Key of the scripted action, ``[*batch, A]`` float32.
        action_key: Key written, ``[*batch, A]`` float32 in [−1, 1].
        init_key: Key of the flag that marks the first step of an episode, ``[*batch, 1]`` bool.

    Raises:
        ValueError: for a share outside [0, 1) or a stretch below one step.

    Examples:
        >>> from torchrl_ocwm.envs import ScriptedAction, make_env
        >>> env = make_env("reacher", horizon=20).append_transform(ScriptedAction())
        >>> env.rollout(20, ScriptedPolicy(2))["action"].shape
        torch.Size([20, 2])
        >>> env.close()
    """

    def __init__(
        self,
        action_dim: int,
        *,
        noise: float = 0.2,
        random_share: float = 0.3,
        stretch: float = 20.0,
        scripted_key: NestedKey = "scripted_action",
        action_key: NestedKey = "action",
        init_key: NestedKey = "is_init",
    ) -> None:
        super().__init__()
        if not 0 <= random_share < 1 or stretch < 1:
            raise ValueError(
                f"random_share must lie in [0, 1) and stretch be at least 1, got {random_share} and {stretch}"
            )
        self.noise = noise
        self.random_share, self.leave = random_share, 1 / stretch
        # As many stretches begin as end: share (1 / stretch) = (1 - share) enter.
        self.enter = min(self.leave * random_share / (1 - random_share), 1.0)
        self.random = SmoothRandomPolicy(action_dim, action_key=("exploration", "random"), init_key=init_key)
        self.in_keys = [scripted_key, init_key]
        self.out_keys = [action_key, ("exploration", "in_stretch"), ("exploration", "level"), *self.random.out_keys]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next action."""
        scripted, start = tensordict.get(self.in_keys[0]), tensordict.get(self.in_keys[1])
        chance, fresh_level = torch.rand_like(start, dtype=scripted.dtype), torch.rand_like(start, dtype=scripted.dtype)
        begins = chance < self.random_share
        before = tensordict.get(self.out_keys[1], begins)
        goes_on = torch.where(before, chance >= self.leave, chance < self.enter)
        in_stretch = torch.where(start, begins, goes_on)
        level = torch.where(start, fresh_level, tensordict.get(self.out_keys[2], fresh_level))
        self.random(tensordict)
        noisy = scripted + self.noise * level * tensordict.get(("exploration", "noise"))
        action = torch.where(in_stretch, tensordict.get(("exploration", "random")), noisy.clamp(-1, 1))
        tensordict.set(self.out_keys[1], in_stretch)
        tensordict.set(self.out_keys[2], level)
        return tensordict.set(self.out_keys[0], action)


#: Collecting policies by name, each made for a number of actions.
POLICIES: dict[str, Callable[[int], TensorDictModuleBase]] = {"random": SmoothRandomPolicy, "scripted": ScriptedPolicy}
