"""The evaluations of a run, each logged at the update that it belongs to."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

from tensordict import TensorDictBase

from torchrl_ocwm.errors import UserError
from torchrl_ocwm.training.loggers import Loggers


class EvaluationError(UserError, RuntimeError):
    """An evaluation during training failed, for a reason that the user can mend; nothing is lost."""


class Later(Protocol):
    """Scores of an evaluation that goes on beside the updates."""

    def done(self) -> bool:
        """Whether they are there."""

    def answer(self) -> dict[str, float]:
        """Wait for them."""


#: Called with a number of updates; returns scores to log, now or later.
Evaluate = Callable[[int], "dict[str, float] | Later"]


class Evaluations:
    """Makes evaluations, at most one at a time beside the updates: the next that is due waits for it.

    Args:
        evaluate: Makes one.
        look: Calls a function that a signal may break off; it then returns ``None``.
        save: Saves the update at hand, and returns its number.
        loggers: Where late scores go.
    """

    def __init__(
        self, evaluate: Evaluate, *, look: Callable[..., Any], save: Callable[[], int], loggers: Loggers
    ) -> None:
        self.evaluate, self.look, self.save, self.loggers = evaluate, look, save, loggers
        self._under_way: tuple[int, Later] | None = None

    def begin(self, updates: int) -> dict[str, float] | None:
        """Evaluate; the scores, unless they come later."""
        self.wait()
        scores = self._try(updates, partial(self.evaluate, updates))
        if scores is None or isinstance(scores, dict):
            return scores
        self._under_way = updates, scores
        return None

    def check(self, batch: TensorDictBase) -> None:  # noqa: ARG002
        """Log scores that have come since."""
        if self._under_way is not None and self._under_way[1].done():
            self.wait()

    def wait(self) -> None:
        """Wait for the evaluation that is under way, and log its scores."""
        if self._under_way is None:
            return
        (updates, later), self._under_way = self._under_way, None
        for name, value in (self._try(updates, later.answer) or {}).items():
            self.loggers.log_scalar(name, value, step=updates)

    def _try(self, updates: int, function: Callable[[], Any]) -> Any:
        try:
            return self.look(function)
        except Exception as error:
            kept = self.save()
            message = (
                f"the evaluation after {updates} updates failed ({type(error).__name__}: {error}); the checkpoint of "
                f"{'this update' if kept == updates else f'update {kept}'} is kept: run the same command again to go "
                "on, with training.eval_interval=0 if need be"
            )
            if isinstance(error, (UserError, OSError)):  # what the machine or the settings lack
                raise EvaluationError(message) from error
            raise RuntimeError(message) from error
