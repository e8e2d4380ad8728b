"""One training step for all agents."""

from __future__ import annotations

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LinearLR
from torchrl.objectives import SoftUpdate
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper, DreamerV3Optimizer

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.training.settings import Training


def make_optimizer(agent: Agent) -> DreamerV3Optimizer:
    """TorchRL's DreamerV3 optimiser with a learning rate each for model, actor and critic."""
    loss, size = agent.loss, agent.size
    groups = [
        (loss.model_loss.parameters(), size.model_lr),
        (loss.actor_loss.actor_model.parameters(), size.actor_lr),
        (loss.value_loss.value_model_params.parameters(), size.value_lr),
    ]
    return DreamerV3Optimizer(
        [{"params": list(parameters), "lr": rate} for parameters, rate in groups], warmup_steps=size.warmup
    )


def make_schedule(optimizer: Optimizer, training: Training) -> LinearLR:
    """Learning rates that fall linearly over a run."""
    return LinearLR(optimizer, 1.0, training.final_lr, total_iters=training.updates)


def make_stepper(agent: Agent, training: Training) -> DreamerV3OptimizationStepper:
    """TorchRL's DreamerV3 stepper: forward, backward, optimiser and slow critic."""
    return DreamerV3OptimizationStepper(
        agent.loss,
        make_optimizer(agent),
        SoftUpdate(agent.loss.value_loss, tau=training.target_rate),
        compile_train_step=training.compile,
        cudagraph=training.cudagraph,
        mixed_precision=training.mixed_precision,
    )
