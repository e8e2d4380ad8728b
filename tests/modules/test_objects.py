from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_ocwm.agents import SIZES
from torchrl_ocwm.modules import (
    LatentPositionalEncoder,
    LatentSimilarityReward,
    MovingCentre,
    ObjectDecoder,
    ObjectLatentExtractor,
)
from torchrl_ocwm.modules.architecture import Architecture
from torchrl_ocwm.modules.objects import compose
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import STYLES


def test_extractor_is_one_mlp_per_id() -> None:
    """One batched pass gives what one pass per object and sample gives."""
    extractor = ObjectLatentExtractor(6, instances=3, features=5, units=8)
    state, belief = torch.randn(4, 2, 4), torch.randn(4, 2, 2)
    latents = extractor(state, belief)
    for i in range(4):
        for j in range(2):
            for instance in range(3):
                one_hot = torch.zeros(3)
                one_hot[instance] = 1
                alone = extractor.mlp(torch.cat([state[i, j], belief[i, j], one_hot]))
                torch.testing.assert_close(latents[i, j, instance], alone)
    assert (latents[:, :, 0] - latents[:, :, 1]).abs().max() > 1e-4


def test_extractor_of_the_first_instances() -> None:
    extractor = ObjectLatentExtractor(6, instances=3, features=8, units=16)
    state, belief = torch.randn(5, 4), torch.randn(5, 2)
    torch.testing.assert_close(extractor(state, belief, first=2), extractor(state, belief)[:, :2])


@pytest.mark.parametrize("style", ["dreamer_v3", "dreamer_v2"])
def test_decoder_takes_each_latent_alone(style: Any) -> None:
    decoder = ObjectDecoder(8, 64, change(SIZES["debug"], STYLES[style]).architecture)
    latents = torch.randn(2, 3, 8)
    colours, logits = decoder(latents)
    assert colours.shape == (2, 3, 3, 64, 64)
    for i in range(2):
        for instance in range(3):
            alone_colours, alone_logits = decoder(latents[i : i + 1, instance : instance + 1])
            torch.testing.assert_close(colours[i, instance], alone_colours[0, 0], rtol=1e-4, atol=1e-5)
            torch.testing.assert_close(logits[i, instance], alone_logits[0, 0], rtol=1e-4, atol=1e-5)


def test_many_images_are_decoded_some_at_a_time() -> None:
    decoder = ObjectDecoder(8, 16, Architecture(cnn_depth=2, cnn_mults=(1, 2)))
    latents, sizes = torch.randn(100, 3, 8), []
    expected = decoder.cnn(latents)
    decoder.cnn.register_forward_hook(lambda module, inputs, images: sizes.append(len(images)))
    colours, logits = decoder(latents)
    assert sizes == [256, 44]
    torch.testing.assert_close(torch.cat([colours, logits.unsqueeze(-3)], -3), expected)


def test_compose_pixel_by_pixel() -> None:
    colours, logits = torch.rand(2, 3, 3, 4, 5), torch.randn(2, 3, 4, 5)
    image = compose(colours, logits)
    for batch in range(2):
        for row in range(4):
            for column in range(5):
                weights = logits[batch, :, row, column].exp()
                expected = sum(w * c for w, c in zip(weights, colours[batch, :, :, row, column], strict=True))
                torch.testing.assert_close(image[batch, :, row, column], expected / weights.sum())


def test_positional_encoder_per_object() -> None:
    encoder = LatentPositionalEncoder(2, objects=3, features=5, units=8)
    positions = torch.rand(4, 3, 2)
    latents = encoder(positions)
    for index in range(3):
        one_hot = torch.zeros(3)
        one_hot[index] = 1
        for i in range(4):
            alone = encoder.mlp(torch.cat([positions[i, index], one_hot]))
            torch.testing.assert_close(latents[i, index], alone)
        torch.testing.assert_close(
            encoder(positions[:, index : index + 1], object_index=index)[:, 0], latents[:, index]
        )


