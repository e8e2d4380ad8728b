"""Where runs go: to processes of this machine, or to a Ray cluster."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from importlib.util import find_spec
from itertools import count
from threading import Event
from types import ModuleType
from typing import Any, Protocol

import torch

from torchrl_ocwm.errors import MissingPackageError, UserError
from torchrl_ocwm.evidence.settings import Machine

#: Does a job until it is done or an event is set, with some variables of the environment.
Perform = Callable[[Any, Event, Mapping[str, str]], None]
_STARTS = 3  # of Ray, whose own processes have 30 seconds to begin; on a busy machine that is too few


class ClusterError(UserError, RuntimeError):
    """Ray does not start; the message says what it says."""


class Launcher(AbstractContextManager["Launcher"], Protocol):
    """Does jobs; leaving its block stops those that are at work, and waits until they have ended.

    Attributes:
        slots: Jobs at a time.
        failures: What a job that fails raises.
    """

    slots: int
    failures: tuple[type[Exception], ...]

    def submit(self, perform: Perform, job: Any) -> Future[None]:
        """Do a job."""


class Local(Launcher):
    """Threads of this process, each of which waits for a process.

    Args:
        how: How many at a time. On GPUs each thread has one of its own, as far as there are enough.
    """

    failures = (UserError,)

    def __init__(self, how: Machine) -> None:
        self._gpus = _gpus() if how.device == "cuda" else []
        self.slots = how.workers or len(self._gpus) or max(1, _cores() // how.threads)
        self._stop, self._numbers, self._thread = Event(), count(), threading.local()
        self._pool = ThreadPoolExecutor(self.slots, initializer=self._begin)

    def _begin(self) -> None:
        self._thread.number = next(self._numbers)

    def submit(self, perform: Perform, job: Any) -> Future[None]:
        """Do a job in one of the threads."""
        return self._pool.submit(self._perform, perform, job)

    def _perform(self, perform: Perform, job: Any) -> None:
        gpus, number = self._gpus, self._thread.number
        perform(job, self._stop, {"CUDA_VISIBLE_DEVICES": gpus[number % len(gpus)]} if gpus else {})

    def __exit__(self, *error: object) -> None:
        self._stop.set()
        self._pool.shutdown()


class OnRay(Launcher):
    """Tasks of a Ray cluster: the one that there is, or one of this machine.

    Args:
        how: How many at a time, and what each takes of a machine.

    Raises:
        MissingPackageError: if Ray is missing, with the extra to install.
        ClusterError: if it does not start.
    """

    def __init__(self, how: Machine) -> None:
        if find_spec("ray") is None:
            raise MissingPackageError("launcher=ray needs Ray: pip install 'torchrl-ocwm[ray]'", name="ray")
        import ray

        self._ray, self.failures = ray, (ray.exceptions.RayError, UserError)
        self._ours = not ray.is_initialized()
        if self._ours:
            _start(ray)
        gpus = 1 if how.device == "cuda" else 0
        there = ray.cluster_resources()
        room = there.get("GPU", 0) if gpus else there.get("CPU", 1) // how.threads
        self.slots = how.workers or max(1, int(room))
        self._task = ray.remote(num_cpus=how.threads, num_gpus=gpus, max_retries=0)(_as_task)
        self._tasks: list[Any] = []

    def submit(self, perform: Perform, job: Any) -> Future[None]:
        """Do a job as a task."""
        self._tasks.append(self._task.remote(perform, job))
        return self._tasks[-1].future()

    def __exit__(self, *error: object) -> None:
        for task in self._tasks:
            self._ray.cancel(task)  # Ctrl-C for those at work, nothing for the others
        self._ray.wait(self._tasks, num_returns=len(self._tasks)) if self._tasks else None
        if self._ours:
            self._ray.shutdown()


LAUNCHERS: dict[str, Callable[[Machine], Launcher]] = {"local": Local, "ray": OnRay}


def _start(ray: ModuleType) -> None:
    for left in reversed(range(_STARTS)):
        try:
            ray.init(log_to_driver=False, logging_level=logging.WARNING, ignore_reinit_error=True)
            return
        except Exception as error:  # what Ray raises has no type of its own
            ray.shutdown()
            if not left:
                raise ClusterError(f"launcher=ray: Ray does not start ({error}); launcher=local needs none") from error


def _as_task(perform: Perform, job: Any) -> None:
    perform(job, Event(), {})


def _gpus() -> list[str]:
    """Those that this process may use, as it calls them."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    return visible.split(",") if visible else [str(number) for number in range(torch.cuda.device_count())]


def _cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
