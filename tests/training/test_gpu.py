"""Updates on a GPU: compiled, captured in a CUDA graph, in bfloat16; runs that begin or go on there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.agents import SIZES, build_agent
from torchrl_ocwm.evidence import Machine
from torchrl_ocwm.evidence.estimate import seconds_of_an_update
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import random_dataset, random_records, reacher_task
from torchrl_ocwm.training.offline import train_offline
from torchrl_ocwm.training.settings import Training
from torchrl_ocwm.training.stepper import make_stepper

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]

compiles = pytest.mark.skipif(
    not hasattr(torch._dynamo.config, "trace_autograd_ops"), reason="needs PyTorch 2.12 or newer"
)


def losses(name: str, updates: int = 3, **settings: Any) -> list[TensorDict]:
    """Losses of the first updates of a debug agent on one batch."""
    torch.manual_seed(0)
    agent = build_agent(name, reacher_task(), change(SIZES["debug"], {"learning.batch_size": 4})).cuda()
    batch = random_records(reacher_task(), 4, 8).cuda()
    stepper = make_stepper(agent, Training(device="cuda", **settings))
    if any(stepper.resolve(torch.device("cuda"))):
        stepper.warmup(batch)
    return [stepper.step(None, batch.clone()).clone() for _ in range(updates)]


def world_model_losses(steps: list[TensorDict]) -> torch.Tensor:
    names = ("loss_model_pixels", "loss_model_object_position", "loss_model_dynamic")
    return torch.stack([step[name].float() for step in steps for name in names])


@pytest.mark.parametrize("name", ["dreamer", "dreamer_pcp"])
@pytest.mark.parametrize(
    ("compiled", "captured"),
    [pytest.param(True, False, marks=compiles), (False, True), pytest.param(True, True, marks=compiles)],
)
def test_compiled_and_captured_updates_are_close_to_eager(name: str, compiled: bool, captured: bool) -> None:
    eager = world_model_losses(losses(name, compile=False, cudagraph=False))
    fast = world_model_losses(losses(name, compile=compiled, cudagraph=captured))
    # The noise differs, so that sampled states do; the size of the losses does not.
    torch.testing.assert_close(fast, eager, rtol=0.05, atol=0.05)


@pytest.mark.parametrize("name", ["dreamer", "dreamer_pcp"])
def test_bfloat16_is_finite_and_close(name: str) -> None:
    single = losses(name, compile=False, cudagraph=False)
    half = losses(name, compile=False, cudagraph=False, mixed_precision=True)
    for step in half:
        assert all(value.isfinite().all() for key, value in step.items() if key.startswith("loss_"))
    torch.testing.assert_close(world_model_losses(half), world_model_losses(single), rtol=0.05, atol=0.05)


@pytest.mark.parametrize(("first", "then"), [("cuda", "cpu"), ("cpu", "cuda")])
def test_a_run_goes_on_elsewhere(tmp_path: Path, first: str, then: str) -> None:
    dataset = random_dataset(tmp_path / "data", reacher_task())
    for device, updates in ((first, 2), (then, 4)):
        agent = build_agent("dreamer_pcp", reacher_task(), "debug")
        training = Training(device=device, updates=updates, log_interval=1, eval_interval=0, final_lr=1)
        train_offline(agent, dataset, tmp_path / "run", training, progress=False)
        assert next(agent.parameters()).device.type == device
    log = (tmp_path / "run" / "log" / "scalars" / "loss_value.csv").read_text()
    assert [int(line.split(",")[0]) for line in log.splitlines()] == [1, 2, 3, 4]


def test_updates_can_be_timed_for_a_forecast() -> None:
    assert 0 < seconds_of_an_update(build_agent("dreamer", reacher_task(), "debug"), Machine(device="cuda")) < 10
