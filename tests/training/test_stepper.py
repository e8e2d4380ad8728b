"""One update: mixed precision."""

import torch
from tensordict import TensorDictBase

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.testing import random_records, reacher_task
from torchrl_ocwm.training.settings import Training
from torchrl_ocwm.training.stepper import make_stepper


def first_update(mixed_precision: bool) -> tuple[TensorDictBase, list[torch.dtype], list[torch.dtype]]:
    """Losses of one update, and the dtypes of a product in it and of the weights after it."""
    torch.manual_seed(0)
    agent = build_agent("focus_lcp", reacher_task(), "debug")
    products: list[torch.dtype] = []
    layer = next(module for module in agent.model.extractor.modules() if isinstance(module, torch.nn.Linear))
    layer.register_forward_hook(lambda module, inputs, output: products.append(output.dtype))
    losses = make_stepper(agent, Training(mixed_precision=mixed_precision)).step(None, random_records(agent.task, 4, 8))
    return losses, products, [parameter.dtype for parameter in agent.parameters()]


def test_mixed_precision_works_on_a_cpu() -> None:
    single, single_products, _ = first_update(False)
    mixed, mixed_products, weights = first_update(True)
    assert set(single_products) == {torch.float32}
    assert set(mixed_products) == {torch.bfloat16}
    assert set(weights) == {torch.float32}
    for name in ("loss_model_object_position", "loss_model_masks", "loss_model_image_latent"):
        assert mixed[name] != single[name]
        torch.testing.assert_close(mixed[name].float(), single[name], rtol=0.02, atol=0.02)
