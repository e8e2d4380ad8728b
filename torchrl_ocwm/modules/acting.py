"""The policy that acts in an environment."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase, is_tensor_collection
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key

LATENT: list[NestedKey] = [("latent", "state"), ("latent", "belief"), ("latent", "action")]


class ActingLatent(TensorDictModuleBase):
    """Let a policy carry its latent through any rollout, without primers or state of its own.

    Rollouts and collectors carry the root of the tensordict from step to step, and with it ``latent``, which holds the
    state, the belief and the action of the step before. At the very first step there is none yet: zeros are written.
    An exported policy has nothing that carries it: see :func:`refuse_export_without_latent`.

    Args:
        state: Features of the stochastic state S.
        belief: Features of the deterministic state H.
        action: Number of actions A.

    Raises:
        KeyError: if the environment does not mark the first steps of episodes.
    """

    def __init__(self, state: int, belief: int, action: int) -> None:
        super().__init__()
        self.sizes = dict(zip(LATENT, (state, belief, action), strict=True))
        self.in_keys, self.out_keys = ["is_init", *LATENT], [*LATENT]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write zeros where there is no latent yet."""
        start = tensordict.get("is_init", None)
        if start is None:
            raise KeyError(
                "the policy needs 'is_init' to know where episodes start; append torchrl.envs.InitTracker() to the "
                "environment, as torchrl_ocwm.envs.make_env does"
            )
        if not tensordict.batch_size:  # called with tensors by name, of which tensordict does not know the batch
            tensordict.batch_size = start.shape[:-1]
        for key, size in self.sizes.items():
            if tensordict.get(key, None) is None:
                tensordict.set(key, torch.zeros(*tensordict.batch_size, size, device=start.device))
        return tensordict


def refuse_export_without_latent(policy: TensorDictModuleBase, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    """A forward pre-hook (``with_kwargs=True``) of policies that begin with an :class:`ActingLatent`.

    ``torch.export`` of a policy takes the latent as inputs ``latent_state``, ``latent_belief`` and ``latent_action``,
    and returns the next one. Without it every step would be the first.

    Raises:
        ValueError: if the latent is not among the inputs of an export.
    """
    if not torch.compiler.is_exporting():
        return
    if args and is_tensor_collection(args[0]):
        given = {unravel_key(key) for key in args[0].keys(True, True)}
    else:
        given = {*policy.in_keys[: len(args)], *(key for key in LATENT if "_".join(key) in kwargs)}
    missing = ["_".join(key) for key in LATENT if key not in given]
    if missing:
        raise ValueError(
            f"an exported policy has no memory without its latent: {', '.join(missing)} are missing; give zeros at the "
            "first step, and afterwards what the step before returned"
        )
