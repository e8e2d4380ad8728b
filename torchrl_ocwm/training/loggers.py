"""One run, several loggers."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torch import Tensor
from torchrl.record.loggers import CSVLogger, Logger


class Loggers:
    """Passes scalars and videos to several of TorchRL's loggers.

    Args:
        loggers: The loggers.
    """

    def __init__(self, loggers: list[Logger]) -> None:
        self.loggers = loggers

    def state_dict(self) -> dict[str, Any]:
        """Nothing to keep: the files are appended to."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Nothing to restore."""

    def log_scalar(self, name: str, value: Tensor | float, step: int | None = None) -> None:
        """Log one value."""
        for logger in self.loggers:
            logger.log_scalar(name, float(value), step=step)

    def log_video(self, name: str, file: Path, step: int | None = None) -> None:
        """Show a video file in Weights & Biases; the other loggers do not take files."""
        for logger in self.loggers:
            if type(logger).__name__ == "WandbLogger":
                import wandb

                logger.log_metrics({name: wandb.Video(str(file))}, step=step)


def make_loggers(folder: Path, also: tuple[str, ...] = (), *, name: str = "run") -> Loggers:
    """CSV files in ``folder/log``, and what else is asked for.

    Args:
        folder: Folder of the run.
        also: ``"tensorboard"`` or ``"wandb"``.
        name: Name of the run, where runs have names.

    Raises:
        ValueError: for an unknown logger.
        ModuleNotFoundError: if its package is missing, with the extra to install.
    """
    loggers: list[Logger] = [CSVLogger("log", log_dir=str(folder))]
    for kind in also:
        if kind not in ("tensorboard", "wandb"):
            raise ValueError(f"unknown logger {kind!r}; there are tensorboard and wandb, beside the CSV files")
        if find_spec(kind) is None:
            raise ModuleNotFoundError(
                f"logger {kind!r} is not installed: pip install 'torchrl-ocwm[{kind}]'", name=kind
            )
        if kind == "tensorboard":
            from torchrl.record.loggers.tensorboard import TensorboardLogger

            loggers.append(TensorboardLogger("tensorboard", log_dir=str(folder)))
        else:
            from torchrl.record.loggers.wandb import WandbLogger

            loggers.append(WandbLogger(name, save_dir=str(folder), project="torchrl_ocwm"))
    return Loggers(loggers)
