"""The networks of a world model, all of them TorchRL's parts, in two styles.

``"dreamer_v3"``: RMS normalisation, SiLU, a block GRU. ``"dreamer_v2"``: no normalisation, MLPs with ELU, a plain GRU,
the CNN of the first Dreamers: as near to the paper's networks as TorchRL's parts come.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.modules import (
    MLP,
    DreamerV3ImageDecoder,
    DreamerV3ImageEncoder,
    DreamerV3MLP,
    ObsDecoder,
    ObsEncoder,
)

from torchrl_ocwm.images import ImageSize, image_shape
from torchrl_ocwm.modules.architecture import Architecture, Style
from torchrl_ocwm.modules.dtypes import unit_image
from torchrl_ocwm.modules.recurrence import BlockGRU, Posterior, Prior
from torchrl_ocwm.modules.rms_norm import fast_norms
from torchrl_ocwm.modules.upsampling import upsample
from torchrl_ocwm.settings import SettingsError, read

UNIMIX = 0.01


def make_mlp(
    style: Style, in_features: int, out_features: int | None, *, layers: int, units: int, outscale: float = 1.0
) -> nn.Module:
    """A multilayer perceptron; several inputs are concatenated.

    Args:
        style: Which layers.
        in_features: Features of all inputs together.
        out_features: Features of the output; ``None``: the last hidden layer.
        layers: Hidden layers.
        units: Units of each.
        outscale: Factor on the initial weights of the last layer; 0 starts with an output of zero.

    Examples:
        >>> make_mlp("dreamer_v2", 5, 3, layers=1, units=8, outscale=0.0)(torch.ones(2, 4), torch.ones(2, 1))[0]
        tensor([0., 0., 0.], grad_fn=<SelectBackward0>)
    """
    read(Style, style, "style")
    if style == "dreamer_v3":
        return fast_norms(DreamerV3MLP(in_features, out_features, depth=layers, num_cells=units, outscale=outscale))
    if out_features is None:
        return MLP(in_features, units, layers - 1, units, activation_class=nn.ELU, activate_last_layer=True)
    mlp = MLP(in_features, out_features, layers, units, activation_class=nn.ELU)
    with torch.no_grad():
        mlp[-1].weight.mul_(outscale)
        mlp[-1].bias.zero_()
    return mlp


def make_image_encoder(architecture: Architecture, image_size: ImageSize) -> tuple[nn.Module, int]:
    """A CNN for images ``[..., 3, H, W]`` uint8 or float32 in [0, 1], and the number of features that it gives.

    Raises:
        SettingsError: if the style has no CNN for such images.
    """
    depth, mults = architecture.cnn_depth, architecture.cnn_mults
    _check_image_size(architecture, image_size)
    if architecture.style == "dreamer_v3":
        encoder = DreamerV3ImageEncoder(3, depth, mults)
        return fast_norms(encoder), encoder.output_features((3, *image_shape(image_size)))
    return nn.Sequential(_ScaledImage(), ObsEncoder(depth, in_channels=3)), depth * 8 * 2 * 2


def make_image_decoder(
    architecture: Architecture, in_features: int, image_size: ImageSize, *, channels: int = 3
) -> nn.Module:
    """A CNN from latents to images ``[..., channels, H, W]`` float32 in [0, 1], unbounded."""
    depth, mults = architecture.cnn_depth, architecture.cnn_mults
    _check_image_size(architecture, image_size)
    if architecture.style == "dreamer_v3":
        shape = (channels, *image_shape(image_size))
        return fast_norms(ImageDecoder(in_features, shape, depth, mults, num_blocks=1))
    return _ShiftedImage(ObsDecoder(depth, latent_dim=in_features, out_channels=channels))


def make_rssm(architecture: Architecture, *, action: int, embedding: int) -> tuple[Prior, Posterior]:
    """Prior and posterior of a discrete RSSM.

    Args:
        architecture: Their shapes.
        action: Number of actions A.
        embedding: Features of an embedded observation.
    """
    v3 = architecture.style == "dreamer_v3"
    prior = Prior(
        action_shape=(action,),
        action_dim=action,
        hidden_dim=architecture.hidden,
        rnn_hidden_dim=architecture.belief,
        num_categoricals=architecture.categoricals,
        num_classes=architecture.classes,
        recurrent_model="block_gru" if v3 else "gru",
        num_blocks=architecture.gru_blocks,
        unimix=UNIMIX,
    )
    posterior = Posterior(
        hidden_dim=architecture.hidden,
        rnn_hidden_dim=architecture.belief,
        obs_embed_dim=embedding,
        num_categoricals=architecture.categoricals,
        num_classes=architecture.classes,
        use_rms_norm=v3,
        unimix=UNIMIX,
    )
    if v3:
        prior.rnn = BlockGRU(prior.rnn)
    return fast_norms(prior), fast_norms(posterior)


def _check_image_size(architecture: Architecture, image_size: ImageSize) -> None:
    height, width = image_shape(image_size)
    if architecture.style == "dreamer_v2" and (height, width) != (64, 64):
        raise SettingsError(
            f"the CNN of style 'dreamer_v2' takes images of 64 x 64 pixels, got {height} x {width}; "
            "style='dreamer_v3' takes images of any size"
        )


class ImageDecoder(DreamerV3ImageDecoder):
    """TorchRL's decoder for images of any size, which are cut out of those that it can double its way to.

    It adds the middle of the range in its last layer instead of to each pixel.

    Args:
        in_features: Features of all inputs together.
        image_shape: Channels, height and width of the images.
        depth: Channels of the last stage before its multiplier.
        mults: Channel multiplier of each stage, as the encoder has them.
        num_blocks: Blocks of the first layer.
    """

    def __init__(
        self, in_features: int, image_shape: tuple[int, int, int], depth: int, mults: tuple[int, ...], num_blocks: int
    ) -> None:
        channels, *self.size = image_shape
        step = 2 ** len(mults)
        height, width = (-(-side // step) * step for side in self.size)
        super().__init__(in_features, (channels, height, width), depth, mults, num_blocks=num_blocks)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Images ``[..., C, H, W]`` of latents."""
        latent = torch.cat(inputs, -1)
        hidden = self.projection(latent.reshape(-1, latent.shape[-1])).unflatten(-1, self.initial_shape)
        hidden = self.layers[:-1](self.projection_norm(hidden))  # with its SiLU
        image = upsample(hidden, self.layers[-1], shift=0.5)
        # The encoder's stages begin at the first pixel too, so that a pixel is decoded from where it was encoded.
        image = image[..., : self.size[0], : self.size[1]]
        return image.reshape(*latent.shape[:-1], *image.shape[1:])


class _ScaledImage(nn.Module):
    """To [−0.5, 0.5]."""

    def forward(self, pixels: Tensor) -> Tensor:
        return unit_image(pixels) - 0.5


class _ShiftedImage(nn.Module):
    """[−0.5, 0.5] to [0, 1], what image targets are."""

    def __init__(self, decoder: nn.Module) -> None:
        super().__init__()
        self.decoder = decoder

    def forward(self, *latent: Tensor) -> Tensor:
        whole = torch.cat(latent, -1)
        return self.decoder(whole, whole[..., :0]) + 0.5
