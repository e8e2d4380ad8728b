"""A training run: an agent, the dataset that it learns from, and the folder that keeps it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDictBase, unravel_key
from torchrl.checkpoint import CheckpointError
from torchrl.trainers import LRSchedulerHook
from torchrl.trainers.algorithms import DreamerV3OptimizationStepper

from torchrl_ocwm.agents.agent import Agent
from torchrl_ocwm.agents.archive import Archive, recover
from torchrl_ocwm.agents.checkpoint import check_same_agent, describe
from torchrl_ocwm.agents.requirements import lacking, remedies
from torchrl_ocwm.data import DatasetError, EpisodeDataset, RelabelGoals, make_replay_buffer
from torchrl_ocwm.files import only_writer
from torchrl_ocwm.settings import differences
from torchrl_ocwm.training.cores import update_threads
from torchrl_ocwm.training.evaluations import Evaluate, Evaluations
from torchrl_ocwm.training.hooks import EveryUpdates, LossLog, ProgressBar, RunTrainer, StopOnSignals, UpdateClock
from torchrl_ocwm.training.loggers import make_loggers
from torchrl_ocwm.training.provenance import check_may_go_on, trained_with
from torchrl_ocwm.training.random_state import RandomState
from torchrl_ocwm.training.settings import Training
from torchrl_ocwm.training.stepper import make_schedule, make_stepper

CHECKPOINT = "checkpoint.zip"
SHOWN = ("loss_model_pixels", "loss_model_object_position", "loss_actor", "loss_value")

Film = Callable[[int], Path]


class Run:
    """A run up to its first update, or to the one at which it goes on.

    Args:
        agent: The agent, with fresh weights.
        dataset: What it learns from. It may grow.
        file: The checkpoint.
        training: The settings, with a device that there is.
        bar: Shows how far it is.
        clock: Each tick is an update.
        grows: The dataset may have grown since the checkpoint.
    """

    def __init__(
        self,
        agent: Agent,
        dataset: EpisodeDataset,
        file: Path,
        training: Training,
        bar: ProgressBar,
        *,
        clock: UpdateClock | None = None,
        grows: bool = False,
    ) -> None:
        self.agent, self.file, self.training, self.bar = agent, file, training, bar
        recover(file)
        if file.exists():
            check_same_agent(agent, file)
            check_may_go_on(file, training, dataset, grows=grows)
        if threads := update_threads(training, agent.size):
            torch.set_num_threads(threads)
        torch.manual_seed(training.seed)
        agent.to(training.device).train()
        sample = TrainingBatches(agent, dataset, training)
        stepper = make_stepper(agent, training)
        checkpoint = Archive(
            agent=describe(agent), rng=RandomState(), metadata={"trained_with": trained_with(training, dataset)}
        )
        self.trainer = _make_trainer(agent, training, stepper, checkpoint, file, clock or UpdateClock())
        self.stop = StopOnSignals(self.trainer)
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

    def go(self, evaluate: Evaluate | None, film: Film | None, on_start: Callable[[], object] | None) -> Path:
        """Make the updates that are left, if there are any; returns the checkpoint."""
        if self.updates < self.training.updates:
            if on_start is not None:
                on_start()
            self._train(evaluate, film)
        elif self.updates > self.training.updates:
            warnings.warn(
                f"{self.file}: has {self.updates} updates, more than {self.training.updates}; nothing was trained",
                RuntimeWarning,
                stacklevel=3,
            )
        return self.file

    def _train(self, evaluate: Evaluate | None, film: Film | None) -> None:
        trainer, training, folder = self.trainer, self.training, self.file.parent
        trainer.logger = self.loggers = make_loggers(folder, training.loggers, name=folder.name)
        self.loggers.cut_back(self.updates)
        with self.stop as stop, self.bar.running(self.updates, training.updates):
            EveryUpdates(trainer, training.checkpoint_interval, self._save, at_end=True)
            evaluations = None
            if evaluate is not None:
                evaluations = Evaluations(evaluate, look=stop.look, save=self._save_now, loggers=self.loggers)
                trainer.register_op("post_steps_log", evaluations.check)
                EveryUpdates(trainer, training.eval_interval, evaluations.begin)
            if film is not None:
                EveryUpdates(trainer, training.video_interval, partial(self._film, partial(stop.look, film)))
            trainer.train()
            if evaluations is not None:
                evaluations.wait()
        self._save(self.updates)  # of a clock that was stopped between two updates

    def _save(self, updates: int) -> None:  # noqa: ARG002
        self.trainer.save_trainer(force_save=True)

    def _save_now(self) -> int:
        self._save(self.updates)
        return self.updates

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


class TrainingBatches:
    """Batches ``[B, T]`` for an agent, from a dataset that may grow: the next batch can have what was appended.

    Args:
        agent: The agent.
        dataset: Where they are from.
        training: The goals that they get, and the device that they are put on.
    """

    def __init__(self, agent: Agent, dataset: EpisodeDataset, training: Training) -> None:
        self.agent, self.dataset, self.training = agent, dataset, training
        self._fill()

    def _fill(self) -> None:
        learning = self.agent.size.learning
        self._episodes = len(self.dataset)
        self._replay = make_replay_buffer(
            self.dataset,
            batch_size=learning.batch_size,
            slice_len=learning.slice_len,
            transform=RelabelGoals(
                self.agent.task.workspace, goals=self.training.goals, object_index=self.agent.recorded_object
            ),
        )

    def __call__(self, batch: TensorDictBase | None = None) -> TensorDictBase:  # noqa: ARG002
        """The next batch."""
        if len(self.dataset) != self._episodes:
            self._fill()  # the buffer keeps where episodes begin
        return self._replay.sample().select(*self.agent.loss.in_keys, strict=False).to(self.training.device)


def _make_trainer(
    agent: Agent,
    training: Training,
    stepper: DreamerV3OptimizationStepper,
    checkpoint: Archive,
    file: Path,
    clock: UpdateClock,
) -> RunTrainer:
    return RunTrainer(
        collector=clock,
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


def check_task(agent: Agent, dataset: EpisodeDataset) -> None:
    """Refuse a dataset that an agent cannot learn from.

    Raises:
        DatasetError: if it is of another task, lacks keys, or shows goals that imagination would contradict.
    """
    if dataset.task != agent.task:
        different = differences(dataset.task, agent.task, "in the dataset", "in that of the agent")
        raise DatasetError(f"{dataset.path}: is of another task than the agent ({different})")
    if missing := lacking(agent, dataset):
        names = ", ".join(key if isinstance(key, str) else "/".join(key) for key in map(unravel_key, missing))
        raise DatasetError(f"{dataset.path}: holds no {names}, which this agent learns from. {remedies(missing)}")
    imagined = [name for name, one in agent.config.behaviours.items() if one.goals.gives]
    if dataset.images_show_goal and imagined:
        raise DatasetError(
            f"{dataset.path}: the images show the goal (virtual_target), and the behaviour {imagined[0]!r} is given "
            "others in imagination; train an agent whose goals are in the observations, such as dreamer or focus"
        )


@contextmanager
def own(folder: Path) -> Iterator[None]:
    """Be the only run that writes to a folder."""
    with ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(only_writer(folder))
        except OSError as error:
            reason = error.strerror or error
            raise CheckpointError(f"{folder}: cannot write here ({reason}); choose another output folder") from error
        yield
