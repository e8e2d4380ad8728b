"""How updates and evaluations share the cores of a machine."""

from __future__ import annotations

import os

import torch

from torchrl_ocwm.agents.config import Size
from torchrl_ocwm.training.settings import Training

_SMALL = 128  # units of a layer; a second thread costs its products more than it does


def update_threads(training: Training, size: Size) -> int:
    """Threads of PyTorch that updates run in on a CPU; 0 for PyTorch's own choice."""
    if training.threads is not None:
        return training.threads
    return 1 if size.architecture.mlp_units <= _SMALL else 0


def evaluates_beside(training: Training, size: Size) -> bool:
    """Whether evaluations get a process of their own: as the settings say, or if updates leave a core free."""
    if training.eval_beside is not None:
        return training.eval_beside
    on_cpu = torch.device(training.device).type == "cpu"
    threads = update_threads(training, size) or torch.get_num_threads()
    return _cores() > (threads if on_cpu else 1)


def _cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
