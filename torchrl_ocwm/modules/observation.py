"""From observations to embeddings and back."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.modules import DreamerV3ImageEncoder, DreamerV3MLP
from torchrl.objectives import symlog


class ObservationEncoder(nn.Module):
    """Embed an image and vectors: a CNN for the one, an MLP on symlog values for the others, concatenated.

    Args:
        image_size: Height and width of the image, pixels.
        vector_features: Number of values in all vectors together; 0 for images alone.
        cnn_depth: Channels of the first stage before its multiplier.
        cnn_mults: Channel multiplier of each stage; each halves the image.
        mlp_layers: Hidden layers of the MLP.
        mlp_units: Units of each.

    Called with ``pixels`` ``[..., 3, H, W]`` uint8 and vectors ``[..., any]`` float32; returns
    ``[..., features]`` float32.

    Raises:
        ValueError: if the image cannot be halved by every stage.

    Examples:
        >>> encoder = ObservationEncoder(16, 5, cnn_depth=4, cnn_mults=(1, 2), mlp_layers=1, mlp_units=8)
        >>> pixels = torch.zeros(3, 3, 16, 16, dtype=torch.uint8)
        >>> encoder(pixels, torch.zeros(3, 4), torch.zeros(3, 1)).shape == (3, encoder.features)
        True
    """

    def __init__(
        self,
        image_size: int,
        vector_features: int,
        *,
        cnn_depth: int,
        cnn_mults: tuple[int, ...],
        mlp_layers: int,
        mlp_units: int,
    ) -> None:
        super().__init__()
        check_image_size(image_size, cnn_mults)
        self.cnn = DreamerV3ImageEncoder(3, depth=cnn_depth, mults=tuple(cnn_mults))
        self.features = self.cnn.output_features((3, image_size, image_size))
        self.mlp = None
        if vector_features:
            self.mlp = DreamerV3MLP(vector_features, None, depth=mlp_layers, num_cells=mlp_units)
            self.features += mlp_units

    def forward(self, pixels: Tensor, *vectors: Tensor) -> Tensor:
        image = self.cnn(pixels)
        if self.mlp is None:
            return image
        return torch.cat([image, self.mlp(symlog(torch.cat(vectors, -1)))], -1)


def check_image_size(image_size: int, cnn_mults: tuple[int, ...]) -> None:
    """Say so if a CNN of these stages cannot halve an image of this size.

    Raises:
        ValueError: with the multiple that the size must be.
    """
    factor = 2 ** len(cnn_mults)
    if image_size % factor:
        raise ValueError(
            f"a CNN of {len(cnn_mults)} stages halves the image {len(cnn_mults)} times, which an image of "
            f"{image_size} x {image_size} pixels does not allow; use a multiple of {factor}"
        )
