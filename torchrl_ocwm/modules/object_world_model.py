"""The object-centric world model: what is seen is decoded object by object."""

from __future__ import annotations

from typing import Any

from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn

from torchrl_ocwm.images import ImageSize
from torchrl_ocwm.modules.architecture import Architecture
from torchrl_ocwm.modules.latent import LatentsInEmbedding, LatentsInImages
from torchrl_ocwm.modules.networks import make_mlp
from torchrl_ocwm.modules.objects import LatentPositionalEncoder, ObjectDecoder, ObjectLatentExtractor, compose
from torchrl_ocwm.modules.world_model import RSSMWorldModel, VectorName, key_at, latent_at
from torchrl_ocwm.settings import SettingsError


class ObjectWorldModel(RSSMWorldModel):
    """The world model of FOCUS: object latents are extracted from the latent of the scene and decoded one by one.

    Colours and masks come from an :class:`~torchrl_ocwm.modules.ObjectDecoder`, positions from an MLP on each object
    latent. What is not an object, proprioception and goal, is decoded from the latent of the scene.

    Args:
        image_size: Height and width of the images, pixels; one number if they are the same.
        objects: Number of objects O; the background is one instance more.
        observed: Vectors that the encoder sees.
        predicted: Vectors that are decoded beside these, though it does not see them.
        positional_encoder: Whether to learn the latent of an object at a position (LCP).
        architecture: Shapes of the networks.
        kwargs: The other arguments of :class:`~torchrl_ocwm.modules.RSSMWorldModel`.

    Raises:
        SettingsError: if the object positions are neither observed nor predicted.

    Examples:
        >>> from torchrl_ocwm.testing import random_records, reacher_task
        >>> from torchrl_ocwm.agents import build_agent
        >>> model = build_agent("focus_pcp", reacher_task(), size="debug").model
        >>> records = model.records()(random_records(reacher_task(), 2, 5))
        >>> records["next", "mask_logits"].shape
        torch.Size([2, 5, 2, 64, 64])
    """

    def __init__(
        self,
        *,
        image_size: ImageSize,
        objects: int,
        observed: tuple[VectorName, ...],
        predicted: tuple[VectorName, ...] = (),
        positional_encoder: bool,
        architecture: Architecture,
        **kwargs: Any,
    ) -> None:
        if "object_position" not in (*observed, *predicted):
            raise SettingsError(
                "an object-centric world model learns from object positions: 'object_position' in `observed`, or in "
                "`predicted`"
            )
        super().__init__(
            image_size=image_size,
            objects=objects,
            observed=observed,
            predicted=predicted,
            of_scene=tuple(name for name in (*observed, *predicted) if name != "object_position"),
            architecture=architecture,
            **kwargs,
        )
        features, dim = architecture.object_features, self.units.dim
        self.objects = objects
        self.extractor = ObjectLatentExtractor(
            self.latent_features,
            instances=objects + 1,
            features=features,
            units=architecture.extractor_units,
            style=architecture.style,
        )
        self.object_decoder = ObjectDecoder(features, image_size, architecture)
        positions = make_mlp(in_features=features, out_features=dim, **architecture.mlp)
        self.position_decoder = _ObjectPositions(objects, positions)
        self.positional_encoder = None
        if positional_encoder:
            self.positional_encoder = LatentPositionalEncoder(
                dim, objects=objects, features=features, **architecture.mlp
            )

    def vectors(self, *at: str) -> list[TensorDictModuleBase]:
        """Object latents and positions, and the vectors that are not of objects."""
        modules: list[TensorDictModuleBase] = [
            *super().vectors(*at),
            TensorDictModule(self.extractor, latent_at(at), [key_at(at, "object_latent")]),
            TensorDictModule(self.position_decoder, [key_at(at, "object_latent")], [key_at(at, "reco_object_units")]),
        ]
        return modules

    def images(self, *at: str) -> list[TensorDictModuleBase]:
        """``reco_object_pixels`` and ``mask_logits``."""
        out = [key_at(at, "reco_object_pixels"), key_at(at, "mask_logits")]
        return [TensorDictModule(self.object_decoder, [key_at(at, "object_latent")], out)]

    def records(self) -> TensorDictSequential:
        """Posterior, prior and predictions for records ``[B, T]``; everything is read and written under ``next``.

        With a positional encoder also the two latents that goals are made of: ``positional_latent`` ``[B, T, O, L]``
        of the true positions, and ``image_latent`` ``[B, T, O + 1, L]`` of each image alone with the positions
        ``reco_image_units`` ``[B, T, O * D]`` in it.
        """
        records = super().records()
        if self.positional_encoder is None:
            return records
        encode = _LatentsAt(self.objects, self.positional_encoder)
        image, at_image = ("next", "image_latent"), ("next", "reco_image_units")
        return TensorDictSequential(
            records,
            TensorDictModule(encode, [("next", "object_units")], [("next", "positional_latent")]),
            TensorDictModule(LatentsInEmbedding(self.latents_in_images()), [("next", "encoded_latents")], [image]),
            TensorDictModule(self.position_decoder, [image], [at_image]),
        )

    def latents_in_images(self) -> LatentsInImages:
        """Object latents ``[..., O + 1, L]`` of what images ``[..., F, 3, H, W]`` uint8 show, one after the other."""
        return LatentsInImages(self.encoder, self.latent_of_images(), self.extractor)

    def pixels(self, state: Tensor, belief: Tensor) -> Tensor:
        """Predicted images ``[..., 3, H, W]`` in [0, 1], unbounded: all instances together."""
        return compose(*self.object_decoder(self.extractor(state, belief)))

    def object_position(self) -> TensorDictModuleBase:
        """Decoded object positions ``object_units`` ``[..., O * D]``, in workspace units."""
        return TensorDictSequential(
            self.object_latent(self.objects),
            TensorDictModule(self.position_decoder, ["object_latent"], ["object_units"]),
        )

    def object_latent(self, first: int | None = None) -> TensorDictModule:
        """Extracted object latents ``object_latent`` ``[..., O + 1, L]`` of imagined latents, or the first of them."""
        return TensorDictModule(_Instances(self.extractor, first), latent_at(("latent",)), ["object_latent"])


class _Instances(nn.Module):
    """State and belief to the object latents of the first instances ``[..., first, L]``, of all for ``None``."""

    def __init__(self, extractor: ObjectLatentExtractor, first: int | None) -> None:
        super().__init__()
        self.extractor, self.first = extractor, first

    def forward(self, state: Tensor, belief: Tensor) -> Tensor:
        return self.extractor(state, belief, first=self.first)


class _ObjectPositions(nn.Module):
    """Object latents ``[..., O + 1, L]`` to positions ``[..., O * D]``; the background has none."""

    def __init__(self, objects: int, mlp: nn.Module) -> None:
        super().__init__()
        self.objects, self.mlp = objects, mlp

    def forward(self, object_latent: Tensor) -> Tensor:
        latents = object_latent[..., : self.objects, :].contiguous()  # or a linear layer copies its weights per sample
        return self.mlp(latents).flatten(-2)


class _LatentsAt(nn.Module):
    """Positions ``[..., O * D]`` to the latents ``[..., O, L]`` of the objects there."""

    def __init__(self, objects: int, encoder: LatentPositionalEncoder) -> None:
        super().__init__()
        self.objects, self.encoder = objects, encoder

    def forward(self, object_units: Tensor) -> Tensor:
        return self.encoder(object_units.unflatten(-1, (self.objects, -1)))
