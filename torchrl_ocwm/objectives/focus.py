"""What an object-centric world model is trained to minimise (FOCUS; paper, appendix)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn.functional import cosine_similarity

from torchrl_ocwm.modules.dtypes import flags
from torchrl_ocwm.objectives.annealing import AnnealedWeight
from torchrl_ocwm.objectives.world_model import Term, WeightedModelLoss, image_reconstruction
from torchrl_ocwm.settings import read

LatentDistance = Literal["cosine", "mse"]
PositionalGradient = Literal["encoder", "latent", "both"]


def instance_masks(masks: Tensor) -> Tensor:
    """Masks of objects and background that share the pixels out: each is of its first object, or of the background.

    Args:
        masks: ``[..., O, H, W]`` bool, or integers that are 0 outside.

    Returns:
        ``[..., O + 1, H, W]`` bool, the background last.

    Examples:
        >>> instance_masks(torch.tensor([[True, True, False], [False, True, False]]).unsqueeze(-2)).squeeze(-2).int()
        tensor([[1, 1, 0],
                [0, 0, 0],
                [0, 0, 1]], dtype=torch.int32)
    """
    first, *others = flags(masks, "masks").unbind(-3)
    instances, free = [first], ~first
    for mask in others:
        instances.append(mask & free)
        free = free & ~mask
    return torch.stack([*instances, free], -3)


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
        pixels: ``[*batch, 3, H, W]`` uint8, or floating point in [0, 1].
        masks: ``[*batch, O, H, W]`` bool. The mask of a hidden object is empty, so that it adds nothing.

    Examples:
        >>> colours = torch.tensor([1.0, 0.5]).reshape(1, 2, 1, 1, 1).expand(1, 2, 3, 1, 2)
        >>> pixels = torch.zeros(1, 3, 1, 2, dtype=torch.uint8)
        >>> object_reconstruction(colours, pixels, torch.tensor([[[[True, False]]]]))
        tensor(3.7500)
    """
    # Each pixel belongs to one instance, so that one squared error per pixel is enough.
    *objects, predicted = colours.float().unbind(-4)
    for colour, mask in zip(objects, instance_masks(masks).unbind(-3), strict=False):
        predicted = torch.where(mask.unsqueeze(-3), colour, predicted)
    return image_reconstruction(predicted, pixels)


def positional_latent_loss(
    predicted: Tensor,
    extracted: Tensor,
    visible: Tensor,
    *,
    distance: LatentDistance = "cosine",
    gradient: PositionalGradient = "both",
) -> Tensor:
    """How far latents encoded from positions are from those of the objects there, averaged over the batch (L_pos).

    Args:
        predicted: ``[*batch, O, L]``, from the true positions.
        extracted: ``[*batch, O, L]``, from the latent of the scene.
        visible: ``[*batch, O]`` bool; hidden objects count nothing.
        distance: Minus the cosine similarity, or the mean squared error.
        gradient: What is trained: the positional encoder, the latents, or both.

    Raises:
        ValueError: for another distance or gradient.

    Examples:
        >>> latent = torch.tensor([[[3.0, 4.0]]])
        >>> positional_latent_loss(latent, 2 * latent, torch.tensor([[True]]))
        tensor(-1.)
    """
    read(LatentDistance, distance, "distance")
    read(PositionalGradient, gradient, "gradient")
    if gradient == "encoder":
        extracted = extracted.detach()
    elif gradient == "latent":
        predicted = predicted.detach()
    if distance == "cosine":
        loss = -cosine_similarity(predicted.float(), extracted.float(), dim=-1)
    else:
        loss = (predicted.float() - extracted.float()).square().mean(-1)
    return (loss * flags(visible, "object_visible")).sum(-1).mean()


