"""Objects that live in processes of their own, which end with the process that started them, however it ends."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import socket
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import wait
from typing import Any, Protocol

import cloudpickle
import torch

from torchrl_ocwm.errors import UserError

#: Makes the object, given a function to call now and then while it works: a sign of life.
Make = Callable[[Callable[[], None]], Any]
_START = 120.0  # seconds: a process has to import PyTorch and to load a simulator
_END = 30.0  # seconds from the end of its socket to that of a process, on a busy machine
_SIGN = None


class WorkerError(UserError, RuntimeError):
    """A process has ended, or gives no sign of life any more."""


class Worker(Protocol):
    """An object whose methods are called in two steps, so that several can work at the same time."""

    def ready(self) -> None:
        """Wait until the object is made."""

    def request(self, method: str, *arguments: Any) -> None:
        """Begin a call."""

    def done(self) -> bool:
        """Whether the call has ended; :meth:`answer` then does not wait."""

    def answer(self) -> Any:
        """Wait for the result of the call, or raise what it raised."""

    def close(self) -> None:
        """End it at once."""


def make_worker(make: Make, *, process: bool, timeout: float) -> Worker:
    """An object with the method calls of :class:`Worker`.

    Args:
        make: Makes the object; see :data:`Make`.
        process: Whether it gets a process of its own.
        timeout: Seconds without a sign of life after which a process counts as hanging.

    Examples:
        >>> worker = make_worker(lambda alive: [3, 1, 2], process=False, timeout=10)
        >>> worker.request("index", 2)
        >>> worker.answer()
        2
    """
    return ProcessWorker(make, timeout) if process else LocalWorker(make)


class LocalWorker:
    """An object in this process; takes the first argument of :func:`make_worker`."""

    def __init__(self, make: Make) -> None:
        self._object = make(lambda: None)
        self._call: tuple[str, tuple[Any, ...]] = ("", ())

    def ready(self) -> None:
        """Nothing to wait for."""

    def request(self, method: str, *arguments: Any) -> None:
        """Note the call; the answer does it."""
        self._call = method, arguments

    def done(self) -> bool:
        """The answer does the call."""
        return True

    def answer(self) -> Any:
        """Call the method."""
        method, arguments = self._call
        return getattr(self._object, method)(*arguments)

    def close(self) -> None:
        """Close the object, if it can be closed."""
        getattr(self._object, "close", lambda: None)()


class ProcessWorker:
    """An object in a process of its own.

    The process leaves Ctrl-C to the one that started it. It ends when that one closes it, or has ended itself. What
    the object raises is raised here, with the traceback of there, and ends the process.

    Args:
        make: Makes the object, in the process.
        timeout: Seconds without a sign of life after which it counts as hanging.
    """

    def __init__(self, make: Make, timeout: float) -> None:
        ours, theirs = socket.socketpair()
        self._timeout, self._socket, self._answers = timeout, ours, ours.makefile("rb")
        self._arrived: Any = _SIGN
        with theirs, interrupts_ignored():
            self._process = multiprocessing.get_context("spawn").Process(target=_serve, args=(theirs,), daemon=True)
            self._process.start()
        self._socket.settimeout(max(timeout, _START))
        self._send(cloudpickle.dumps(make))

    def ready(self) -> None:
        """Wait until the object is made.

        Raises:
            WorkerError: if the process ends before, or hangs.
        """
        self.answer()
        self._socket.settimeout(self._timeout)

    def request(self, method: str, *arguments: Any) -> None:
        """Begin a call. That of a process which has ended is noticed by :meth:`answer`."""
        with suppress(OSError):
            self._send((method, arguments))

    def answer(self) -> Any:
        """Wait for the result of the call, or raise what it raised.

        Raises:
            WorkerError: if the process has ended, or hangs.
        """
        while self._arrived is _SIGN:
            self._arrived = self._receive()
        (result, error, there), self._arrived = self._arrived, _SIGN
        if error is not None:
            raise error from _ThereError(there)
        return result

    def done(self) -> bool:
        """Whether :meth:`answer` would return or raise at once. A process that hangs is noticed by that only."""
        try:
            while self._arrived is _SIGN and self._is_arriving():
                self._arrived = self._receive()
        except WorkerError:
            return True
        return self._arrived is not _SIGN

    def _is_arriving(self) -> bool:
        if self._socket.fileno() < 0 or wait([self._socket], 0):
            return True
        timeout = self._socket.gettimeout()
        self._socket.settimeout(0)
        try:
            return bool(self._answers.peek(1))  # it has come together with the message before
        except OSError:  # the process has just ended
            return True
        finally:
            self._socket.settimeout(timeout)

    def _receive(self) -> Any:
        if self._socket.fileno() < 0:
            raise WorkerError("the process was closed")
        try:
            return pickle.load(self._answers)
        except TimeoutError:
            raise WorkerError(
                f"process {self._process.pid} has given no sign of life for {self._socket.gettimeout():g} seconds"
            ) from None
        except (EOFError, OSError, pickle.UnpicklingError):
            self._process.join(_END)
            raise WorkerError(f"process {self._process.pid} has ended ({_how(self._process.exitcode)})") from None

    def close(self) -> None:
        """Kill the process. It keeps nothing that would have to be written, and may hang."""
        if self._socket.fileno() < 0:
            return
        self._process.kill()
        self._process.join()
        self._process.close()
        self._answers.close()
        self._socket.close()

    def _send(self, message: Any) -> None:
        self._socket.sendall(pickle.dumps(message))


class _ThereError(Exception):
    """Shows the traceback of a process beside the one of this."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def _how(code: int | None) -> str:
    if code is None:
        return "its exit code is not known"
    return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


@contextmanager
def interrupts_ignored() -> Iterator[None]:
    """What is started here is born deaf to Ctrl-C: it would show a traceback while it starts."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _serve(channel: socket.socket) -> None:
    """The process: make the object, then answer calls until the other end is closed."""
    end_with_parent()
    torch.set_num_threads(1)
    calls = channel.makefile("rb")
    last = time.monotonic()

    def send(message: Any) -> None:
        channel.sendall(pickle.dumps(message))

    def alive() -> None:
        nonlocal last
        if time.monotonic() - last > 1:
            last = time.monotonic()
            send(_SIGN)

    try:
        made = pickle.loads(pickle.load(calls))(alive)
        send((None, None, ""))
        while True:
            method, arguments = pickle.load(calls)
            send((getattr(made, method)(*arguments), None, ""))
    except (EOFError, ConnectionError):
        return
    except Exception as error:
        with suppress(ConnectionError):
            send((None, _picklable(error), traceback.format_exc()))


def end_with_parent() -> None:
    """Let this process end as soon as the one that started it has ended, however that was."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _picklable(error: Exception) -> Exception:
    """The error, or its name and message where it does not survive the journey."""
    try:
        return pickle.loads(pickle.dumps(error))
    except Exception:  # whatever an exception's own methods raise
        return RuntimeError(f"{type(error).__name__}: {error}")
