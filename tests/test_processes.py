"""Objects in processes: calls, errors of there, ends."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
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
        self.total = 0

    def add(self, number: int) -> int:
        self.total += number
        return self.total

    def large(self, size: int) -> torch.Tensor:
        return torch.arange(size)

    def fail(self, odd: bool) -> None:
        raise OddError(3, "times") if odd else KeyError("there")


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
