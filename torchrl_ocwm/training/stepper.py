"""One training step for all agents."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock
from tensordict import TensorDict, TensorDictBase
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR
from torchrl.objectives import SoftUpdate
from torchrl.trainers import Trainer
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.objectives import GoalConditionedDreamerLoss
from torchrl_ocwm.settings import SettingsError
from torchrl_ocwm.training.allocator import keep_freed_memory
from torchrl_ocwm.training.settings import Training


def make_schedule(optimizer: Optimizer, training: Training) -> LambdaLR:
    """Learning rates that fall linearly over a run; a run that goes on for longer follows its new settings."""
    # LinearLR keeps the old length in its state, and with it the lowest rates for all that is added to a run.
    return LambdaLR(optimizer, lambda update: 1 - (1 - training.final_lr) * min(update / training.updates, 1))


def one_graph() -> AbstractContextManager[None]:
    """Let ``torch.compile`` trace a backward pass together with what it differentiates.

    Raises:
        SettingsError: if this PyTorch cannot.
    """
    dynamo = torch._dynamo.config
    if not hasattr(dynamo, "trace_autograd_ops"):  # PyTorch 2.11 makes wrong code of the parts, after minutes
        raise SettingsError(
            f"training.compile=true needs PyTorch 2.12 or newer, this is {torch.__version__}; leave it null"
        )
    return dynamo.patch(trace_autograd_ops=True)


def one_at_a_time() -> FileLock:
    """Where processes compile for themselves, one after the other: two that write one cache have crashed."""
    from torch._inductor.runtime.cache_dir_utils import cache_dir  # takes seconds to import

    folder = Path(cache_dir())
    folder.mkdir(parents=True, exist_ok=True)
    return FileLock(folder / "torchrl_ocwm.lock")


class Stepper(DreamerV3OptimizationStepper):
    """TorchRL's DreamerV3 stepper with mixed precision on CPUs too, and nothing in the step that breaks its graph."""

    def _prepare_sample(self, sample: TensorDictBase) -> TensorDictBase:
        return sample.select(*self.loss_module.in_keys, strict=False)

    def _forward_backward(self, sample: TensorDictBase) -> TensorDictBase:
        device, results = sample.get(self.loss_module.tensor_keys.is_init).device.type, TensorDict()
        parts = self.loss_module.parts(sample)
        while True:
            with torch.autocast(device, torch.bfloat16, enabled=self.mixed_precision):
                losses = next(parts, None)
            if losses is None:
                return results
            sum(value for key, value in losses.items() if isinstance(key, str) and key.startswith("loss_")).backward()
            results.update(losses.detach())
            del losses

    def warmup(self, sample: TensorDictBase) -> None:
        """Compile or capture the step on representative data; nothing is trained."""
        device = sample.get("action").device
        compiles, _ = self.resolve(device)
        # Inductor's C++ for both passes in bfloat16 declares a variable twice (PyTorch 2.13); apart, they compile.
        apart = device.type == "cpu" and self.mixed_precision
        graph = one_graph() if compiles and not apart else nullcontext()
        with graph, one_at_a_time() if compiles else nullcontext():
            super().warmup(sample)

    def step(self, trainer: Trainer | None, sub_batch: TensorDictBase) -> TensorDictBase:
        """Update model, actor, critic and slow critic; returns detached metrics."""
        # A graph needs gradients in the same place each time; without one, new tensors save a pass over each.
        self.optimizer.zero_grad(set_to_none=not any(self.resolve(sub_batch.get("action").device)))
        return super().step(trainer, sub_batch)


class SlowCritics:
    """The slow critics of all behaviours move together.

    Args:
        loss: The loss whose behaviours have them.
        tau: Share of the critic that moves into its slow critic at each step.
    """

    def __init__(self, loss: GoalConditionedDreamerLoss, *, tau: float) -> None:
        self.updaters = {name: SoftUpdate(one.value_loss, tau=tau) for name, one in loss.behaviours.items()}

    def step(self) -> None:
        """Move them."""
        for updater in self.updaters.values():
            updater.step()

    def state_dict(self) -> dict[str, Any]:
        """State of each."""
        return {name: updater.state_dict() for name, updater in self.updaters.items()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore each."""
        for name, updater in self.updaters.items():
            updater.load_state_dict(state_dict[name])


def make_stepper(agent: Agent, training: Training) -> DreamerV3OptimizationStepper:
    """A stepper: forward, backward, optimiser and slow critic. On a CPU the process keeps the memory that they free.

    Raises:
        SettingsError: if it is to be compiled, and this PyTorch cannot.
    """
    if training.compile:
        one_graph()  # raises now, not after minutes
    if torch.device(training.device).type == "cpu":
        keep_freed_memory()
    return Stepper(
        agent.loss,
        agent.size.learning.optimizer.build(agent.parameter_groups()),
        SlowCritics(agent.loss, tau=training.target_rate),
        compile_train_step=bool(training.compile),
        cudagraph=training.cudagraph,
        mixed_precision=training.mixed_precision,
    )
