"""Tiny versions of the benchmarks, as a user runs them."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from functools import partial
from pathlib import Path
from types import ModuleType

import pytest
import torch

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def agent_cost() -> ModuleType:
    specification = importlib.util.spec_from_file_location("agent_cost", BENCHMARKS / "agent_cost.py")
    assert specification
    assert specification.loader
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_cost_of_agents_is_a_table_with_shares_that_add_up() -> None:
    agents = ["dreamer", "focus_lcp"]
    command = ["--agents", *agents, "--sizes", "debug", "--rounds", "1", "--threads", "1"]
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / "agent_cost.py"), *command], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert f"torch {torch.__version__}, cpu, float32, 1 threads" in done.stdout
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in done.stdout.splitlines() if "|" in line]
    head, _, *rows = lines
    assert [row[0] for row in rows] == agents
    for row in rows:
        cells = dict(zip(head, row, strict=True))
        assert min(float(cells[name]) for name in ("s/update", "x reference", "peak MiB")) > 0
        shares = [float(cells[name]) for name in head[-6:]]
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
