"""Do the runs that are missing, a few at a time."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event

from torchrl_ocwm.errors import UserError
from torchrl_ocwm.evidence.command_line import Command
from torchrl_ocwm.evidence.launchers import Launcher
from torchrl_ocwm.evidence.records import LOG, Record
from torchrl_ocwm.evidence.run import Run
from torchrl_ocwm.evidence.settings import Machine
from torchrl_ocwm.origin import commit, machine

CHILD, PROGRAM = Path(__file__).with_name("child.py"), "torchrl_ocwm.console"
_LOOK, _NOTE = 0.2, 30.0  # seconds between two looks at a process, and between two notes of the time
_PATIENCE = 120.0  # seconds that a process has to end when told to


class RunFailedError(UserError, RuntimeError):
    """A command of a run has failed; the message has its last line, and where the others are."""


@dataclass(frozen=True)
class Job:
    """A run with all that is needed to do it, also on another machine.

    Args:
        run: The run.
        root: Folder of all runs.
        commands: What does it.
        record: What is known of it so far.
        threads: Threads of each process.
        device: Where it trains.
        program: The module that does a command.
    """

    run: Run
    root: Path
    commands: Sequence[Command]
    record: Record
    threads: int
    device: str
    program: str

    @property
    def folder(self) -> Path:
        """Of the run."""
        return self.root / self.run.name


def in_order(runs: Iterable[Run]) -> list[Run]:
    """Runs and all that they need, each once, what is needed first."""
    found: dict[str, Run] = {}
    for run in runs:
        for one in [*in_order(run.needs), run]:
            found.setdefault(one.name, one)
    return list(found.values())


def to_do(runs: Sequence[Run], root: Path) -> set[str]:
    """Names of the runs that have to be done: those that are not, and what these need and is not here.

    Args:
        runs: The runs, what is needed first (:func:`in_order`).
        root: Folder of all runs. A record there may be of a run that was done elsewhere.
    """
    names = {run.name for run in runs if not Record.of(run, root).done}
    for run in reversed(runs):
        if run.name in names:
            names |= {need.name for need in run.needs if need.reached(root) < need.work}
    return names


def work_off(
    runs: Sequence[Run],
    root: Path,
    how: Machine,
    launcher: Launcher,
    *,
    on_done: Callable[[Run], None] = lambda run: None,  # noqa: ARG005
) -> None:
    """Do the runs that are :func:`to_do`, in their order as far as there is room for them.

    A run that fails keeps back those that need it; all others are done nevertheless. Ctrl-C and SIGTERM stop what is
    at work, so that the next call goes on from there.

    Args:
        runs: The runs, what is needed first (:func:`in_order`).
        root: Folder of all runs.
        how: How.
        launcher: Where.
        on_done: Called after each run.

    Raises:
        RunFailedError: in the end, if some have failed.
    """
    names = to_do(runs, root)
    left, failed = [run for run in runs if run.name in names], dict[str, str]()
    done = {run.name for run in runs} - names
    at_work: dict[Future[None], Run] = {}
    with launcher:
        while True:
            while len(at_work) < launcher.slots and (run := _next(left, done)):
                left.remove(run)
                record = Record.of(run, root)
                # Commands are kept as seen from the root: the folder of all runs may be moved.
                seconds, commands = 0.0 if record.done else record.seconds, tuple(run.commands(Path(), how))
                record = replace(record, commands=commands, seconds=seconds, done=False)
                job = Job(run, root, run.commands(root, how), record, how.threads, how.device, PROGRAM)
                at_work[launcher.submit(perform, job)] = run
            if not at_work:
                break
            for future in wait(at_work, return_when=FIRST_COMPLETED).done:
                run = at_work.pop(future)
                try:
                    future.result()
                except launcher.failures as error:
                    failed[run.name] = str(error)
                else:
                    done.add(run.name)
                    on_done(run)
    if failed:
        kept = f"; {len(left)} runs that need them are left" if left else ""
        raise RunFailedError(f"{len(failed)} of {len(runs)} runs have failed{kept}: {'; '.join(failed.values())}")


def _next(left: Sequence[Run], done: set[str]) -> Run | None:
    return next((run for run in left if all(one.name in done for one in run.needs)), None)


def perform(job: Job, stop: Event, environment: Mapping[str, str]) -> None:
    """Do a run: its commands, each in a process of its own, whose output is kept in the run's folder.

    Args:
        job: The run.
        stop: Set to end it early. The process is told to end, and has what it has done so far on disk.
        environment: Variables of the processes, beside those of this one.

    Raises:
        RunFailedError: if a command fails or is stopped, or ends before all is done.
    """
    job.folder.mkdir(parents=True, exist_ok=True)
    record = replace(job.record, commit=commit(), machine=machine(job.device))
    before, start = record.seconds, time.monotonic()

    def note(done: bool = False) -> None:
        replace(record, seconds=round(before + time.monotonic() - start, 1), done=done).write(job.folder)

    try:
        for command in job.commands:
            _run(job, command, stop, environment, note)
        _check_end(job)
    except BaseException:
        note()
        raise
    note(done=True)


def _run(job: Job, command: Command, stop: Event, environment: Mapping[str, str], note: Callable[[], None]) -> None:
    threads = str(job.threads)
    variables = {**os.environ, "OMP_NUM_THREADS": threads, "LP_NUM_THREADS": "0", **environment}
    with (job.folder / LOG).open("ab") as log:
        log.write(f"\n$ ocwm {' '.join(command)}\n".encode())
        log.flush()
        process = subprocess.Popen(
            [sys.executable, str(CHILD), job.program, *command],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            env=variables,
            start_new_session=True,  # Ctrl-C reaches it through this process only, once
        )
        try:
            _watch(process, stop, note)
        finally:
            _end(process)
    if stop.is_set():
        raise RunFailedError(f"{job.folder}: stopped")
    if process.returncode:
        raise RunFailedError(f"{job.folder} ({_last_line(job.folder / LOG)}; all of it: {job.folder / LOG})")


def _check_end(job: Job) -> None:
    """A training that somebody else has told to end has left a checkpoint, and says that all is well."""
    reached = job.run.reached(job.root)
    if reached < job.run.work:
        raise RunFailedError(f"{job.folder} (ended after {reached:,} of {job.run.work:,}; run the same command again)")


def _watch(process: subprocess.Popen[bytes], stop: Event, note: Callable[[], None]) -> None:
    noted = time.monotonic()
    while process.poll() is None and not stop.wait(_LOOK):
        if time.monotonic() - noted > _NOTE:
            note()
            noted = time.monotonic()


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process that has not ended itself; it gets the time to write what it has."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    assert process.stdin is not None
    process.stdin.close()


def _last_line(file: Path) -> str:
    lines = file.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1].rpartition("\r")[2] if lines else "it has said nothing"
