from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from torchrl_ocwm.agents import AGENTS, SIZES, build_agent
from torchrl_ocwm.images import ImageSize, image_shape
from torchrl_ocwm.modules.architecture import Architecture
from torchrl_ocwm.modules.networks import make_image_decoder, make_image_encoder, make_mlp
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import STYLES, random_records, reacher_task


@pytest.mark.parametrize("style", ["dreamer_v3", "dreamer_v2"])
def test_styles_build_an_agent_that_learns_from_a_batch(style: str) -> None:
    size = change(SIZES["debug"], STYLES[style])
    loss = build_agent("dreamer_pcp", reacher_task(), size).loss
    losses = loss(random_records(reacher_task(), 2, 3))
    assert all(value.isfinite() for name, value in losses.items() if name.startswith("loss_"))


@pytest.mark.parametrize("style", ["dreamer_v3", "dreamer_v2"])
def test_image_shapes(style: str) -> None:
    encoder, features = make_image_encoder(change(SIZES["debug"], STYLES[style]).architecture, 64)
    assert encoder(torch.zeros(2, 5, 3, 64, 64, dtype=torch.uint8)).shape == (2, 5, features)
    decoder = make_image_decoder(change(SIZES["debug"], STYLES[style]).architecture, 7, 64)
    assert decoder(torch.zeros(2, 5, 4), torch.zeros(2, 5, 3)).shape == (2, 5, 3, 64, 64)


def test_the_style_whose_cnn_has_one_size_says_so() -> None:
    message = "takes images of 64 x 64 pixels, got 32 x 32; style='dreamer_v3' takes images of any size"
    with pytest.raises(ValueError, match=message):
        build_agent("dreamer_pcp", reacher_task(32), change(SIZES["debug"], STYLES["dreamer_v2"]))


@pytest.mark.parametrize(("size", "larger"), [(84, 84), ((30, 70), (32, 72)), ((1, 17), (4, 20))])
def test_images_of_any_size_are_cut_out_of_those_that_the_decoder_can_double_its_way_to(
    size: ImageSize, larger: ImageSize
) -> None:
    architecture = Architecture(cnn_depth=4, cnn_mults=(1, 2))
    encoder, features = make_image_encoder(architecture, size)
    height, width = image_shape(size)
    code = encoder(torch.rand(2, 3, height, width))
    assert code.shape == (2, features)
    decoder, whole = (make_image_decoder(architecture, features, one) for one in (size, larger))
    whole.load_state_dict(decoder.state_dict())
    assert torch.equal(decoder(code), whole(code)[..., :height, :width])  # the encoder begins at the first pixel too


@pytest.mark.parametrize("style", ["dreamer_v3", "dreamer_v2"])
def test_outscale_zero_starts_at_zero(style: str) -> None:
    assert make_mlp(style, 3, 2, layers=2, units=8, outscale=0.0)(torch.randn(5, 3)).abs().max() == 0


def test_an_unknown_style() -> None:
    with pytest.raises(ValueError, match="style must be one of 'dreamer_v3', 'dreamer_v2', got 'dreamer_v4'"):
        make_mlp("dreamer_v4", 3, 2, layers=1, units=4)


@pytest.mark.parametrize("name", SIZES)
def test_every_size_builds(name: str) -> None:
    with torch.device("meta"):
        agent = build_agent(AGENTS["dreamer_pcp"], reacher_task(), name)
    architecture = SIZES[name].architecture
    assert agent.model.belief == architecture.belief
    assert agent.model.state == architecture.categoricals * architecture.classes


V3 = {"DreamerV3MLP", "DreamerV3ImageEncoder", "ImageDecoder", "BlockGRU", "RMSNorm"}
V2 = {"MLP", "ObsEncoder", "ObsDecoder", "GRUCell", "ELU"}


@pytest.mark.parametrize("name", ["dreamer", "focus_lcp"])
@pytest.mark.parametrize(("style", "used", "other"), [("dreamer_v3", V3, V2), ("dreamer_v2", V2, V3)])
def test_every_network_has_the_style(name: str, style: Any, used: set[str], other: set[str]) -> None:
    agent = build_agent(name, reacher_task(), change(SIZES["debug"], STYLES[style]))
    layers = {type(module).__name__ for module in agent.modules()}
    assert used <= layers
    assert not other & layers


def widths(module: nn.Module) -> list[int]:
    return [layer.out_features for layer in module.modules() if isinstance(layer, nn.Linear)]


def test_every_number_reaches_its_network() -> None:
    numbers = {"mlp_layers": 3, "mlp_units": 20, "object_features": 12, "extractor_units": 24, "hidden": 18}
    size = change(SIZES["debug"], {f"architecture.{name}": number for name, number in numbers.items()})
    model = build_agent("focus_lcp", reacher_task(), size).model
    assert widths(model.extractor) == [24, 24, 12]
    assert widths(model.positional_encoder) == [20, 20, 20, 12]
    assert widths(model.position_decoder) == [20, 20, 20, 2]
    assert widths(model.vector_decoders["proprio"]) == [20, 20, 20, 5]
    assert widths(model.encoder.mlp) == [20, 20, 20]
    assert widths(model.continue_head) == [20, 1]
    assert 18 in widths(model.prior)
    assert 18 in widths(model.posterior)
    assert model.prior.unimix == model.posterior.unimix == 0.01
    assert widths(build_agent("dreamer", reacher_task(), size).model.reward_head) == [20, 20, 20, 255]


def test_the_reward_head_starts_at_zero() -> None:
    head = build_agent("dreamer", reacher_task(), "debug").model.reward_head
    assert head(torch.randn(5, 16), torch.randn(5, 16)).abs().max() == 0
