"""Objects in processes: calls, errors of there, ends."""

from __future__ import annotations

import multiprocessing
import os
import signal
import stat
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
import torch

from torchrl_ocwm.processes import WorkerError, make_worker


class OddError(Exception):
    """Cannot be made again from its arguments."""

    def __init__(self, number: int, word: str) -> None:
        super().__init__(f"{number} {word}")


class Counter:
    def __init__(self, alive: Callable[[], None]) -> None:
        self.total, self.alive = 0, alive

    def add(self, number: int) -> int:
        self.total += number
        return self.total

    def large(self, size: int) -> torch.Tensor:
        return torch.arange(size)

    def slow(self, seconds: float) -> str:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.alive()
            time.sleep(0.05)
        return "at last"

    def fail(self, odd: bool) -> None:
        raise OddError(3, "times") if odd else KeyError("there")

    def die_slowly(self) -> None:
        """Sockets first, as the system does it; on a busy machine the rest takes its time."""
        for number in os.listdir("/proc/self/fd"):
            with suppress(OSError):
                if stat.S_ISSOCK(os.fstat(int(number)).st_mode):
                    os.close(int(number))
        time.sleep(3)
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("process", [False, True])
def test_calls(process: bool) -> None:
    worker = make_worker(Counter, process=process, timeout=60)
    try:
        worker.ready()
        for number, total in ((2, 2), (5, 7)):
            worker.request("add", number)
            assert worker.answer() == total
        worker.request("large", 1_000_000)  # more than fits in a pipe
        assert torch.equal(worker.answer(), torch.arange(1_000_000))
        worker.request("fail", False)
        with pytest.raises(KeyError, match="there") as error:
            worker.answer()
        if process:
            assert "in fail" in str(error.value.__cause__)  # the traceback of there
            worker.request("add", 1)
            with pytest.raises(WorkerError, match=r"has ended"):
                worker.answer()
    finally:
        worker.close()
        worker.close()  # twice is no harm
    assert not multiprocessing.active_children()


def test_errors_that_do_not_travel() -> None:
    worker = make_worker(Counter, process=True, timeout=60)
    worker.ready()
    worker.request("fail", True)
    with pytest.raises(RuntimeError, match="OddError: 3 times"):
        worker.answer()
    worker.close()
    with pytest.raises(WorkerError, match="was closed"):
        worker.answer()


def test_requests_to_the_dead_do_not_raise() -> None:
    worker: Any = make_worker(Counter, process=True, timeout=60)
    worker.ready()
    worker._process.kill()
    worker._process.join()
    worker.request("add", 1)
    with pytest.raises(WorkerError, match=r"has ended \(signal SIGKILL\)"):
        worker.answer()
    worker.close()


@pytest.mark.skipif(not os.path.exists("/proc/self/fd"), reason="needs the list of a process's open files")
def test_how_a_process_ends_is_waited_for() -> None:
    worker = make_worker(Counter, process=True, timeout=60)
    worker.ready()
    worker.request("die_slowly")
    with pytest.raises(WorkerError, match=r"has ended \(signal SIGKILL\)"):
        worker.answer()
    worker.close()


def test_done_is_said_without_waiting() -> None:
    """Whatever has arrived before: signs of life, parts of the answer, or nothing."""
    worker = make_worker(Counter, process=True, timeout=60)
    worker.ready()
    for _ in range(2):
        worker.request("slow", 1.5)  # with a sign of life on the way
        start, asked = time.monotonic(), 0
        while not worker.done():
            asked += 1
            assert time.monotonic() - start < 60
            time.sleep(0.01)
        assert asked > 20
        assert worker.answer() == "at last"
    worker.request("large", 1_000_000)
    assert torch.equal(worker.answer(), torch.arange(1_000_000))
    worker.close()
    assert worker.done()


def test_signs_of_life_and_answer_that_arrive_together() -> None:
    worker = make_worker(Counter, process=True, timeout=60)
    worker.ready()
    worker.request("slow", 1.5)
    time.sleep(4)
    until = time.monotonic() + 60
    while not worker.done():
        assert time.monotonic() < until
    worker.request("add", 2)
    assert worker.answer() == "at last"
    assert worker.answer() == 2
    worker.close()


@pytest.mark.parametrize("ends", [True, False])
def test_a_call_that_fails_is_done(ends: bool) -> None:
    worker: Any = make_worker(Counter, process=True, timeout=60)
    worker.ready()
    worker.request("slow", 60) if ends else worker.request("fail", False)
    if ends:
        assert not worker.done()
        worker._process.kill()
    until = time.monotonic() + 30
    while not worker.done():
        assert time.monotonic() < until
    with pytest.raises(WorkerError if ends else KeyError):
        worker.answer()
    worker.close()