class FOCUSModelLoss(WeightedModelLoss):
    """The world model's loss with a term for each thing that is decoded of an object.

    :class:`~torchrl_ocwm.objectives.WeightedModelLoss`, whose image term makes room for masks and masked colours. With
    a positional encoder the loss that trains it is added.

    Args:
        world_model: Reads records ``[B, T]``, writes posterior, prior and predictions under ``next``.
        lambda_masks: Weight of the masks, −log p summed over the image.
        lambda_object_pixels: Weight of the colours inside the true masks, squared error summed over the image.
        lambda_positional: Weight of L_pos.
        positional_distance: ``"cosine"``, the default, or ``"mse"``.
        positional_gradient: What L_pos trains: ``"encoder"``, ``"latent"`` or ``"both"``, the default.
        positional_annealing: The last weight of L_pos, and after how many updates it has it
            (:class:`~torchrl_ocwm.objectives.AnnealedWeight`); none: its weight stays.
        kwargs: The arguments of :class:`~torchrl_ocwm.objectives.WeightedModelLoss`, but for ``lambda_pixels``; its
            ``lambda_image_latent`` is about object latents here.

    Raises:
        ValueError: for an unknown distance or gradient, and as :class:`~torchrl_ocwm.objectives.WeightedModelLoss`
            does, for a setting of a term that the world model does not predict.

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
    class _AcceptedKeys(WeightedModelLoss._AcceptedKeys):
        """Keys, all under ``next``, beside those of :class:`WeightedModelLoss`.

        Attributes:
            masks (NestedKey): True masks, ``[B, T, O, H, W]`` bool. Defaults to ``"masks"``.
            mask_logits (NestedKey): Predicted logits, ``[B, T, O + 1, H, W]``. Defaults to ``"mask_logits"``.
            reco_object_pixels (NestedKey): Predicted colours, ``[B, T, O + 1, 3, H, W]``. Defaults to
                ``"reco_object_pixels"``.
            object_latent (NestedKey): Extracted latents, ``[B, T, O + 1, L]``. Defaults to ``"object_latent"``.
            positional_latent (NestedKey): Latents encoded from positions, ``[B, T, O, L]``. Defaults to
                ``"positional_latent"``.
            image_latent (NestedKey): Latents of each image alone, ``[B, T, O + 1, L]``. Defaults to
                ``"image_latent"``.
        """

        masks: NestedKey = "masks"
        mask_logits: NestedKey = "mask_logits"
        reco_object_pixels: NestedKey = "reco_object_pixels"
        object_latent: NestedKey = "object_latent"
        positional_latent: NestedKey = "positional_latent"
        image_latent: NestedKey = "image_latent"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        world_model: TensorDictModuleBase,
        *,
        lambda_masks: float | None = None,
        lambda_object_pixels: float | None = None,
        lambda_positional: float | None = None,
        positional_distance: LatentDistance | None = None,
        positional_gradient: PositionalGradient | None = None,
        positional_annealing: tuple[float, int] | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(world_model, **kwargs)
        self._set_weights(
            masks=lambda_masks,
            object_pixels=lambda_object_pixels,
            positional=lambda_positional,
        )
        others = {"distance": positional_distance, "gradient": positional_gradient, "annealing": positional_annealing}
        for name, value in others.items():
            if value is not None:
                self._given[f"positional_{name}"] = "positional"
        self.positional_distance: LatentDistance = read(
            LatentDistance, positional_distance or "cosine", "positional_distance"
        )
        self.positional_gradient: PositionalGradient = read(
            PositionalGradient, positional_gradient or "both", "positional_gradient"
        )
        if positional_annealing is not None:
            first = 1.0 if lambda_positional is None else lambda_positional
            self.lambda_positional = AnnealedWeight(first, *positional_annealing)

    def terms(self) -> dict[str, Term]:
        """Masks and masked colours in place of the image, and what the two kinds of goals are encoded with."""
        terms = super().terms()
        image_position = terms.pop("image_position")
        del terms["pixels"], terms["image_latent"]
        return {
            **terms,
            # L_obj (paper, appendix): first the masks, then the colours inside the true masks.
            "masks": Term("mask_logits", ("masks",), mask_nll),
            "object_pixels": Term("reco_object_pixels", ("pixels", "masks"), object_reconstruction),
            "positional": Term("positional_latent", ("object_latent", "object_visible"), self._positional),  # L_pos
            "image_latent": Term("image_latent", ("object_latent", "object_visible"), self._image_latent),
            "image_position": image_position,
        }

    def _positional(self, predicted: Tensor, latent: Tensor, visible: Tensor) -> Tensor:
        objects = latent[..., :-1, :]
        distance, gradient = self.positional_distance, self.positional_gradient
        return positional_latent_loss(predicted, objects, visible, distance=distance, gradient=gradient)

    def _image_latent(self, alone: Tensor, latent: Tensor, visible: Tensor) -> Tensor:
        objects, distance = latent[..., :-1, :], self.positional_distance
        return positional_latent_loss(alone[..., :-1, :], objects, visible, distance=distance, gradient="encoder")
