"""The queue does what is missing, in order, and can be stopped."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import pytest
import torch

from torchrl_ocwm.errors import MissingPackageError
from torchrl_ocwm.evidence import LAUNCHERS, Machine, Record, Run, RunFailedError, in_order, launchers, queue, work_off
from torchrl_ocwm.evidence.command_line import Command
from torchrl_ocwm.evidence.launchers import ClusterError

#: Says that it has begun, in the order of all, and then does what its name says.
SCRIPT = """
import signal, sys, time
from pathlib import Path

order, name, what = Path(sys.argv[2]), sys.argv[3], sys.argv[4]

def end(number, frame):
    order.with_name(name + ".stopped").touch()
    sys.exit(1)

signal.signal(signal.SIGTERM, end)
with order.open("a") as file:
    file.write(name + "\\n")
if what == "nap":
    time.sleep(1)
    order.with_name(name + ".slept").touch()
if what == "slept":
    sys.exit(not order.with_name("data.slept").exists())
if what == "fail":
    sys.exit(f"{name} cannot be done")
if what == "wait" and not order.with_name(name + ".stopped").exists():
    time.sleep(600)
"""


@dataclass(frozen=True, kw_only=True)
class Stub(Run):
    """A run of the script."""

    kind = "stubs"

    title: str
    what: str = "end"
    does: int = 1
    after: tuple[Run, ...] = ()

    @property
    def prefix(self) -> str:
        return self.title

    @property
    def content(self) -> dict[str, Any]:
        return {"title": self.title}

    @property
    def work(self) -> int:
        return 1

    @property
    def pace(self) -> str:
        return "stub"

    @property
    def needs(self) -> tuple[Run, ...]:
        return self.after

    def commands(self, root: Path, machine: Machine) -> list[Command]:
        return [("stub", str(root / "order"), self.title, self.what)]

    def reached(self, root: Path) -> int:
        return self.does


@pytest.fixture(autouse=True)
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The script is what does runs."""
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "queue_program.py").write_text(SCRIPT)
    monkeypatch.setattr(queue, "PROGRAM", "queue_program")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "modules"), os.environ.get("PYTHONPATH", "")]))


@pytest.fixture
def work(tmp_path: Path) -> Callable[..., list[str]]:
    """Work off runs and what they need; what was begun so far, in its order."""

    def go(*runs: Run, workers: int = 1) -> list[str]:
        how = Machine(workers=workers)
        work_off(in_order(runs), tmp_path, how, LAUNCHERS["local"](how))
        return begun(tmp_path)

    return go


def begun(root: Path) -> list[str]:
    return (root / "order").read_text().split() if (root / "order").exists() else []


def wait_until(condition: Callable[[], bool], seconds: float = 60) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end and not condition():
        time.sleep(0.05)
    return condition()


def test_what_is_needed_is_done_first_and_nothing_twice(work: Callable[..., list[str]], tmp_path: Path) -> None:
    data = Stub(title="data")
    first, second = Stub(title="first", after=(data,)), Stub(title="second", after=(data,))
    last = Stub(title="last", after=(first,))
    assert work(last, second) == ["data", "first", "last", "second"]
    record = Record.of(last, tmp_path)
    assert record.done
    assert record.seconds > 0
    assert record.machine
    assert record.commands == [["stub", "order", "last", "end"]]  # of whichever folder
    assert work(last, second) == ["data", "first", "last", "second"]
    assert work(last, Stub(title="new", after=(second,)))[4:] == ["new"]


def test_the_gpu_of_a_run_is_kept_with_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"a GPU for {device}")
    for device, name in (("cpu", "cores"), ("cuda", "cores, a GPU for cuda")):
        how = Machine(device=device, workers=1)
        work_off([Stub(title=device)], tmp_path, how, LAUNCHERS["local"](how))
        assert Record.of(Stub(title=device), tmp_path).machine.endswith(name)


def test_what_needs_another_waits_for_it_where_there_is_room(work: Callable[..., list[str]]) -> None:
    data = Stub(title="data", what="nap")
    assert work(Stub(title="agent", what="slept", after=(data,)), Stub(title="free"), workers=3)[2] == "agent"


def test_a_run_that_fails_keeps_back_only_those_that_need_it(work: Callable[..., list[str]], tmp_path: Path) -> None:
    bad = Stub(title="bad", what="fail")
    runs = (Stub(title="kept", after=(bad,)), Stub(title="other"))
    with pytest.raises(RunFailedError) as failed:
        work(*runs)
    assert begun(tmp_path) == ["bad", "other"]
    message = str(failed.value)
    assert message.startswith("1 of 3 runs have failed; 1 runs that need them are left: ")
    assert "(bad cannot be done; all of it: " in message
    assert message.endswith("log.txt)")
    assert not Record.of(bad, tmp_path).done
    assert "$ ocwm stub " in (tmp_path / bad.name / "log.txt").read_text()


def test_a_run_that_has_ended_early_is_not_done(work: Callable[..., list[str]], tmp_path: Path) -> None:
    """As a training does that others tell to end: it says that all is well."""
    with pytest.raises(RunFailedError, match=r"ended after 0 of 1; run the same command again"):
        work(Stub(title="short", does=0))
    assert not Record.of(Stub(title="short"), tmp_path).done
    assert work(Stub(title="short")) == ["short", "short"]


