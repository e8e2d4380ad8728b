"""The world model as an environment that carries a goal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.model_based import DreamerEnv
from torchrl.modules import WorldModelWrapper


class ImaginationEnv(DreamerEnv):
    """Imagine with a world model, towards a goal that stays fixed.

    The state is one nested entry, ``latent = {state, belief, goal}``: in a goal-conditioned problem the goal is part of
    the state. TorchRL's Dreamer losses take it whole when their keys ``state`` and ``belief`` are both set to
    ``"latent"``.

    Args:
        transition: Writes the next ``("latent", "state")`` and ``("latent", "belief")`` from these and ``action``.
        reward: Writes ``reward`` ``[*batch, 1]`` from the next ``latent``, the ``action`` that led there, and
            ``before``, the latent that this was done in: ``("before", "state")`` and so on.
        state: Features of the stochastic state S.
        belief: Features of the deterministic state H.
        action: Number of actions A.
        goal: Features of the goal G; 0 for a world without one.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> keys = [("latent", "state"), ("latent", "belief")]
        >>> transition = TensorDictModule(lambda s, b, a: (s + a, b), in_keys=[*keys, "action"], out_keys=keys)
        >>> reward = TensorDictModule(lambda s, g: s - g, in_keys=[keys[0], ("latent", "goal")], out_keys=["reward"])
        >>> env = ImaginationEnv(transition, reward, state=1, belief=1, action=1, goal=1)
        >>> rollout = env.rollout(3, tensordict=env.reset().expand(5).clone(), auto_reset=False)
        >>> rollout["next", "latent", "goal"].shape
        torch.Size([5, 3, 1])
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        reward: TensorDictModuleBase,
        *,
        state: int,
        belief: int,
        action: int,
        goal: int = 0,
    ) -> None:
        if "before" in map(_first, reward.in_keys):
            transition = TensorDictSequential(_KeepBefore(), transition)
        super().__init__(
            WorldModelWrapper(transition, reward), prior_shape=(state,), belief_shape=(belief,), device=None
        )
        sizes = {"state": state, "belief": belief, **({"goal": goal} if goal else {})}
        latent = Composite({name: Unbounded((size,)) for name, size in sizes.items()})
        self.observation_spec = Composite(latent=latent)
        self.state_spec = self.observation_spec.clone()
        self.action_spec = Bounded(-1, 1, (action,))
        self.reward_spec = Unbounded((1,))

    def rollout(
        self,
        max_steps: int,
        policy: Callable[[TensorDictBase], TensorDictBase] | None = None,
        *args: Any,
        **kwargs: Any,
    ) -> TensorDictBase:
        """Imagine ``max_steps`` steps; takes the arguments of :meth:`torchrl.envs.EnvBase.rollout`.

        A rollout of fixed length from given states, as the losses ask for, runs without the checks that an environment
        needs: on a CPU these take as long as the networks. It takes that short cut if the policy reads nothing but
        ``latent``, and the reward nothing but ``latent``, ``before`` and ``action``. The reward is then called once,
        with all steps ``[*batch, max_steps]``.
        """
        fixed = not args and set(kwargs) == {"auto_reset", "tensordict", "break_when_any_done"}
        if (
            not fixed
            or kwargs["auto_reset"]
            or kwargs["break_when_any_done"]
            or not self._reads_what_is_carried(policy)
        ):
            return super().rollout(max_steps, policy, *args, **kwargs)
        assert policy is not None
        return self._imagine(max_steps, policy, kwargs["tensordict"].select("latent"))

    def _reads_what_is_carried(self, policy: Any) -> bool:
        """Whether ``latent`` is all that has to be carried from step to step."""
        if not isinstance(policy, TensorDictModuleBase):
            return False
        transition = self.world_model.get_transition_model_operator()
        reward = self.world_model.get_reward_operator()
        step = {_first(key) for key in policy.in_keys} | {_first(key) for key in transition.in_keys} - {"action"}
        return step <= {"latent"} and {_first(key) for key in reward.in_keys} <= {"latent", "before", "action"}

    def _imagine(
        self, max_steps: int, policy: Callable[[TensorDictBase], TensorDictBase], step: TensorDictBase
    ) -> TensorDictBase:
        transition = self.world_model.get_transition_model_operator()
        reward = self.world_model.get_reward_operator()
        latents, actions = [step["latent"]], []
        for _ in range(max_steps):
            step = policy(step)
            actions.append(step["action"])
            step = transition(step.select("latent", "action").copy()).select("latent")
            latents.append(step["latent"])
        time, batch = step.ndim, [*step.batch_size, max_steps]
        states, action = torch.stack(latents, time), torch.stack(actions, time)
        before: TensorDictBase = states[..., :-1]
        judged = reward(TensorDict({"latent": states[..., 1:], "before": before.copy(), "action": action}, batch))
        return TensorDict({"latent": before, "action": action, "next": judged.select("latent", "reward")}, batch)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:  # noqa: ARG002
        return self.state_spec.rand() if tensordict is None else tensordict.clone()


class _KeepBefore(TensorDictModuleBase):
    """Keep the latent before a step for the reward; TorchRL has no place for it."""

    in_keys, out_keys = ["latent"], ["before"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("before", tensordict.get("latent").copy())


def _first(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[0]
