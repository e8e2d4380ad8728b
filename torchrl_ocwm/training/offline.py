"""Train an agent on a dataset."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torchrl.checkpoint import CheckpointError, GlobalRNGState
from torchrl.trainers import LRSchedulerHook
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.agents.archive import Archive, recover
from torchrl_ocwm.agents.checkpoint import check_same_agent, describe
from torchrl_ocwm.data import DatasetError, EpisodeDataset, RelabelGoals, make_replay_buffer
from torchrl_ocwm.devices import usable_device
from torchrl_ocwm.errors import UserError
from torchrl_ocwm.files import only_writer
from torchrl_ocwm.training.hooks import Every, LossLog, ProgressBar, RunTrainer, StopOnSignals, UpdateClock
from torchrl_ocwm.training.loggers import make_loggers
from torchrl_ocwm.training.provenance import check_may_go_on, trained_with
from torchrl_ocwm.training.settings import Training
from torchrl_ocwm.training.stepper import make_schedule, make_stepper

CHECKPOINT = "checkpoint.zip"
_SHOWN = ("loss_model_pixels", "loss_model_object_position", "loss_actor", "loss_value")

Evaluate = Callable[[int], dict[str, float]]
Film = Callable[[int], Path]


class EvaluationError(UserError, RuntimeError):
    """An evaluation during training failed, for a reason that the user can mend; nothing is lost."""


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
            scores to log.
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
    bar = ProgressBar(_SHOWN, disable=not progress)
    _check_task(agent, dataset)
    with _own(folder):
        run = _Run(agent, dataset, folder / CHECKPOINT, training, bar)
        if run.updates < training.updates:
            if on_start is not None:
                on_start()
            run.train(evaluate, film)
        elif run.updates > training.updates:
            warnings.warn(
                f"{run.file}: has {run.updates} updates, more than {training.updates}; nothing was trained",
                RuntimeWarning,
                stacklevel=2,
            )
    return run.file


class _Run:
    """A run up to its first update, or to the one at which it goes on."""

    def __init__(self, agent: Agent, dataset: EpisodeDataset, file: Path, training: Training, bar: ProgressBar) -> None:
        self.agent, self.file, self.training, self.bar = agent, file, training, bar
        recover(file)
        if file.exists():
            check_same_agent(agent, file)
            check_may_go_on(file, training, dataset)
        if training.threads:
            torch.set_num_threads(training.threads)
        torch.manual_seed(training.seed)
        agent.to(training.device).train()
        sample = _make_sampler(agent, dataset, training)
        stepper = make_stepper(agent, training)
        checkpoint = Archive(
            agent=describe(agent), rng=GlobalRNGState(), metadata={"trained_with": trained_with(training, dataset)}
        )
        self.trainer = _make_trainer(agent, training, stepper, checkpoint, file)
        self.trainer.register_op("process_optim_batch", sample)
        LRSchedulerHook(make_schedule(stepper.optimizer, training), interval="optim").register(self.trainer)
        self.trainer.losses = LossLog(self.trainer, training.log_interval, bar.show)
        if any(stepper.resolve(torch.device(training.device))):
            stepper.warmup(sample())
        if file.exists():
            _load(self.trainer, file)

    @property
    def updates(self) -> int:
        """Updates done."""
        return self.trainer.collected_frames

    def train(self, evaluate: Evaluate | None, film: Film | None) -> None:
        """Make the updates that are left."""
        trainer, training, folder = self.trainer, self.training, self.file.parent
        trainer.logger = self.loggers = make_loggers(folder, training.loggers, name=folder.name)
        self.loggers.cut_back(self.updates)
        with StopOnSignals(trainer) as stop, self.bar.running(self.updates, training.updates):
            Every(trainer, training.checkpoint_interval, self._save, at_end=True)
            if evaluate is not None:
                Every(trainer, training.eval_interval, partial(self._evaluate, partial(stop.look, evaluate)))
            if film is not None:
                Every(trainer, training.video_interval, partial(self._film, partial(stop.look, film)))
            trainer.train()

    def _save(self, updates: int) -> None:  # noqa: ARG002
        self.trainer.save_trainer(force_save=True)

    def _evaluate(self, evaluate: Evaluate, updates: int) -> dict[str, float]:
        try:
            return evaluate(updates)
        except Exception as error:
            self._save(updates)
            message = (
                f"the evaluation after {updates} updates failed ({type(error).__name__}: {error}); the checkpoint of "
                "this update is kept: run the same command again to go on, with training.eval_interval=0 if need be"
            )
            if isinstance(error, (UserError, OSError)):  # what the machine or the settings lack
                raise EvaluationError(message) from error
            raise RuntimeError(message) from error

    def _film(self, film: Film, updates: int) -> None:
        try:
            file = film(updates)
            if file is not None:  # a signal broke it off
                self.loggers.log_video("open_loop", file, updates)
        except Exception as error:
            warnings.warn(
                f"no video after {updates} updates ({type(error).__name__}: {error}); training goes on",
                RuntimeWarning,
                stacklevel=2,
            )


def _make_sampler(agent: Agent, dataset: EpisodeDataset, training: Training) -> Callable[..., TensorDictBase]:
    replay = make_replay_buffer(
        dataset,
        batch_size=agent.size.learning.batch_size,
        slice_len=agent.size.learning.slice_len,
        transform=RelabelGoals(agent.task.workspace, goals=training.goals),
    )

    def sample(batch: TensorDictBase | None = None) -> TensorDictBase:  # noqa: ARG001
        return replay.sample().select(*agent.loss.in_keys, strict=False).to(training.device)

    return sample


def _make_trainer(
    agent: Agent, training: Training, stepper: DreamerV3OptimizationStepper, checkpoint: Archive, file: Path
) -> RunTrainer:
    return RunTrainer(
        collector=UpdateClock(),
        total_frames=training.updates,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=agent.loss,
        optimization_stepper=stepper,
        log_interval=0,
        auto_log_optim_steps=False,
        progress_bar=False,
        save_trainer_file=file,
        checkpoint=checkpoint,
    )


def _load(trainer: RunTrainer, file: Path) -> None:
    trainer.load_from_file(file)
    counts = (trainer.collected_frames, trainer._optim_count)
    if not all(type(count) is int and count >= 0 for count in counts) or counts[0] != counts[1]:
        raise CheckpointError(f"{file}: damaged (it counts {counts[0]!r} updates and {counts[1]!r} steps)")


def _check_task(agent: Agent, dataset: EpisodeDataset) -> None:
    if dataset.task != agent.task:
        raise DatasetError(f"{dataset.path}: holds {dataset.task}, but the agent was built for {agent.task}")
    there = {*dataset.records.keys(True, True), *RelabelGoals.written}
    missing = [key for key in agent.loss.in_keys if key not in there]
    if missing:
        raise DatasetError(f"{dataset.path}: holds no {missing}, which this agent learns from")


@contextmanager
def _own(folder: Path) -> Iterator[None]:
    """Be the only run that writes to a folder."""
    with ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(only_writer(folder))
        except OSError as error:
            reason = error.strerror or error
            raise CheckpointError(f"{folder}: cannot write here ({reason}); choose another output folder") from error
        yield
