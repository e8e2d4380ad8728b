"""One update: mixed precision and learning rates."""

from pathlib import Path
from typing import Any

import pytest
import torch
from filelock import FileLock, Timeout
from tensordict import TensorDict, TensorDictBase
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper

from torchrl_ocwm.agents import EXPLORERS, build_agent
from torchrl_ocwm.settings import SettingsError
from torchrl_ocwm.testing import random_records, reacher_task
from torchrl_ocwm.training.settings import Training
from torchrl_ocwm.training.stepper import make_schedule, make_stepper, one_graph


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


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(torch._dynamo.config, "trace_autograd_ops"), reason="needs PyTorch 2.12 or newer")
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("dreamer", {}),
        ("dreamer_pcp", {}),
        ("focus_lcp", {"behaviours.reach.goals": "mixed", "behaviours.reach.goal.final_weight": 1.0}),
    ],
)
@pytest.mark.usefixtures("no_noise")
def test_update_compiles_into_one_graph(make_agent: Any, records: TensorDict, name: str, changes: dict) -> None:
    """Forward and backward without a graph break, to the same losses and gradients."""
    records, results = records[:, :3], []
    for compiled in (False, True):
        agent = make_agent(name, changes)
        step = make_stepper(agent, Training())._forward_backward
        with one_graph():
            losses = torch.compile(step, fullgraph=True, backend="eager")(records) if compiled else step(records)
        results.append((losses, {key: p.grad for key, p in agent.named_parameters() if p.grad is not None}))
    (expected, gradients), (losses, traced) = results
    for key in expected.keys(True, True):
        torch.testing.assert_close(losses[key], expected[key], msg=str(key))
    assert traced.keys() == gradients.keys()
    for key, gradient in gradients.items():
        rounding = 1e-5 * max(1.0, float(gradient.abs().max()))  # of a sum of such numbers
        torch.testing.assert_close(traced[key], gradient, rtol=1e-4, atol=rounding, msg=str(key))


def rates(training: Training, state: dict | None = None) -> tuple[list[float], dict]:
    """Learning rates at four updates, the first of which is at the given state, and the state after them."""
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(()))], lr=2.0)
    schedule = make_schedule(optimizer, training)
    if state is not None:
        schedule.load_state_dict(state)
    seen = []
    for _ in range(4):
        optimizer.step()
        schedule.step()
        seen.append(optimizer.param_groups[0]["lr"])
    return seen, schedule.state_dict()


def test_learning_rates_fall_linearly_and_stay_at_the_end() -> None:
    assert rates(Training(updates=3, log_interval=1, final_lr=0.1))[0] == pytest.approx([1.4, 0.8, 0.2, 0.2])


def test_a_run_that_goes_on_for_longer_follows_its_new_settings() -> None:
    _, finished = rates(Training(updates=4, log_interval=1, final_lr=0.1))
    assert rates(Training(updates=8, log_interval=1, final_lr=0.2), finished)[0] == pytest.approx([1.0, 0.8, 0.6, 0.4])


def test_a_pytorch_that_cannot_compile_is_named_at_once(make_agent: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(torch._dynamo.config, "trace_autograd_ops")
    with pytest.raises(SettingsError, match=r"compile=true needs PyTorch 2.12 or newer, this is .*; leave it null"):
        make_stepper(make_agent(), Training(compile=True))
    assert not make_stepper(make_agent(), Training()).compile_train_step


@pytest.mark.parametrize("compiles", [True, False])
def test_two_processes_do_not_compile_at_the_same_time(
    make_agent: Any, records: TensorDict, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, compiles: bool
) -> None:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "cache"))
    stepper, held = make_stepper(make_agent(), Training(compile=compiles, cudagraph=False)), []

    def warmup(*_: Any) -> None:
        try:
            FileLock(tmp_path / "cache" / "torchrl_ocwm.lock", timeout=0).acquire()
        except Timeout:
            held.append("held")

    monkeypatch.setattr(DreamerV3OptimizationStepper, "warmup", warmup)
    stepper.warmup(records)
    assert held == (["held"] if compiles else [])


def test_the_world_model_is_differentiated_before_behaviours_imagine(make_agent: Any, records: TensorDict) -> None:
    """So that one graph at a time is in memory."""
    agent, before = make_agent("focus_pcp", {"behaviours.explore": EXPLORERS["plan2explore"]}), []
    weight = next(agent.model.encoder.parameters())
    for behaviour in agent.loss.behaviours.values():
        behaviour.register_forward_pre_hook(lambda *_: before.append(weight.grad is not None))
    make_stepper(agent, Training()).step(None, records)
    assert before == [True, True]
