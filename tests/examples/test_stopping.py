"""Ctrl-C and SIGTERM end each recipe soon, and with it what it started, also when that hangs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from torchrl.checkpoint import Checkpoint

from torchrl_ocwm.agents import build_agent
from torchrl_ocwm.agents.checkpoint import describe
from torchrl_ocwm.testing import random_dataset, reacher_task

EXAMPLES = Path(__file__).parents[2] / "examples"
SOON = 30  # seconds; it takes one where nothing else runs


@pytest.fixture(scope="module")
def arguments(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Of each recipe, with enough to do for minutes."""
    folder = tmp_path_factory.mktemp("stopped")
    task = reacher_task()
    agent = build_agent("focus_lcp", task, size="debug")
    file = Checkpoint(agent=describe(agent), loss_module=agent.loss, format="archive").save(folder / "checkpoint.zip")
    dataset = random_dataset(folder / "random", task, episodes=3, length=400)
    small = ["env.options.horizon=20", "env.options.image_size=16"]
    of_dataset = [f"dataset={dataset.path}", "sequences=100", "length=400"]
    return {
        "collect.py": [f"dataset={folder}/data", "steps=1000000", "workers=1", *small],
        "evaluate.py": [f"checkpoint={file}", "episode_steps=100000", "workers=1", f"output={folder}/evaluation"],
        "diagnose.py": [f"checkpoint={file}", *of_dataset, f"output={folder}/diagnosis"],
    }


def children(process: int) -> list[int]:
    """Processes that a process started, and theirs."""
    lines = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True).stdout.splitlines()
    pairs = [tuple(map(int, line.split())) for line in lines]
    own = [pid for pid, parent in pairs if parent == process]
    return own + [grandchild for child in own for grandchild in children(child)]


def wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.1)
    return False


def is_running(pid: int) -> bool:
    """Not a zombie that nobody has asked for yet."""
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False).stdout
    return bool(state) and not state.startswith("Z")


def catches(pid: int, number: signal.Signals) -> bool:
    """Whether a process does something of its own at a signal."""
    status = Path(f"/proc/{pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


def is_at_work(process: subprocess.Popen[str], workers: int) -> bool:
    """The recipe has begun, and its workers are past the start, which takes two or three seconds of processor time."""
    assert process.poll() is None, process.communicate()
    with suppress(FileNotFoundError):
        stats = [Path(f"/proc/{pid}/stat").read_text().split() for pid in children(process.pid)]
        return catches(process.pid, signal.SIGTERM) and sum(int(one[13]) > 400 for one in stats) >= workers
    return False


@pytest.mark.slow
@pytest.mark.parametrize(
    ("script", "number", "hanging"),
    [
        ("collect.py", signal.SIGINT, True),
        ("collect.py", signal.SIGKILL, False),
        ("evaluate.py", signal.SIGTERM, True),
        ("diagnose.py", signal.SIGINT, False),
    ],
)
def test_ends_with_its_children(
    arguments: dict[str, list[str]], script: str, number: signal.Signals, hanging: bool
) -> None:
    """As a terminal does it: Ctrl-C goes to the processes of the whole group."""
    process = subprocess.Popen(
        [sys.executable, str(EXAMPLES / script), *arguments[script]],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert wait_until(lambda: is_at_work(process, 0 if script == "diagnose.py" else 1), 200)
        started = children(process.pid)
        for child in started[-1:] if hanging else ():
            os.kill(child, signal.SIGSTOP)
        (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
        _, error = process.communicate(timeout=SOON)
        assert wait_until(lambda: not any(map(is_running, started)), SOON)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    if number == signal.SIGKILL:
        return
    assert process.returncode == 128 + number
    assert f"stopped by {number.name}; what has been written is whole" in error
    assert "Traceback" not in error
