"""One training step for all agents."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR
from torchrl.objectives import SoftUpdate
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.training.optimizer import make_optimizer
from torchrl_ocwm.training.settings import Training


def make_schedule(optimizer: Optimizer, training: Training) -> LambdaLR:
    """Learning rates that fall linearly over a run; a run that goes on for longer follows its new settings."""
    # LinearLR keeps the old length in its state, and with it the lowest rates for all that is added to a run.
    return LambdaLR(optimizer, lambda update: 1 - (1 - training.final_lr) * min(update / training.updates, 1))


class Stepper(DreamerV3OptimizationStepper):
    """TorchRL's DreamerV3 stepper, which keeps mixed precision to GPUs; this one has it on CPUs too."""

    def _forward_backward(self, sample: TensorDictBase) -> TensorDictBase:
        device = sample.get(self.loss_module.in_keys[0]).device
        with torch.autocast(device.type, torch.bfloat16, enabled=self.mixed_precision):
            losses = self.loss_module(sample)
        total = sum(value for key, value in losses.items() if isinstance(key, str) and key.startswith("loss_"))
        # A graph needs gradients in the same place each time; without one, new tensors save a pass over each.
        self.optimizer.zero_grad(set_to_none=not any(self.resolve(device)))
        total.backward()
        return losses.detach()


def make_stepper(agent: Agent, training: Training) -> DreamerV3OptimizationStepper:
    """A stepper: forward, backward, optimiser and slow critic."""
    return Stepper(
        agent.loss,
        make_optimizer(agent),
        SoftUpdate(agent.loss.value_loss, tau=training.target_rate),
        compile_train_step=training.compile,
        cudagraph=training.cudagraph,
        mixed_precision=training.mixed_precision,
    )
