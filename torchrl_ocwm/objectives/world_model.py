"""What a world model is trained to minimise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torchrl.objectives import DreamerV3ModelLoss, categorical_kl_terms, symlog, two_hot_cross_entropy


def image_reconstruction(prediction: Tensor, target: Tensor) -> Tensor:
    """Squared error of an image in [0, 1], summed over its pixels and averaged over the batch.

    Args:
        prediction: ``[*batch, C, H, W]`` float.
        target: ``[*batch, C, H, W]`` uint8, or float in [0, 1].

    Examples:
        >>> import torch
        >>> image_reconstruction(torch.ones(2, 1, 2, 2), torch.zeros(2, 1, 2, 2, dtype=torch.uint8))
        tensor(4.)
    """
    if not target.is_floating_point():
        target = target.float() / 255
    return (prediction.float() - target).square().flatten(-3).sum(-1).mean()


def symlog_reconstruction(prediction: Tensor, target: Tensor) -> Tensor:
    """Squared error of a vector in symlog space, summed over the vector and averaged over the batch.

    Args:
        prediction: ``[*batch, N]``.
        target: ``[*batch, N]``.

    Examples:
        >>> import torch
        >>> symlog_reconstruction(torch.zeros(2, 3), torch.full((2, 3), torch.e - 1))
        tensor(3.)
    """
    return (symlog(prediction.float()) - symlog(target)).square().sum(-1).mean()


class WorldModelLoss(DreamerV3ModelLoss):
    """TorchRL's DreamerV3 model loss with a weight for each thing that is reconstructed.

    Dynamics and representation KL, image and vector reconstruction, reward and continuation, each a ``loss_model_*``
    entry times its weight ``lambda_*``. The weights are those of the paper's loss-rescaling experiment: a goal
    position is three numbers beside thousands of pixels, and only a large ``lambda_goal_position`` makes a model
    remember it. A term whose prediction the world model does not write is left out.

    The KL of each step is clipped from below at ``free_nats`` before it is averaged
    (:func:`~torchrl.objectives.categorical_kl_terms`).

    Args:
        world_model: Reads records ``[B, T]``, writes posterior, prior and predictions under ``next``.
        lambda_dynamic: Weight of the KL that trains the prior.
        lambda_representation: Weight of the KL that trains the posterior.
        lambda_pixels: Weight of the image, squared error in [0, 1] summed over pixels.
        lambda_proprio: Weight of proprioception, squared error in symlog space summed over the vector.
        lambda_object_position: Weight of the object positions, likewise, in workspace units.
        lambda_goal_position: Weight of the goal position, likewise.
        lambda_reward: Weight of the reward, two-hot cross-entropy.
        lambda_continue: Weight of the continuation, binary cross-entropy.
        free_nats: Smallest KL that is charged, nats per step.
        unimix: Share of the uniform distribution in prior and posterior.

    ``forward`` returns the losses and the records with the world model's outputs, gradients attached.

    Raises:
        KeyError: if the batch lacks a key that the world model reads.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> agent = build_agent("dreamer_pcp", reacher_task(), size="debug")
        >>> losses, records = WorldModelLoss(agent.model.records())(random_records(reacher_task(), 2, 5))
        >>> sorted(losses.keys())
        ['loss_model_continue', 'loss_model_dynamic', 'loss_model_object_position', 'loss_model_pixels', \
'loss_model_proprio', 'loss_model_representation']
    """

    @dataclass
    class _AcceptedKeys(DreamerV3ModelLoss._AcceptedKeys):
        """Keys, all under ``next``.

        Attributes:
            reward (NestedKey): Reward in the records, ``[B, T, 1]``. Defaults to ``"reward"``.
            reward_logits (NestedKey): Predicted two-hot logits. Defaults to ``"reward_logits"``.
            prior_logits (NestedKey): Defaults to ``"prior_logits"``.
            posterior_logits (NestedKey): Defaults to ``"posterior_logits"``.
            pixels (NestedKey): Image in the records. Defaults to ``"pixels"``.
            reco_pixels (NestedKey): Predicted image. Defaults to ``"reco_pixels"``.
            proprio (NestedKey): Proprioception in the records. Defaults to ``"proprio"``.
            reco_proprio (NestedKey): Its prediction. Defaults to ``"reco_proprio"``.
            object_position (NestedKey): Object positions, ``[B, T, O * D]`` in workspace units. Defaults to
                ``"object_units"``.
            reco_object_position (NestedKey): Their prediction. Defaults to ``"reco_object_units"``.
            goal_position (NestedKey): Goal position, ``[B, T, D]`` in workspace units. Defaults to ``"goal_units"``.
            reco_goal_position (NestedKey): Its prediction. Defaults to ``"reco_goal_units"``.
            continue_pred (NestedKey): Predicted continuation logit. Defaults to ``"continue_pred"``.
            terminated (NestedKey): Whether the episode ended by itself. Defaults to ``"terminated"``.
            true_reward (NestedKey): Not used; TorchRL's loss has it.
            done (NestedKey): Not used; TorchRL's loss has it.
        """

        proprio: NestedKey = "proprio"
        reco_proprio: NestedKey = "reco_proprio"
        object_position: NestedKey = "object_units"
        reco_object_position: NestedKey = "reco_object_units"
        goal_position: NestedKey = "goal_units"
        reco_goal_position: NestedKey = "reco_goal_units"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _reconstructed: tuple[str, ...] = ("pixels", "proprio", "object_position", "goal_position")

    def __init__(
        self,
        world_model: TensorDictModuleBase,
        *,
        lambda_dynamic: float = 1.0,
        lambda_representation: float = 0.1,
        lambda_pixels: float = 1.0,
        lambda_proprio: float = 1.0,
        lambda_object_position: float = 1.0,
        lambda_goal_position: float = 1.0,
        lambda_reward: float = 1.0,
        lambda_continue: float = 1.0,
        free_nats: float = 1.0,
        unimix: float = 0.01,
    ) -> None:
        super().__init__(
            world_model,
            kl_mode="separate",
            lambda_dynamic=lambda_dynamic,
            lambda_representation=lambda_representation,
            lambda_reward=lambda_reward,
            lambda_continue=lambda_continue,
            free_bits=free_nats,
            unimix=unimix,
            detach_output=False,
        )
        self.lambda_pixels = lambda_pixels
        self.lambda_proprio = lambda_proprio
        self.lambda_object_position = lambda_object_position
        self.lambda_goal_position = lambda_goal_position

    @property
    def targets(self) -> list[NestedKey]:
        """What the losses compare predictions with."""
        keys = self.tensor_keys
        return [unravel_key(("next", key)) for key in (keys.pixels, keys.proprio, keys.reward, keys.terminated)]

    def forward(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Losses of records ``[B, T]``, scalars, and the records with the predictions."""
        missing = [key for key in self.world_model.in_keys if tensordict.get(key, None) is None]
        if missing:
            raise KeyError(
                f"the batch lacks {missing}, which the world model reads; it has {sorted(_names(tensordict))}"
            )
        # A new container: the caller's batch stays as it is. The model overwrites the reward that it predicts.
        records = tensordict.select(*tensordict.keys(True, True))
        reward = self._next(records, self.tensor_keys.reward)
        records = self.world_model(records)
        losses = self._kl_losses(records)
        losses.update(self._reconstruction_losses(records))
        losses.update(self._head_losses(records, reward))
        return TensorDict(losses), records

    def _next(self, records: TensorDictBase, key: NestedKey) -> Any:
        return records.get(unravel_key(("next", key)), None)

    def _kl_losses(self, records: TensorDictBase) -> dict[str, Tensor]:
        dynamic, representation = categorical_kl_terms(
            self._next(records, self.tensor_keys.posterior_logits),
            self._next(records, self.tensor_keys.prior_logits),
            free_nats=self.free_bits,
            unimix=self.unimix,
        )
        return {
            "loss_model_dynamic": self.lambda_dynamic * dynamic,
            "loss_model_representation": self.lambda_representation * representation,
        }

    def _reconstruction_losses(self, records: TensorDictBase) -> dict[str, Tensor]:
        losses = {}
        for name in self._reconstructed:
            prediction = self._next(records, getattr(self.tensor_keys, f"reco_{name}"))
            if prediction is not None:
                target = self._next(records, getattr(self.tensor_keys, name))
                error = image_reconstruction if name == "pixels" else symlog_reconstruction
                losses[f"loss_model_{name}"] = getattr(self, f"lambda_{name}") * error(prediction, target)
        return losses

    def _head_losses(self, records: TensorDictBase, reward: Any) -> dict[str, Tensor]:
        losses = {}
        logits = self._next(records, self.tensor_keys.reward_logits)
        if logits is not None:
            error = two_hot_cross_entropy(logits, reward, self.reward_bins).mean()
            losses["loss_model_reward"] = self.lambda_reward * error
        logits = self._next(records, self.tensor_keys.continue_pred)
        if logits is not None:
            target = (~self._next(records, self.tensor_keys.terminated)).float()
            losses["loss_model_continue"] = self.lambda_continue * binary_cross_entropy_with_logits(logits, target)
        return losses


def _names(tensordict: TensorDictBase) -> list[str]:
    return [str(key) for key in tensordict.keys(True, True)]
