"""How a training run goes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from torchrl_ocwm.agents.config import check_choices


@dataclass(frozen=True)
class Training:
    """Settings of a training run.

    Args:
        updates: Updates of model, actor and critic in all.
        seed: Seeds weights and sampling.
        device: Where to train.
        threads: Threads of PyTorch on a CPU; 0 leaves PyTorch's own choice.
        log_interval: Updates between two lines of the log, over which losses are averaged. Signals are answered and
            checkpoints are written at these moments, so the other intervals are rounded up to multiples of it.
        checkpoint_interval: Updates between two checkpoints.
        eval_interval: Updates between two evaluations; 0 for none.
        eval_episodes: Episodes per evaluation, one to each of the task's first landmark goals.
        eval_steps: Steps per episode.
        video_interval: Updates between two open-loop prediction videos; 0 for none.
        goals: Goals of the sampled sequences: ``"uniform"`` draws a fresh one for each, ``"stored"`` keeps those of the
            dataset, ``"auto"`` keeps them if the images show them (``virtual_target``), and draws them otherwise.
        compile: Compile the update; ``None`` does so on a GPU only. Takes minutes.
        cudagraph: Capture the update in a CUDA graph; ``None`` does so on a GPU.
        mixed_precision: Products and convolutions in bfloat16. Faster where the device has instructions for it, and the
            model is not small.
        final_lr: Share of the learning rates that is left at the last update; they fall linearly. A policy stops within
            millimetres of its goal only with a small one (docs/results/reacher).
        target_rate: Share of the critic that moves into the slow critic at each update.
        loggers: Where to log beside the CSV files.
    """

    updates: int = 10_000
    seed: int = 0
    device: str = "cpu"
    threads: int = 0
    log_interval: int = 50
    checkpoint_interval: int = 500
    eval_interval: int = 500
    eval_episodes: int = 10
    eval_steps: int = 100
    video_interval: int = 2000
    goals: Literal["auto", "uniform", "stored"] = "auto"
    compile: bool | None = None
    cudagraph: bool | None = None
    mixed_precision: bool = False
    final_lr: float = 0.1
    target_rate: float = 0.02
    loggers: tuple[Literal["tensorboard", "wandb"], ...] = field(default=())

    def __post_init__(self) -> None:
        for name in ("updates", "log_interval", "checkpoint_interval", "eval_episodes", "eval_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.updates % self.log_interval:
            raise ValueError(f"updates must be a multiple of log_interval, got {self.updates} and {self.log_interval}")
        check_choices(self)