def need_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray, whose workers find the stubs."""
    pytest.importorskip("ray")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]))


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["local", "ray"])
def test_several_at_a_time(launcher: Literal["local", "ray"], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two that wait for ever are both at work; on a busy machine Ray takes its time to begin."""
    if launcher == "ray":
        need_ray(monkeypatch)
    runs = [Stub(title=title, what="wait") for title in ("one", "two", "three")]
    how = Machine(launcher=launcher, workers=2)
    where = LAUNCHERS[launcher](how)

    class Enough(BaseException):
        pass

    def watch(*_: Any, **__: Any) -> Any:
        assert wait_until(lambda: len(begun(tmp_path)) == 2, seconds=300)
        raise Enough

    monkeypatch.setattr("torchrl_ocwm.evidence.queue.wait", watch)
    with pytest.raises(Enough):
        work_off(runs, tmp_path, how, where)
    # Whatever ends the queue tells its processes to end, and waits for them.
    assert sorted(begun(tmp_path)) == ["one", "two"]
    assert {file.name for file in tmp_path.glob("*.stopped")} == {"one.stopped", "two.stopped"}
    assert not any(Record.of(run, tmp_path).done for run in runs)


KILLED = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_queue import Stub
from torchrl_ocwm.evidence import LAUNCHERS, Machine, queue, work_off

how, root = Machine(workers=1), Path({root!r})
queue.PROGRAM = "queue_program"
work_off([Stub(title="long", what="wait")], root, how, LAUNCHERS["local"](how))
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_queue_that_ends_ends_its_runs_and_goes_on(
    number: signal.Signals, work: Callable[..., list[str]], tmp_path: Path
) -> None:
    """Also one that is killed, and can tell its processes nothing."""
    code = KILLED.format(tests=str(Path(__file__).parent), root=str(tmp_path))
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    try:
        assert wait_until(lambda: begun(tmp_path) == ["long"], 200)
        process.send_signal(number)
        assert wait_until((tmp_path / "long.stopped").exists)
        process.wait(60)
    finally:
        process.kill()
        process.wait()
    assert work(Stub(title="long", what="wait")) == ["long", "long"]
    assert Record.of(Stub(title="long"), tmp_path).done


def test_time_is_counted_over_stops(work: Callable[..., list[str]], tmp_path: Path) -> None:
    run = Stub(title="once")
    Record(content=run.content, pace="stub", work=1, seconds=1000.0).write(tmp_path / run.name)
    work(run)
    assert Record.of(run, tmp_path).seconds > 1000


def test_room_on_a_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    assert LAUNCHERS["local"](Machine()).slots == 8
    assert LAUNCHERS["local"](Machine(threads=3)).slots == 2
    assert LAUNCHERS["local"](Machine(threads=99)).slots == 1
    assert LAUNCHERS["local"](Machine(workers=5, threads=3)).slots == 5


@pytest.mark.parametrize(("visible", "expected"), [("", {"0", "1", "2"}), ("2,5", {"2", "5"})])
def test_each_run_has_a_gpu_of_its_own(monkeypatch: pytest.MonkeyPatch, visible: str, expected: set[str]) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    seen = []

    def note(job: int, stop: Any, environment: dict[str, str]) -> None:
        seen.append(environment["CUDA_VISIBLE_DEVICES"])
        assert wait_until(lambda: len(seen) == len(expected))

    with LAUNCHERS["local"](Machine(device="cuda")) as launcher:
        assert launcher.slots == len(expected)
        for future in [launcher.submit(note, number) for number in range(launcher.slots)]:
            future.result()
    assert set(seen) == expected


def test_ray_is_named_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launchers, "find_spec", lambda name: None)
    with pytest.raises(MissingPackageError, match=r"launcher=ray needs Ray: pip install 'torchrl-ocwm\[ray\]'"):
        LAUNCHERS["ray"](Machine(launcher="ray"))


def slow_ray(monkeypatch: pytest.MonkeyPatch, fails: int) -> list[str]:
    """Ray on a machine so busy that its first starts fail; what is asked of it."""
    calls: list[str] = []

    def init(**_: Any) -> None:
        calls.append("init")
        if calls.count("init") <= fails:
            raise Exception("The current node timed out during startup.")

    ray = SimpleNamespace(
        exceptions=SimpleNamespace(RayError=RuntimeError),
        is_initialized=lambda: False,
        init=init,
        shutdown=lambda: calls.append("shutdown"),
        cluster_resources=lambda: {"CPU": 2},
        remote=lambda **_: lambda function: function,
    )
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(launchers, "find_spec", lambda name: object())
    return calls


@pytest.mark.parametrize("fails", [0, 2])
def test_ray_is_started_again_on_a_busy_machine(fails: int, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = slow_ray(monkeypatch, fails)
    assert LAUNCHERS["ray"](Machine(launcher="ray")).slots == 2
    assert calls == ["init", "shutdown"] * fails + ["init"]


def test_ray_that_does_not_start_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    slow_ray(monkeypatch, fails=3)
    with pytest.raises(ClusterError, match=r"Ray does not start \(The current node timed out during startup\.\)"):
        LAUNCHERS["ray"](Machine(launcher="ray"))


@pytest.mark.slow
def test_on_ray(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Two local workers; a failure is told as it is on this machine."""
    need_ray(monkeypatch)
    how = Machine(launcher="ray", workers=2)
    data, bad = Stub(title="data"), Stub(title="bad", what="fail")
    runs = [data, Stub(title="one", after=(data,)), Stub(title="two", after=(data,)), bad]
    with pytest.raises(RunFailedError, match="bad cannot be done"):
        work_off(runs, tmp_path, how, LAUNCHERS["ray"](how))
    assert sorted(begun(tmp_path)) == ["bad", "data", "one", "two"]
    assert all(Record.of(run, tmp_path).done for run in runs[:3])
    assert json.loads((tmp_path / runs[1].name / "run.json").read_text())["done"]
