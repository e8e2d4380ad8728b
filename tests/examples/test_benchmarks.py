"""Tiny versions of the benchmarks, as a user runs them."""

from __future__ import annotations

import importlib.util
import operator
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from torchrl_ocwm.agents import build_agent, save_agent
from torchrl_ocwm.envs import PositioningEnv, make_task

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def benchmark(name: str) -> ModuleType:
    specification = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
    assert specification
    assert specification.loader
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def agent_cost() -> ModuleType:
    return benchmark("agent_cost")


@pytest.fixture(scope="module")
def update_speed() -> ModuleType:
    return benchmark("update_speed")


def cells(printed: str) -> list[list[str]]:
    """Those of a table."""
    lines = [line for line in printed.splitlines() if "|" in line]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_speed_of_an_environment(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    """All rows take the same random actions; two turns of three steps each, after one to warm up."""
    env_speed = benchmark("env_speed")
    made, handed_out = env_speed.random_actions, []

    def random_actions(env: PositioningEnv) -> Iterator[np.ndarray]:
        taken: list[np.ndarray] = []
        handed_out.append(taken)
        for action in made(env):
            taken.append(action)
            yield action

    monkeypatch.setattr(env_speed, "random_actions", random_actions)
    options = ["--rounds", "2", "--steps", "3", "--image-size", "16", "--workers", "1"]
    monkeypatch.setattr(sys, "argv", ["env_speed.py", *options])
    env_speed.main()
    title, _, *rows = capsys.readouterr().out.splitlines()
    assert title == "reacher, 16 x 16, median of 2 turns of 3 steps"
    numbers = {row[:24].strip(): [float(number) for number in row[24:].split()] for row in rows}
    assert list(numbers) == ["physics", "minimum", "gymnasium environment", "TorchRL environment", "1 processes"]
    assert numbers["minimum"][1] == 1.0
    assert min(speed for speed, _ in numbers.values()) > 0
    assert len(handed_out) == 4
    assert all(np.array_equal(actions, handed_out[0]) for actions in handed_out)
    assert np.std(handed_out[0]) > 0.3


def test_cost_of_agents_is_a_table_with_shares_that_add_up() -> None:
    agents = ["dreamer", "focus_lcp"]
    options = ["--agents", *agents, "--sizes", "debug", "--rounds", "1", "--threads", "1"]
    command = [sys.executable, str(BENCHMARKS / "agent_cost.py"), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert f"torch {torch.__version__}, cpu, float32, 1 threads" in done.stdout
    head, _, *rows = cells(done.stdout)
    assert [row[0] for row in rows] == agents
    for row in rows:
        named = dict(zip(head, row, strict=True))
        assert min(float(named[name]) for name in ("s/update", "x reference", "peak MiB")) > 0
        shares = [float(named[name]) for name in head[-6:]]
        assert all(0 <= share <= 1 for share in shares)
        assert sum(shares) == pytest.approx(1, abs=0.031)  # six rounded numbers


# Gradients of focus_lcp are added up in another order; what that changes, the optimiser would magnify.
@pytest.mark.parametrize(("name", "updates"), [("dreamer", 3), ("focus_lcp", 1)])
def test_update_cut_into_parts_is_the_update(agent_cost: ModuleType, name: str, updates: int) -> None:
    size = agent_cost.SIZES["debug"].learning
    batch = agent_cost.random_records(agent_cost.TASK, size.batch_size, size.slice_len)
    weights = []
    for cut in (False, True):
        torch.manual_seed(0)
        agent, stepper = agent_cost.make_update(name, "debug", agent_cost.Training(compile=False, cudagraph=False))
        update = agent_cost.CutUpdate(agent, stepper, "cpu") if cut else partial(stepper.step, None)
        for _ in range(updates):
            update(batch.clone())
        weights.append({key: value.clone() for key, value in agent.state_dict().items()})
    whole, parts = weights
    assert whole.keys() == parts.keys()
    for key, value in whole.items():
        torch.testing.assert_close(parts[key], value, msg=key)


def test_work_is_that_of_products_and_convolutions_in_both_passes(update_speed: ModuleType) -> None:
    left, right = torch.rand(3, 5, requires_grad=True), torch.rand(5, 7, requires_grad=True)
    images, kernels = torch.rand(2, 3, 8, 8), torch.rand(4, 3, 5, 5, requires_grad=True)
    with update_speed.Work() as product:
        (left @ right).sum().backward()
    with update_speed.Work() as convolution:
        torch.nn.functional.conv2d(images, kernels, stride=2, padding=2).sum().backward()
    assert product.flop == 3 * 2 * 3 * 5 * 7  # forward, and the gradients of both
    assert convolution.flop == 2 * 2 * (2 * 4 * 4 * 4) * (3 * 5 * 5)  # forward, and the gradient of the kernels
    with update_speed.Work() as none:
        _ = left + left.detach()
    assert (none.flop, none.operations) == (0, 2)


def test_profile_of_updates_has_shares_of_each_kind() -> None:
    profile = benchmark("update_profile")
    assert profile.kind("aten::convolution_backward", [[2, 3], []]) == "convolutions"
    assert profile.kind("aten::addmm", [[5], [2**20, 5]]) == "products"
    assert profile.kind("aten::mul", [[2**10, 2**8], [2**8]]) == "other, large tensors"
    assert profile.kind("aten::mul", [[2**10, 2**7], []]) == "other, small tensors"
    shares = profile.shares("dreamer", "debug", 1)
    assert min(shares[0], shares[1], shares[3]) > 0.01  # images of this size are small
    assert sum(shares) == pytest.approx(1)


def test_speed_of_updates_beside_another_commit(
    update_speed: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The other commit is this one again."""
    options = ["--agents", "dreamer", "--sizes", "debug", "--rounds", "2", "--updates", "1", "--before", "this"]
    monkeypatch.setattr(sys, "argv", ["update_speed.py", *options])
    monkeypatch.setattr(update_speed, "checkout", lambda commit: nullcontext(BENCHMARKS.parent))
    update_speed.main()
    printed = capsys.readouterr().out
    assert "cpu, float32, 1 threads; medians of 2 rounds of 1 updates" in printed
    head, _, row = cells(printed)
    assert head == [*update_speed.HEAD, "operations before", "times faster"]
    agent, gflop, operations, seconds, rate, efficiency, before, ratio = row
    assert agent == "dreamer"
    assert operations == before
    assert min(float(cell) for cell in (gflop, seconds, rate, ratio)) > 0
    assert 0 <= float(efficiency) < 1


def test_a_child_has_the_library_of_its_folder_and_the_packages_of_its_parent(
    update_speed: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "packages")
    started: dict[str, dict[str, str]] = {}
    monkeypatch.setattr(update_speed.subprocess, "Popen", lambda command, env, **options: started.update(env=env))
    monkeypatch.setattr(update_speed.Child, "_read", lambda self: [1, 2])
    update_speed.Child(Path("folder"), "dreamer", "debug", {})
    assert started["env"]["PYTHONPATH"] == os.pathsep.join(["folder", "packages"])


def test_how_updates_are_timed(update_speed: ModuleType) -> None:
    """Options reach the update: here those that would not be seen in a table."""
    options = {
        "rounds": 1,
        "updates": 3,
        "threads": 2,
        "device": "cpu",
        "mixed_precision": True,
        "compile": True,
        "cudagraph": False,
    }
    threads = torch.get_num_threads()
    try:
        update = update_speed.Update("dreamer", "debug", options)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    how = operator.attrgetter("mixed_precision", "compile_train_step", "cudagraph")
    assert how(update.stepper) == (True, True, False)
    assert how(update.eager) == (True, False, False)
    calls = []
    update.stepper.step = lambda trainer, batch: calls.append(batch)
    update.round()
    assert len(calls) == 3


def test_speed_of_an_evaluation_adds_up(tmp_path: Path) -> None:
    torch.manual_seed(0)
    file = save_agent(build_agent("focus_lcp", make_task("reacher"), "debug"), tmp_path / "agent.zip")
    small = ["--goals", "1", "--steps", "6", "--rounds", "1", "--workers", "0"]
    command = [sys.executable, str(BENCHMARKS / "evaluation_speed.py"), str(file), *small]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "1 goals, 6 steps, 0 processes; medians of 1 rounds" in done.stdout
    _, _, *rows = cells(done.stdout)
    seconds = {name: float(value) for name, value, *_ in rows}
    total, _ = seconds.pop("**all**"), seconds.pop("**processor**")
    assert sum(seconds.values()) == pytest.approx(total, abs=0.05 * (len(seconds) + 1))  # rounded numbers
    shares = {name: float(share) for name, _, share in rows[:-2]}
    assert all(0 <= share <= 1 for share in shares.values())
    assert min(seconds["pictures of objects"], seconds["everything else, such as imports"]) > 0
    assert seconds["writing of videos"] == 0  # a thread beside does it


def test_colour_masks_find_more_from_more_frames(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cv2")
    script = benchmark("colour_masks")
    monkeypatch.setattr(script, "STEPS", 15)
    options = ["--envs", "reacher", "--episodes", "3", "--labelled", "1", "8"]
    monkeypatch.setattr(sys, "argv", ["colour_masks.py", *options])
    script.main()
    head, _, *rows = cells(capsys.readouterr().out)
    table = {row[2]: dict(zip(head, row, strict=True)) for row in rows}
    assert list(table) == ["1 labelled", "1 clicked", "8 labelled", "8 clicked"]
    assert 2 < float(table["1 labelled"]["pixels of the object"]) < 6
    assert float(table["8 labelled"]["IoU"]) > max(0.5, float(table["1 labelled"]["IoU"]))
    assert float(table["8 labelled"]["centroid, median"]) < 0.5
    assert {row["removed"] for row in table.values()} == {"0.0%"}