class TestLatentSimilarityReward:
    data = TensorDict(
        {
            "object_latent": torch.tensor([[[3.0, 4.0], [0.0, -2.0], [9.0, 9.0]]]),
            "latent": {"goal": torch.tensor([[0.0, 5.0]])},
        },
        [1],
    )

    @pytest.mark.parametrize(("index", "expected"), [(0, 0.8), (1, -1.0)])
    def test_cosine_by_hand(self, index: int, expected: float) -> None:
        reward = LatentSimilarityReward(object_index=index)(self.data.clone())["reward"]
        torch.testing.assert_close(reward, torch.tensor([[expected]]))

    def test_mse_by_hand(self) -> None:
        reward = LatentSimilarityReward(distance="mse")(self.data.clone())["reward"]
        torch.testing.assert_close(reward, torch.tensor([[-5.0]]))

    @pytest.mark.parametrize(("index", "expected"), [(0, -math.sqrt(0.4)), (1, -2.0)])
    def test_chord_by_hand(self, index: int, expected: float) -> None:
        reward = LatentSimilarityReward(object_index=index, distance="chord")(self.data.clone())["reward"]
        torch.testing.assert_close(reward, torch.tensor([[expected]]))

    def test_centred_chord_by_hand(self) -> None:
        """Directions (0.6, 0.8) and (0, 1) minus their mean (0.6, 0.6): (0, 0.2) and (-0.6, 0.4)."""
        centre = MovingCentre(2).eval()
        centre.mean.fill_(0.6)
        reward = LatentSimilarityReward(distance="chord", centre=centre)(self.data.clone())["reward"]
        torch.testing.assert_close(reward, -torch.tensor([[math.sqrt(2 - 2 * 0.4 / math.sqrt(0.52))]]))
        centre.mean.zero_()
        again = LatentSimilarityReward(distance="chord", centre=centre)(self.data.clone())["reward"]
        torch.testing.assert_close(again, torch.tensor([[-math.sqrt(0.4)]]))

    def test_a_centre_where_lengths_count(self) -> None:
        with pytest.raises(ValueError, match="only chords take a centre, not distance='mse'"):
            LatentSimilarityReward(distance="mse", centre=MovingCentre(2))

    def test_unknown_distance(self) -> None:
        with pytest.raises(ValueError, match="distance must be one of 'cosine', 'mse', 'chord', got 'euclid'"):
            LatentSimilarityReward(distance="euclid")  # type: ignore[arg-type]

    def test_chord_keeps_its_slope_where_the_cosine_is_flat(self) -> None:
        slopes = {}
        for distance in ("cosine", "chord"):
            latent = torch.tensor([[[1.0, 0.01]]], requires_grad=True)
            data = TensorDict({"object_latent": latent, "latent": {"goal": torch.tensor([[2.0, 0.0]])}}, [1])
            LatentSimilarityReward(distance=distance)(data)["reward"].sum().backward()
            slopes[distance] = -float(latent.grad[0, 0, 1])
        assert slopes["cosine"] == pytest.approx(0.01, rel=1e-3)
        assert slopes["chord"] == pytest.approx(1.0, rel=1e-3)


def test_positions_come_from_the_objects_own_latent(make_agent: Any) -> None:
    """The position of an object depends on its latent, and the background has none."""
    model = make_agent("focus_pcp").model
    latents = torch.randn(3, 2, model.extractor.features, requires_grad=True)
    positions = model.position_decoder(latents)
    assert positions.shape == (3, 2)
    positions.sum().backward()
    assert latents.grad is not None
    assert latents.grad[:, 0].abs().min() > 0
    assert latents.grad[:, 1].abs().max() == 0


def test_model_pixels_are_the_composed_instances(make_agent: Any) -> None:
    model = make_agent("focus").model
    state, belief = torch.rand(2, model.state), torch.rand(2, model.belief)
    image: Tensor = model.pixels(state, belief)
    colours, logits = model.object_decoder(model.extractor(state, belief))
    weights = logits.exp() / logits.exp().sum(1, keepdim=True)
    torch.testing.assert_close(image, torch.einsum("bnhw,bnchw->bchw", weights, colours))
