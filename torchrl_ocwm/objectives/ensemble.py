"""What trains the ensemble that an explorer is rewarded by."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.objectives import LossModule

from torchrl_ocwm.modules.ensemble import OneStepEnsemble


class EnsembleLoss(LossModule):
    """Squared error of an ensemble's predictions of the next frame, averaged over members, frames and features.

    All members learn from the same records. A first record of an episode has no step before it and does not count.

    Args:
        ensemble: The ensemble; its parameters are those that are trained.

    Called with ``records`` ``[B, T]``, which carry what the world model made of them.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> agent = build_agent("plan2explore", reacher_task(), size="debug")
        >>> records = agent.model.records()(random_records(reacher_task(), 2, 5))
        >>> loss = agent.behaviour("explore").loss.reward_loss
        >>> loss(TensorDict({"records": records.detach()}))["loss_ensemble"].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the records.

        Attributes:
            state (NestedKey): Posterior state under ``next``, ``[B, T, S]``. Defaults to ``"state"``.
            belief (NestedKey): Belief under ``next``, ``[B, T, H]``. Defaults to ``"belief"``.
            target (NestedKey): What is predicted, under ``next``, ``[B, T, any]``. Defaults to ``"encoded_latents"``.
            action (NestedKey): The action that led to ``next``, ``[B, T, A]``. Defaults to ``"action"``.
            is_init (NestedKey): First records of episodes, ``[B, T, 1]`` bool. Defaults to ``"is_init"``.
        """

        state: NestedKey = "state"
        belief: NestedKey = "belief"
        target: NestedKey = "encoded_latents"
        action: NestedKey = "action"
        is_init: NestedKey = "is_init"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(self, ensemble: OneStepEnsemble) -> None:
        super().__init__()
        self.ensemble = ensemble

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        pass

    @property
    def in_keys(self) -> list[NestedKey]:
        """What is read of the records."""
        keys = self.tensor_keys
        after = [("next", key) for key in (keys.state, keys.belief, keys.target)]
        return [unravel_key(("records", key)) for key in (*after, keys.action, keys.is_init)]

    @property
    def out_keys(self) -> list[NestedKey]:
        """The loss."""
        return ["loss_ensemble"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss, a scalar."""
        state, belief, target, action, is_init = (tensordict.get(key).detach() for key in self.in_keys)
        predictions = self.ensemble(state[:, :-1], belief[:, :-1], action[:, 1:])
        error = (predictions.float() - target[:, 1:].float()).square().mean(-1)
        counts = ~is_init[:, 1:].squeeze(-1)
        return TensorDict({"loss_ensemble": (error * counts).mean(0).sum() / counts.sum().clamp_min(1)})
