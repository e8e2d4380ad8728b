"""One run, several loggers."""

from __future__ import annotations

from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torch import Tensor
from torchrl.record.loggers import CSVLogger, Logger

from torchrl_ocwm.errors import MissingPackageError, UserError
from torchrl_ocwm.files import replacing
from torchrl_ocwm.settings import SettingsError


class LogError(UserError, RuntimeError):
    """The log cannot be written; the message says where and why."""


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
        """Log one value.

        Raises:
            LogError: if it cannot be written.
        """
        for logger in self.loggers:
            try:
                logger.log_scalar(name, float(value), step=step)
            except OSError as error:
                _drop_files(logger)
                raise LogError(
                    f"{logger.log_dir}: cannot write the log ({error.strerror or error}); the last checkpoint is kept: "
                    "mend that, and run the same command again"
                ) from error

    def cut_back(self, step: int) -> None:
        """Forget what was logged after a step, for a run that goes on from there.

        Rows of CSV files are removed, also one that was cut off. TensorBoard is told to hide what comes after the step.
        Weights & Biases shows what goes on as a run of its own.
        """
        for logger in self.loggers:
            if isinstance(logger, CSVLogger):
                for file in Path(logger.log_dir, logger.exp_name, "scalars").rglob("*.csv"):
                    _cut(file, step)
            elif type(logger).__name__ == "TensorboardLogger":
                from tensorboard.compat.proto.event_pb2 import Event, SessionLog

                restart = Event(step=step + 1, session_log=SessionLog(status=SessionLog.START))
                logger.experiment.file_writer.add_event(restart)

    def log_video(self, name: str, file: Path, step: int | None = None) -> None:
        """Show a video file in TensorBoard, among the images, and in Weights & Biases; CSV files take none."""
        for logger in self.loggers:
            if type(logger).__name__ == "TensorboardLogger":
                _show_in_tensorboard(logger, name, file, step)
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
        SettingsError: for an unknown logger.
        MissingPackageError: if its package is missing, with the extra to install.
    """
    loggers: list[Logger] = [CSVLogger("log", log_dir=str(folder))]
    for kind in also:
        if kind not in ("tensorboard", "wandb"):
            raise SettingsError(f"unknown logger {kind!r}; there are tensorboard and wandb, beside the CSV files")
        if find_spec(kind) is None:
            raise MissingPackageError(
                f"logger {kind!r} is not installed: pip install 'torchrl-ocwm[{kind}]'", name=kind
            )
        if kind == "tensorboard":
            from torchrl.record.loggers.tensorboard import TensorboardLogger

            loggers.append(TensorboardLogger("tensorboard", log_dir=str(folder)))
        else:
            from torchrl.record.loggers.wandb import WandbLogger

            loggers.append(WandbLogger(name, save_dir=str(folder), project="torchrl_ocwm"))
    return Loggers(loggers)


def _show_in_tensorboard(logger: Logger, name: str, file: Path, step: int | None) -> None:
    """As an animated GIF. TensorBoard's own ``add_video`` makes one too, but needs moviepy for it."""
    import imageio.v3 as imageio
    from tensorboard.compat.proto.summary_pb2 import Summary

    frames = imageio.imread(file, plugin="FFMPEG")[:, 1::3, 1::3]  # films are enlarged three times
    gif = imageio.imwrite("<bytes>", frames, extension=".gif", plugin="pillow", loop=0, duration=67)
    height, width = frames.shape[1:3]
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif)
    logger.experiment.file_writer.add_summary(Summary(value=[Summary.Value(tag=name, image=image)]), step)
    logger.experiment.flush()


def _cut(file: Path, step: int) -> None:
    rows = file.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [row for row in rows if row.endswith("\n") and _step(row) <= step]
    if kept != rows:
        with replacing(file) as new:
            new.write_text("".join(kept), encoding="utf-8")


def _step(row: str) -> float:
    first = row.partition(",")[0]
    return int(first) if first.isdecimal() else float("inf")


def _drop_files(logger: Logger) -> None:
    """Close a CSV logger's files, whose last rows cannot be written."""
    files = getattr(logger.experiment, "files", {})
    while files:
        with suppress(OSError):
            files.popitem()[1].close()
