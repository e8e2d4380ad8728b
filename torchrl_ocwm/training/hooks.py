"""What happens beside the updates, on TorchRL's trainer."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.trainers import Trainer
from tqdm import tqdm


class UpdateClock:
    """Takes the place of a collector when nothing is collected: each tick stands for some updates.

    TorchRL's trainer counts collected frames; with this clock the frames that it counts, logs and saves by are updates.

    Args:
        updates_per_tick: Updates between two ticks.
    """

    init_random_frames = 0

    def __init__(self, updates_per_tick: int) -> None:
        self.updates_per_tick = updates_per_tick

    def __iter__(self) -> Iterator[TensorDictBase]:
        while True:
            yield TensorDict({}, [self.updates_per_tick])

    def shutdown(self) -> None:
        """Nothing to stop."""

    def state_dict(self) -> dict[str, Any]:
        """Nothing to keep: the trainer counts."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Nothing to restore."""


class ProgressBar:
    """Updates done, updates per second and the main losses.

    Args:
        trainer: The trainer to follow.
        shown: Names of the losses to show.
        disable: Show nothing.
    """

    def __init__(self, trainer: Trainer, shown: tuple[str, ...], *, disable: bool = False) -> None:
        self.trainer, self.shown, self.disable = trainer, shown, disable
        self.bar: tqdm | None = None
        trainer.register_op("post_optim_complete_log", self._show)

    def _show(self, updates: int, losses: TensorDictBase) -> None:
        if self.bar is None:
            first = updates - self.trainer.optim_steps_per_batch
            total = self.trainer.total_frames
            self.bar = tqdm(total=total, initial=first, unit="update", desc="train", disable=self.disable)
        values = {name.removeprefix("loss_"): f"{float(losses[name]):.3g}" for name in self.shown if name in losses}
        self.bar.set_postfix(values, refresh=False)
        self.bar.update(updates - self.bar.n)


class Every:
    """Call a function every so many updates, and log what it returns.

    Args:
        trainer: The trainer to follow.
        interval: Updates between two calls, 0 for none.
        function: Called with the number of updates; returns scalars to log, or nothing.
    """

    def __init__(self, trainer: Trainer, interval: int, function: Callable[[int], dict[str, float] | None]) -> None:
        self.trainer, self.interval, self.function = trainer, interval, function
        if interval:
            trainer.register_op("post_steps_log", self._call)

    def _call(self, batch: TensorDictBase) -> dict[str, float] | None:
        done, tick = self.trainer.collected_frames, batch.numel()
        due = done // self.interval > (done - tick) // self.interval
        if not due:
            return None
        with torch.random.fork_rng():  # what is looked at does not change what is learnt
            return self.function(done)


def stop_when_not_finite(updates: int, losses: TensorDictBase) -> None:
    """Hook that ends a run whose losses are not finite.

    Raises:
        FloatingPointError: with the losses that are not.
    """
    bad = [name for name, value in losses.items() if name.startswith("loss_") and not value.isfinite().all()]
    if bad:
        raise FloatingPointError(
            f"after {updates} updates {', '.join(sorted(bad))} is not finite; check the data and the learning rates. "
            "The last checkpoint is still good."
        )


@contextmanager
def stop_on_signals(trainer: Trainer) -> Iterator[None]:
    """SIGTERM and the first Ctrl-C end training after the current tick, with a checkpoint."""
    handlers: dict[int, Any] = {}

    def stop(number: int, frame: Any) -> None:  # noqa: ARG001
        trainer.request_stop(signal.Signals(number).name)
        signal.signal(number, handlers[number])  # the second time as usual

    try:
        for number in (signal.SIGTERM, signal.SIGINT):
            handlers[number] = signal.signal(number, stop)
    except ValueError:  # not in the main thread: signals are not ours to take
        pass
    try:
        yield
    finally:
        for taken, handler in handlers.items():
            signal.signal(taken, handler)
