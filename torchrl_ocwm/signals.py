"""What Ctrl-C and SIGTERM do to a program that has something to clear away."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Ctrl-C and SIGTERM leave the block as errors do, so that its processes are ended, and then end the program.

    Raises:
        SystemExit: with the exit code that shells know: 130 for Ctrl-C, 143 for SIGTERM.

    Examples:
        >>> with ended_by_signals():
        ...     result = 1 + 1
    """
    try:
        before = signal.signal(signal.SIGTERM, _raise)
    except ValueError:  # not in the main thread: signals are not ours to take
        yield
        return
    try:
        yield
    except KeyboardInterrupt as stop:
        number = stop.args[0] if stop.args else signal.SIGINT
        sys.stderr.write(f"\nstopped by {signal.Signals(number).name}; what has been written is whole\n")
        raise SystemExit(128 + number) from None
    finally:
        signal.signal(signal.SIGTERM, before)


def _raise(number: int, frame: Any) -> None:  # noqa: ARG001
    raise KeyboardInterrupt(number)
