"""Objects inside a world model: their latents, what these look like, and the latent of an object at a position."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_ocwm.images import ImageSize
from torchrl_ocwm.modules.architecture import Architecture, Style
from torchrl_ocwm.modules.networks import make_image_decoder, make_mlp

_AT_ONCE = 256  # images that a CPU decodes; fewer save no more memory


class ObjectLatentExtractor(nn.Module):
    """Object latents from the latent state of the scene, p(s_obj | s, c_obj) (FOCUS; paper, equation 2).

    One MLP for all instances, which are told apart by a one-hot id. The instances are the objects, then the background.

    Args:
        in_features: Features of state and belief together.
        instances: Objects and background O + 1.
        features: Features of an object latent L.
        layers: Hidden layers.
        units: Units of each.
        style: Which layers (:mod:`torchrl_ocwm.modules.networks`).

    Called with state and belief ``[..., any]``; returns ``[..., O + 1, L]``, from one batched pass. With ``first`` it
    extracts that many of the instances only, ``[..., first, L]``.

    Examples:
        >>> extractor = ObjectLatentExtractor(6, instances=3, features=8, units=16)
        >>> extractor(torch.zeros(5, 4), torch.zeros(5, 2)).shape
        torch.Size([5, 3, 8])
    """

    ids: Tensor

    def __init__(
        self,
        in_features: int,
        *,
        instances: int,
        features: int,
        layers: int = 2,
        units: int = 512,
        style: Style = "dreamer_v3",
    ) -> None:
        super().__init__()
        self.instances, self.features = instances, features
        self.mlp = make_mlp(style, in_features + instances, features, layers=layers, units=units)
        self.register_buffer("ids", torch.eye(instances), persistent=False)

    def forward(self, *latent: Tensor, first: int | None = None) -> Tensor:
        """Latents of the instances ``[..., O + 1, L]``, or of the first of them."""
        scene = torch.cat(latent, -1)
        batch, ids = scene.shape[:-1], self.ids[:first]
        scene = scene.unsqueeze(-2).expand(*batch, len(ids), -1)
        return self.mlp(scene, ids.expand(*batch, -1, -1))


class ObjectDecoder(nn.Module):
    """What object latents look like: colours and mask logits of every instance, p(x̂_obj, m̂_obj | s_obj).

    One CNN for all instances. Masks compete: the instance of a pixel is a softmax over the logits of all.

    Args:
        features: Features of an object latent L.
        image_size: Height and width of the images, pixels; one number if they are the same.
        architecture: Shapes of the CNN.

    Called with object latents ``[..., N, L]``; returns colours ``[..., N, 3, H, W]`` in [0, 1], unbounded, and mask
    logits ``[..., N, H, W]``.

    Examples:
        >>> decoder = ObjectDecoder(8, 16, Architecture(cnn_depth=4, cnn_mults=(1, 2)))
        >>> colours, logits = decoder(torch.zeros(5, 3, 8))
        >>> colours.shape, logits.shape
        (torch.Size([5, 3, 3, 16, 16]), torch.Size([5, 3, 16, 16]))
    """

    def __init__(self, features: int, image_size: ImageSize, architecture: Architecture) -> None:
        super().__init__()
        self.cnn = make_image_decoder(architecture, features, image_size, channels=4)

    def forward(self, object_latent: Tensor) -> tuple[Tensor, Tensor]:
        """Colours ``[..., N, 3, H, W]`` and mask logits ``[..., N, H, W]``."""
        colours, mask_logits = self._decode(object_latent).split([3, 1], -3)
        return colours, mask_logits.squeeze(-3)

    def _decode(self, object_latent: Tensor) -> Tensor:
        """``[..., N, 4, H, W]``. A CPU decodes many images some at a time: with their gradients they take memory."""
        latents = object_latent.flatten(0, -2)
        if latents.device.type != "cpu" or len(latents) <= _AT_ONCE:
            return self.cnn(object_latent)
        images = torch.cat([self.cnn(some) for some in latents.split(_AT_ONCE)])
        return images.unflatten(0, object_latent.shape[:-1])


def compose(colours: Tensor, mask_logits: Tensor) -> Tensor:
    """The image of the scene: every pixel in the colours of its instances, weighted by their masks.

    Args:
        colours: ``[..., N, 3, H, W]``.
        mask_logits: ``[..., N, H, W]``.

    Returns:
        ``[..., 3, H, W]``.

    Examples:
        >>> colours = torch.tensor([0.0, 1.0]).reshape(2, 1, 1, 1).expand(2, 3, 1, 1)
        >>> compose(colours, torch.tensor([0.0, 3.0]).log1p().reshape(2, 1, 1)).flatten()
        tensor([0.8000, 0.8000, 0.8000])
    """
    return (mask_logits.softmax(-3).unsqueeze(-3) * colours).sum(-4)


class LatentPositionalEncoder(nn.Module):
    """The latent of an object at a position, p(ŝ_obj | p_obj) (paper, section LCP).

    Args:
        dim: Coordinates of a position D.
        objects: Number of objects O.
        features: Features of an object latent L.
        layers: Hidden layers.
        units: Units of each.
        style: Which layers (:mod:`torchrl_ocwm.modules.networks`).

    Called with positions ``[..., O, D]`` in workspace units; returns ``[..., O, L]``. With ``object_index`` and
    positions ``[..., 1, D]`` it encodes one object, ``[..., 1, L]``.

    Examples:
        >>> encoder = LatentPositionalEncoder(2, objects=3, features=8, units=16)
        >>> positions = torch.rand(5, 3, 2)
        >>> latents = encoder(positions)
        >>> torch.allclose(encoder(positions[:, 1:2], object_index=1), latents[:, 1:2], atol=1e-6)
        True
    """

    ids: Tensor

    def __init__(
        self,
        dim: int,
        *,
        objects: int,
        features: int,
        layers: int = 4,
        units: int = 400,
        style: Style = "dreamer_v3",
    ) -> None:
        super().__init__()
        self.features = features
        self.mlp = make_mlp(style, dim + objects, features, layers=layers, units=units)
        self.register_buffer("ids", torch.eye(objects), persistent=False)

    def forward(self, position: Tensor, object_index: int | None = None) -> Tensor:
        """Latents ``[..., O, L]`` of positions ``[..., O, D]``, or those of one object."""
        ids = self.ids if object_index is None else self.ids[object_index : object_index + 1]
        return self.mlp(position, ids.expand(*position.shape[:-2], -1, -1))
