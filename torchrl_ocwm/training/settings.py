"""How a training run goes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torchrl_ocwm.settings import Settings, SettingsError, setting


@dataclass(frozen=True)
class Training(Settings):
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
            dataset.
        compile: Compile the update; ``None`` does so on a GPU only. Takes minutes.
        cudagraph: Capture the update in a CUDA graph; ``None`` does so on a GPU.
        mixed_precision: Products and convolutions in bfloat16. Faster where the device has instructions for it, and the
            model is not small.
        final_lr: Share of the learning rates that is left at the last update; they fall linearly. A policy stops within
            millimetres of its goal only with a small one (docs/results/reacher).
        target_rate: Share of the critic that moves into the slow critic at each update.
        loggers: Where to log beside the CSV files.
    """

    updates: int = setting(10_000, at_least=1, at_most=10**9)
    seed: int = setting(0, at_least=0, at_most=2**32 - 1)
    device: str = "cpu"
    threads: int = setting(0, at_least=0, at_most=1024)
    log_interval: int = setting(50, at_least=1)
    checkpoint_interval: int = setting(500, at_least=1)
    eval_interval: int = setting(500, at_least=0)
    eval_episodes: int = setting(10, at_least=1)
    eval_steps: int = setting(100, at_least=1)
    video_interval: int = setting(2000, at_least=0)
    goals: Literal["uniform", "stored"] = "uniform"
    compile: bool | None = None
    cudagraph: bool | None = None
    mixed_precision: bool = False
    final_lr: float = setting(0.1, at_least=0, at_most=1)
    target_rate: float = setting(0.02, above=0, at_most=1)
    loggers: tuple[Literal["tensorboard", "wandb"], ...] = ()

    def check(self) -> None:
        """Whole ticks of the log."""
        if self.updates % self.log_interval:
            raise SettingsError(
                f"updates must be a multiple of log_interval, got {self.updates} and {self.log_interval}"
            )
