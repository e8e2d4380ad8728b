"""Train an agent on a dataset."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torchrl.checkpoint import Checkpoint, CheckpointError, GlobalRNGState
from torchrl.trainers import LRSchedulerHook, Trainer
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.agents.checkpoint import check_same_agent, describe
from torchrl_ocwm.data import DatasetError, EpisodeDataset, RelabelGoals, make_replay_buffer
from torchrl_ocwm.training.hooks import Every, ProgressBar, UpdateClock, stop_on_signals, stop_when_not_finite
from torchrl_ocwm.training.loggers import Loggers, make_loggers
from torchrl_ocwm.training.settings import Training
from torchrl_ocwm.training.stepper import make_schedule, make_stepper

CHECKPOINT = "checkpoint.zip"
_SHOWN = ("loss_model_pixels", "loss_model_object_position", "loss_actor", "loss_value")


def train_offline(
    agent: Agent,
    dataset: EpisodeDataset,
    folder: str | Path,
    training: Training,
    *,
    evaluate: Callable[[int], dict[str, float]] | None = None,
    film: Callable[[int], Path] | None = None,
    progress: bool = True,
) -> Path:
    """Train an agent on a dataset; continue from the folder's checkpoint if it has one.

    A run that was stopped and continued ends with the same parameters as one that never stopped, on a CPU bit for bit.
    SIGTERM and Ctrl-C leave a checkpoint.

    Args:
        agent: The agent, with fresh weights.
        dataset: What to train on.
        folder: Where checkpoint and logs go.
        training: The settings.
        evaluate: Called every ``eval_interval`` updates with their number; returns scores to log.
        film: Called every ``video_interval`` updates with their number; returns the file of a video that it wrote.
        progress: Show a progress bar.

    Returns:
        The checkpoint.

    Raises:
        DatasetError: if the dataset is of another task than the agent, or its episodes are too short.
        CheckpointError: if the folder's checkpoint is of another agent, or a checkpoint cannot be written.
        FloatingPointError: if a loss is not finite.
    """
    folder = Path(folder)
    file = folder / CHECKPOINT
    _check_task(agent, dataset)
    if file.exists():
        check_same_agent(agent, file)
    if training.threads:
        torch.set_num_threads(training.threads)
    torch.manual_seed(training.seed)
    agent.to(training.device).train()
    loggers = _make_folder(folder, training)
    sample = _make_sampler(agent, dataset, training)
    stepper = make_stepper(agent, training)
    trainer = _make_trainer(agent, training, stepper, loggers, file)
    trainer.register_op("process_optim_batch", sample)
    LRSchedulerHook(make_schedule(stepper.optimizer, training), interval="optim").register(trainer)
    trainer.register_op("post_optim_complete_log", stop_when_not_finite)
    ProgressBar(trainer, _SHOWN, disable=not progress)
    if evaluate is not None:
        Every(trainer, training.eval_interval, evaluate)
    if film is not None:
        Every(trainer, training.video_interval, lambda updates: loggers.log_video("open_loop", film(updates), updates))
    if any(stepper.resolve(torch.device(training.device))):
        stepper.warmup(sample())
    if file.exists():
        trainer.load_from_file(file)
    if trainer.collected_frames < training.updates:
        with stop_on_signals(trainer):
            trainer.train()
    return file


def _make_sampler(agent: Agent, dataset: EpisodeDataset, training: Training) -> Callable[..., TensorDictBase]:
    replay = make_replay_buffer(
        dataset,
        batch_size=agent.size.batch_size,
        slice_len=agent.size.slice_len,
        transform=RelabelGoals(agent.task.workspace, goals=training.goals),
    )

    def sample(batch: TensorDictBase | None = None) -> TensorDictBase:  # noqa: ARG001
        return replay.sample().select(*agent.loss.in_keys, strict=False).to(training.device)

    return sample


def _make_trainer(
    agent: Agent, training: Training, stepper: DreamerV3OptimizationStepper, loggers: Loggers, file: Path
) -> Trainer:
    return Trainer(
        collector=UpdateClock(training.log_interval),
        total_frames=training.updates,
        frame_skip=1,
        optim_steps_per_batch=training.log_interval,
        loss_module=agent.loss,
        optimization_stepper=stepper,
        logger=loggers,
        log_interval=0,
        progress_bar=False,
        save_trainer_interval=training.checkpoint_interval - 1,
        save_trainer_file=file,
        checkpoint=RunCheckpoint(format="archive", agent=describe(agent), rng=GlobalRNGState()),
    )


class RunCheckpoint(Checkpoint):
    """TorchRL's checkpoint, whose failure to write says what is lost: nothing."""

    def save(self, path: str | Path, **options: object) -> Path:  # type: ignore[override]
        """Write the checkpoint; the one before stays until the new one is whole.

        Raises:
            CheckpointError: if it cannot be written.
        """
        try:
            return super().save(path, **options)
        except (OSError, RuntimeError) as error:
            kept = f"the checkpoint before it is kept at {path}" if Path(path).exists() else "there was none before it"
            reason = getattr(error, "strerror", None) or error
            raise CheckpointError(f"cannot write the checkpoint {path} ({reason}); {kept}") from error


def _check_task(agent: Agent, dataset: EpisodeDataset) -> None:
    if dataset.task != agent.task:
        raise DatasetError(f"{dataset.path}: holds {dataset.task}, but the agent was built for {agent.task}")
    there = {*dataset.records.keys(True, True), *RelabelGoals.written}
    missing = [key for key in agent.loss.in_keys if key not in there]
    if missing:
        raise DatasetError(f"{dataset.path}: holds no {missing}, which this agent learns from")


def _make_folder(folder: Path, training: Training) -> Loggers:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".writable").touch()
        (folder / ".writable").unlink()
    except OSError as error:
        raise CheckpointError(
            f"{folder}: cannot write here ({error.strerror}); choose another output folder"
        ) from error
    return make_loggers(folder, training.loggers, name=folder.name)
