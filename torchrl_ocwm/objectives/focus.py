"""What an object-centric world model is trained to minimise (FOCUS; paper, appendix)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torch.nn.functional import cosine_similarity
from torchrl.objectives import symlog

from torchrl_ocwm.objectives.world_model import WorldModelLoss


def instance_masks(masks: Tensor) -> Tensor:
    """Masks of objects and background that share the pixels out: each belongs to its first object, or to none.

    Args:
        masks: ``[..., O, H, W]`` bool.

    Returns:
        ``[..., O + 1, H, W]`` bool, the background last.

    Examples:
        >>> instance_masks(torch.tensor([[True, True, False], [False, True, False]]).unsqueeze(-2)).squeeze(-2).int()
        tensor([[1, 1, 0],
                [0, 0, 0],
                [0, 0, 1]], dtype=torch.int32)
    """
    taken = masks.cumsum(-3) - masks.long() > 0
    return torch.cat([masks & ~taken, ~masks.any(-3, keepdim=True)], -3)


def mask_nll(mask_logits: Tensor, masks: Tensor) -> Tensor:
    """−log p(m̂) of the true masks, summed over the image and averaged over the batch.

    Args:
        mask_logits: ``[*batch, O + 1, H, W]``, a softmax over objects and background at every pixel.
        masks: ``[*batch, O, H, W]`` bool.

    Examples:
        >>> mask_nll(torch.zeros(2, 2, 1, 1), torch.ones(2, 1, 1, 1, dtype=torch.bool))
        tensor(0.6931)
    """
    likelihood = mask_logits.float().log_softmax(-3) * instance_masks(masks)
    return -likelihood.sum((-3, -2, -1)).mean()


def object_reconstruction(colours: Tensor, pixels: Tensor, masks: Tensor) -> Tensor:
    """Squared error of each instance's colours inside its true mask, summed over the image, averaged over the batch.

    Args:
        colours: ``[*batch, O + 1, 3, H, W]`` in [0, 1].
        pixels: ``[*batch, 3, H, W]`` uint8.
        masks: ``[*batch, O, H, W]`` bool. The mask of a hidden object is empty, so that it adds nothing.

    Examples:
        >>> colours = torch.tensor([1.0, 0.5]).reshape(1, 2, 1, 1, 1).expand(1, 2, 3, 1, 2)
        >>> pixels = torch.zeros(1, 3, 1, 2, dtype=torch.uint8)
        >>> object_reconstruction(colours, pixels, torch.tensor([[[[True, False]]]]))
        tensor(3.7500)
    """
    true = instance_masks(masks)
    # No pixel belongs to two instances, so that one squared error per pixel is enough.
    predicted = (colours.float() * true.unsqueeze(-3)).sum(-4)
    error = (predicted - pixels.float() / 255 * true.any(-3).unsqueeze(-3)).square()
    return error.sum((-3, -2, -1)).mean()


def visible_position_reconstruction(prediction: Tensor, target: Tensor, visible: Tensor) -> Tensor:
    """Squared error of the positions of visible objects in symlog space, summed, and averaged over the batch.

    Args:
        prediction: ``[*batch, O * D]``.
        target: ``[*batch, O * D]``.
        visible: ``[*batch, O]`` bool.

    Examples:
        >>> error = visible_position_reconstruction(torch.zeros(1, 4), torch.full((1, 4), torch.e - 1),
        ...     torch.tensor([[True, False]]))
        >>> error
        tensor(2.)
    """
    error = (symlog(prediction.float()) - symlog(target)).square().unflatten(-1, (visible.shape[-1], -1))
    return (error.sum(-1) * visible).sum(-1).mean()


def positional_latent_loss(
    predicted: Tensor,
    extracted: Tensor,
    visible: Tensor,
    *,
    distance: Literal["cosine", "mse"] = "cosine",
    gradient: Literal["encoder", "latent", "both"] = "both",
) -> Tensor:
    """How far latents encoded from positions are from those of the objects there, averaged over the batch (L_pos).

    Args:
        predicted: ``[*batch, O, L]``, from the true positions.
        extracted: ``[*batch, O, L]``, from the latent of the scene.
        visible: ``[*batch, O]`` bool; hidden objects count nothing.
        distance: Minus the cosine similarity, or the mean squared error.
        gradient: What is trained: the positional encoder, the latents, or both.

    Examples:
        >>> latent = torch.tensor([[[3.0, 4.0]]])
        >>> positional_latent_loss(latent, 2 * latent, torch.tensor([[True]]))
        tensor(-1.)
    """
    if gradient == "encoder":
        extracted = extracted.detach()
    elif gradient == "latent":
        predicted = predicted.detach()
    if distance == "cosine":
        loss = -cosine_similarity(predicted.float(), extracted.float(), dim=-1)
    else:
        loss = (predicted.float() - extracted.float()).square().mean(-1)
    return (loss * visible).sum(-1).mean()


class FOCUSModelLoss(WorldModelLoss):
    """The world model's loss with a term for each thing that is decoded of an object.

    :class:`~torchrl_ocwm.objectives.WorldModelLoss`, whose image term makes room for masks and masked colours. Object
    positions count where the object is visible. With a positional encoder the loss that trains it is added.

    Args:
        world_model: Reads records ``[B, T]``, writes posterior, prior and predictions under ``next``.
        lambda_masks: Weight of the masks, −log p summed over the image.
        lambda_object_pixels: Weight of the colours inside the true masks, squared error summed over the image.
        lambda_positional: Weight of L_pos.
        lambda_image_latent: Weight of what makes an image alone a goal: the position in it, weighted like the object
            positions too, and minus the cosine similarity of its object latents and those of the whole observation.
        positional_distance: ``"cosine"`` or ``"mse"``.
        positional_gradient: What L_pos trains: ``"encoder"``, ``"latent"`` or ``"both"``.
        kwargs: The arguments of :class:`~torchrl_ocwm.objectives.WorldModelLoss`.

    Examples:
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> agent = build_agent("focus_pcp", reacher_task(), size="debug")
        >>> losses, records = FOCUSModelLoss(agent.model.records())(random_records(reacher_task(), 2, 5))
        >>> sorted(losses.keys())
        ['loss_model_continue', 'loss_model_dynamic', 'loss_model_masks', 'loss_model_object_pixels', \
'loss_model_object_position', 'loss_model_proprio', 'loss_model_representation']
    """

    @dataclass
    class _AcceptedKeys(WorldModelLoss._AcceptedKeys):
        """Keys, all under ``next``, beside those of :class:`WorldModelLoss`.

        Attributes:
            masks (NestedKey): True masks, ``[B, T, O, H, W]`` bool. Defaults to ``"masks"``.
            mask_logits (NestedKey): Predicted logits, ``[B, T, O + 1, H, W]``. Defaults to ``"mask_logits"``.
            reco_object_pixels (NestedKey): Predicted colours, ``[B, T, O + 1, 3, H, W]``. Defaults to
                ``"reco_object_pixels"``.
            object_visible (NestedKey): Which objects are seen, ``[B, T, O]`` bool. Defaults to ``"object_visible"``.
            object_latent (NestedKey): Extracted latents, ``[B, T, O + 1, L]``. Defaults to ``"object_latent"``.
            positional_latent (NestedKey): Latents encoded from positions, ``[B, T, O, L]``. Defaults to
                ``"positional_latent"``.
            image_latent (NestedKey): Latents of each image alone, ``[B, T, O + 1, L]``. Defaults to
                ``"image_latent"``.
            reco_image_position (NestedKey): Positions decoded from these, ``[B, T, O * D]``. Defaults to
                ``"reco_image_units"``.
        """

        masks: NestedKey = "masks"
        mask_logits: NestedKey = "mask_logits"
        reco_object_pixels: NestedKey = "reco_object_pixels"
        object_visible: NestedKey = "object_visible"
        object_latent: NestedKey = "object_latent"
        positional_latent: NestedKey = "positional_latent"
        image_latent: NestedKey = "image_latent"
        reco_image_position: NestedKey = "reco_image_units"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _reconstructed = ("proprio", "goal_position")  # the rest is decoded object by object

    def __init__(
        self,
        world_model: TensorDictModuleBase,
        *,
        lambda_masks: float = 1.0,
        lambda_object_pixels: float = 1.0,
        lambda_positional: float = 1.0,
        lambda_image_latent: float = 1.0,
        positional_distance: Literal["cosine", "mse"] = "cosine",
        positional_gradient: Literal["encoder", "latent", "both"] = "both",
        **kwargs: Any,
    ) -> None:
        super().__init__(world_model, **kwargs)
        self.lambda_masks, self.lambda_object_pixels = lambda_masks, lambda_object_pixels
        self.lambda_positional, self.lambda_image_latent = lambda_positional, lambda_image_latent
        self.positional_distance: Literal["cosine", "mse"] = positional_distance
        self.positional_gradient: Literal["encoder", "latent", "both"] = positional_gradient

    @property
    def targets(self) -> list[NestedKey]:
        """What the losses compare predictions with."""
        keys = self.tensor_keys
        return [*super().targets, unravel_key(("next", keys.masks)), unravel_key(("next", keys.object_visible))]

    def _reconstruction_losses(self, records: TensorDictBase) -> dict[str, Tensor]:
        keys = self.tensor_keys
        pixels, masks, visible = (self._next(records, key) for key in (keys.pixels, keys.masks, keys.object_visible))
        losses = super()._reconstruction_losses(records)
        # L_obj (paper, appendix): first the masks, then the colours inside the true masks.
        masks_error = mask_nll(self._next(records, keys.mask_logits), masks)
        colours_error = object_reconstruction(self._next(records, keys.reco_object_pixels), pixels, masks)
        position_error = visible_position_reconstruction(
            self._next(records, keys.reco_object_position), self._next(records, keys.object_position), visible
        )
        losses["loss_model_masks"] = self.lambda_masks * masks_error
        losses["loss_model_object_pixels"] = self.lambda_object_pixels * colours_error
        losses["loss_model_object_position"] = self.lambda_object_position * position_error
        losses.update(self._goal_latent_losses(records, visible))
        return losses

    def _goal_latent_losses(self, records: TensorDictBase, visible: Tensor) -> dict[str, Tensor]:
        """What the two kinds of goals are encoded with: of a position, and of an image alone."""
        keys, losses = self.tensor_keys, {}
        predicted, alone = self._next(records, keys.positional_latent), self._next(records, keys.image_latent)
        latent = self._next(records, keys.object_latent)[..., :-1, :]
        if predicted is not None:
            error = positional_latent_loss(
                predicted, latent, visible, distance=self.positional_distance, gradient=self.positional_gradient
            )
            losses["loss_model_positional"] = self.lambda_positional * error  # L_pos
        if alone is not None:
            error = positional_latent_loss(
                alone[..., :-1, :], latent, visible, distance=self.positional_distance, gradient="encoder"
            )
            losses["loss_model_image_latent"] = self.lambda_image_latent * error
            error = visible_position_reconstruction(
                self._next(records, keys.reco_image_position), self._next(records, keys.object_position), visible
            )
            losses["loss_model_image_position"] = self.lambda_image_latent * self.lambda_object_position * error
        return losses
