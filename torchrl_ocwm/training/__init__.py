"""How it runs: training on a dataset, and training that collects its own."""

from torchrl_ocwm.training.cores import evaluates_beside
from torchrl_ocwm.training.memory import check_memory
from torchrl_ocwm.training.offline import train_offline
from torchrl_ocwm.training.online import collect_seed_steps, train_online
from torchrl_ocwm.training.run import CHECKPOINT
from torchrl_ocwm.training.settings import Online, Training
from torchrl_ocwm.training.stepper import make_stepper

__all__ = [
    "CHECKPOINT",
    "Online",
    "Training",
    "check_memory",
    "collect_seed_steps",
    "evaluates_beside",
    "make_stepper",
    "train_offline",
    "train_online",
]
