"""Memory that an update frees is there for the next one."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.testing import reacher_task
from torchrl_ocwm.training import allocator, stepper
from torchrl_ocwm.training.allocator import keep_freed_memory
from torchrl_ocwm.training.settings import Training

# In a process of its own, which imports no more than it needs.
KEPT = """
import os, runpy, sys, torch

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

assert runpy.run_path(sys.argv[1])["keep_freed_memory"]()
start = resident()
tensors = [torch.ones(24 * 2**18) for _ in range(8)]  # 24 MiB each
del tensors
print(resident() - start)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs the C library glibc")
def test_freed_memory_is_kept() -> None:
    command = [sys.executable, "-c", KEPT, allocator.__file__]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(run.stdout) > 150 * 2**20  # by default nothing is


def test_other_c_libraries_have_nothing_to_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ctypes.CDLL", lambda name: object())
    assert not keep_freed_memory()
    monkeypatch.setattr("sys.platform", "win32")
    monkeypatch.setattr("ctypes.CDLL", None)  # is not even asked there
    assert not keep_freed_memory()


@pytest.mark.parametrize(("device", "calls"), [("cpu", 1), ("cuda", 0)])
def test_updates_on_a_cpu_keep_it(monkeypatch: pytest.MonkeyPatch, device: str, calls: int) -> None:
    called: list[None] = []
    monkeypatch.setattr(stepper, "keep_freed_memory", lambda: called.append(None))
    stepper.make_stepper(build_agent("dreamer", reacher_task(), "debug"), Training(device=device))
    assert len(called) == calls
