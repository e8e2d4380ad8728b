"""Train an agent on a dataset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.data import EpisodeDataset
from torchrl_ocwm.devices import usable_device
from torchrl_ocwm.training.evaluations import Evaluate, EvaluationError
from torchrl_ocwm.training.hooks import ProgressBar
from torchrl_ocwm.training.run import CHECKPOINT, SHOWN, Film, Run, check_task, own
from torchrl_ocwm.training.settings import Training

__all__ = ["CHECKPOINT", "EvaluationError", "train_offline"]


def train_offline(
    agent: Agent,
    dataset: EpisodeDataset,
    folder: str | Path,
    training: Training,
    *,
    evaluate: Evaluate | None = None,
    film: Film | None = None,
    on_start: Callable[[], object] | None = None,
    progress: bool = True,
) -> Path:
    """Train an agent on a dataset; continue from the folder's checkpoint if it has one.

    A run that was stopped and continued ends with the same parameters as one that never stopped, on a CPU bit for bit.
    SIGTERM and Ctrl-C leave a checkpoint. A run that is continued is held to the dataset and the settings that decide
    what is learnt (:class:`~torchrl_ocwm.training.settings.Training`).

    Args:
        agent: The agent, with fresh weights.
        dataset: What to train on.
        folder: Where checkpoint and logs go. One run at a time writes to it.
        training: The settings.
        evaluate: Called every ``eval_interval`` updates with their number, after the checkpoint that is due; returns
            scores to log, or an object whose ``done()`` says whether ``answer()`` has them: they are logged when they
            are there, at the updates that they belong to, and the next evaluation and the end of the run wait for
            them. SIGTERM and Ctrl-C do not.
        film: Called every ``video_interval`` updates with their number; returns the file of a video that it wrote. If
            it fails, training goes on with a warning.
        on_start: Called once, when nothing stands against the run and before its first update.
        progress: Show a progress bar.

    Returns:
        The checkpoint.

    Raises:
        DatasetError: if the dataset is of another task than the agent, or its episodes are too short.
        CheckpointError: if the folder's checkpoint is damaged, of another agent, or was trained with something else, or
            a checkpoint cannot be written.
        FolderInUseError: if another process trains in the folder.
        DivergedError: if a loss is not finite.
        EvaluationError: if ``evaluate`` fails for a reason that the user can mend. The checkpoint of that update is
            written, whatever it fails for.
        LogError: if the log cannot be written.
        DeviceError: if there is no such device.
        MissingPackageError: if the package of a logger or of the progress bar is missing.
    """
    folder = Path(folder)
    training = replace(training, device=str(usable_device(training.device)))
    bar = ProgressBar(SHOWN, disable=not progress)
    check_task(agent, dataset)
    with own(folder):
        return Run(agent, dataset, folder / CHECKPOINT, training, bar).go(evaluate, film, on_start)
