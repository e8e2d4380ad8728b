"""From observations to embeddings and back."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import pad
from torchrl.objectives import symlog

from torchrl_ocwm.images import ImageSize, image_shape
from torchrl_ocwm.modules.architecture import Architecture
from torchrl_ocwm.modules.dtypes import unit_image
from torchrl_ocwm.modules.networks import make_image_encoder, make_mlp


class ObservationEncoder(nn.Module):
    """Embed an image and vectors: a CNN for the one, an MLP on symlog values for the others, concatenated.

    Args:
        image_size: Height and width of the image, pixels; one number if they are the same.
        vector_features: Number of values in all vectors together; 0 for images alone.
        architecture: Shapes of CNN and MLP.

    Called with ``pixels`` ``[..., 3, H, W]``, uint8 or floating point in [0, 1], and vectors ``[..., any]``;
    returns ``[..., features]`` float32. Without vectors their part of the embedding is zero (:meth:`image_alone`).

    Raises:
        SettingsError: if the style has no CNN for such images.
        ValueError: when called, for inputs of other shapes.

    Examples:
        >>> encoder = ObservationEncoder(16, 5, Architecture(cnn_depth=4, cnn_mults=(1, 2)))
        >>> pixels = torch.zeros(3, 3, 16, 16, dtype=torch.uint8)
        >>> encoder(pixels, torch.zeros(3, 4), torch.zeros(3, 1)).shape == (3, encoder.features)
        True
    """

    def __init__(self, image_size: ImageSize, vector_features: int, architecture: Architecture) -> None:
        super().__init__()
        self.cnn, self.features = make_image_encoder(architecture, image_size)
        self.image_size, self.vector_features, self.mlp_units = image_size, vector_features, architecture.mlp_units
        self.mlp = None
        if vector_features:
            self.mlp = make_mlp(in_features=vector_features, out_features=None, **architecture.mlp)
            self.features += self.mlp_units

    def forward(self, pixels: Tensor, *vectors: Tensor) -> Tensor:
        """The embedding of an image and vectors."""
        self._check_vectors(vectors)
        image = self.image(pixels)
        if self.mlp is None:
            return image
        if not vectors:
            return pad(image, (0, self.features - image.shape[-1]))
        return torch.cat([image, self.mlp(symlog(torch.cat(vectors, -1).float()))], -1)

    def image(self, pixels: Tensor) -> Tensor:
        """The part of an embedding that is of the image, of images ``[..., 3, H, W]``."""
        expected = (3, *image_shape(self.image_size))
        if pixels.shape[-3:] != expected:
            raise ValueError(f"this model takes images of shape (..., *{expected}), got {tuple(pixels.shape)}")
        return self.cnn(unit_image(pixels))

    @property
    def image_features(self) -> int:
        """How many of the features are of the image."""
        return self.features - (0 if self.mlp is None else self.mlp_units)

    def image_alone(self, embedding: Tensor) -> Tensor:
        """Embeddings ``[..., features]`` of image and vectors to those that the images have without vectors."""
        return pad(embedding[..., : self.image_features], (0, self.features - self.image_features))

    def _check_vectors(self, vectors: tuple[Tensor, ...]) -> None:
        if vectors and sum(vector.shape[-1] for vector in vectors) != self.vector_features:
            shapes = [tuple(vector.shape) for vector in vectors]
            raise ValueError(f"this model takes vectors of {self.vector_features} values in all, got shapes {shapes}")
