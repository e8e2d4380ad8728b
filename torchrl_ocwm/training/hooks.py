"""What happens beside the updates, on TorchRL's trainer."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.trainers import Trainer

from torchrl_ocwm.errors import MissingPackageError, UserError


class UpdateClock:
    """Takes the place of a collector when nothing is collected: each tick stands for one update.

    TorchRL's trainer counts collected frames; with this clock the frames that it counts, logs and saves by are updates.
    """

    init_random_frames = 0

    def __iter__(self) -> Iterator[TensorDictBase]:
        while True:
            yield TensorDict({}, [1])

    def shutdown(self) -> None:
        """Nothing to stop."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing to keep: the trainer counts."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Nothing to restore."""


class DivergedError(UserError, FloatingPointError):
    """A loss is not finite; the message names it."""


class LossLog:
    """Logs losses averaged over some updates, and ends a run whose losses are not finite.

    Args:
        trainer: The trainer to follow.
        interval: Updates between two lines of the log; the last update gets a line too.
        show: Called with the number of updates and the averages.
    """

    def __init__(self, trainer: Trainer, interval: int, show: Callable[[int, TensorDictBase], None]) -> None:
        self.trainer, self.interval, self.show = trainer, interval, show
        self._total: TensorDictBase | None = None
        self._count = 0
        trainer.register_op("post_optim_complete_log", self._add)

    def _add(self, updates: int, losses: TensorDictBase) -> dict[str, Any] | None:
        self._total = losses if self._total is None else self._total + losses
        self._count += 1
        if updates % self.interval and updates != self.trainer.total_frames:
            return None
        self.check(updates)
        mean = self._total / self._count
        self._total, self._count = None, 0
        self.show(updates, mean)
        return dict(mean.items())

    def check(self, updates: int) -> None:
        """Look at the losses since the last line of the log.

        Raises:
            DivergedError: with the losses that are not finite.
        """
        losses = {} if self._total is None else dict(self._total.items())
        bad = [name for name, value in losses.items() if name.startswith("loss_") and not value.isfinite().all()]
        if bad:
            raise DivergedError(
                f"after {updates} updates {', '.join(sorted(bad))} is not finite; check the data and the learning "
                "rates. The last checkpoint is still good."
            )


class RunTrainer(Trainer):
    """TorchRL's trainer, which saves an update once, and none whose losses are not finite.

    Attributes:
        losses: What it asks before it saves.
    """

    losses: LossLog
    _saved = -1

    def save_trainer(self, force_save: bool = False) -> None:
        """Save if told to; the trainer's own calls leave it to :class:`EveryUpdates`."""
        if force_save and self._saved != self.collected_frames:
            self.losses.check(self.collected_frames)
            super().save_trainer(force_save=True)
            self._saved = self.collected_frames


class EveryUpdates:
    """Call a function every so many updates, and log what it returns.

    Args:
        trainer: The trainer to follow.
        interval: Updates between two calls, 0 for none.
        function: Called with the number of updates; returns scalars to log, or nothing.
        at_end: Also call it at the last update.
    """

    def __init__(
        self,
        trainer: Trainer,
        interval: int,
        function: Callable[[int], dict[str, float] | None],
        *,
        at_end: bool = False,
    ) -> None:
        self.trainer, self.interval, self.function, self.at_end = trainer, interval, function, at_end
        if interval:
            trainer.register_op("post_steps_log", self._call)

    def _call(self, batch: TensorDictBase) -> dict[str, float] | None:  # noqa: ARG002
        done = self.trainer.collected_frames
        ends = self.at_end and done >= self.trainer.total_frames
        return None if done % self.interval and not ends else self.function(done)


class _Stopped(BaseException):
    """Leave what is only looked at."""


class StopOnSignals:
    """SIGTERM and the first Ctrl-C end training after the current update, with a checkpoint; the second works as usual.

    Args:
        trainer: The trainer to stop.

    Attributes:
        stopped: Whether a signal has come.

    Use it in a ``with`` block.
    """

    def __init__(self, trainer: Trainer) -> None:
        self.trainer = trainer
        self.stopped = self._looking = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopOnSignals:
        try:
            for number in (signal.SIGTERM, signal.SIGINT):
                self._before[number] = signal.signal(number, self._stop)
        except ValueError:  # not in the main thread: signals are not ours to take
            pass
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _stop(self, number: int, frame: Any) -> None:  # noqa: ARG002
        signal.signal(number, self._before[number])
        self.stopped = True
        self.trainer.request_stop(signal.Signals(number).name)
        if self._looking:
            raise _Stopped

    def look(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call what only looks at the agent: it changes no random number, and a signal breaks it off."""
        try:
            self._looking = True
            result = None
            if not self.stopped:
                with torch.random.fork_rng():
                    result = function(*arguments)
            self._looking = False
            return result
        except _Stopped:
            return None
        except Exception:  # ctypes and others make an error of their own of what interrupts them
            if self.stopped:
                return None
            raise
        finally:
            self._looking = False


class ProgressBar:
    """Updates done, updates per second and some losses.

    Args:
        shown: Names of the losses to show.
        disable: Show nothing.

    Raises:
        MissingPackageError: if tqdm is missing, with the extra to install.
    """

    def __init__(self, shown: tuple[str, ...], *, disable: bool = False) -> None:
        self.shown, self.disable = shown, disable
        self.bar: Any = None
        if not disable and find_spec("tqdm") is None:
            raise MissingPackageError(
                "a progress bar needs tqdm: pip install 'torchrl-ocwm[recipes]', or train with progress=False",
                name="tqdm",
            )

    @contextmanager
    def running(self, done: int, updates: int) -> Iterator[None]:
        """Show it, from an update to the last."""
        if self.disable:
            yield
            return
        from tqdm import tqdm

        with tqdm(total=updates, initial=done, unit="update", desc="train") as self.bar:
            yield

    def show(self, updates: int, losses: TensorDictBase) -> None:
        """Show how far it is."""
        if self.bar is not None:
            values = {name.removeprefix("loss_"): f"{float(losses[name]):.3g}" for name in self.shown if name in losses}
            self.bar.set_postfix(values, refresh=False)
            self.bar.update(updates - self.bar.n)
