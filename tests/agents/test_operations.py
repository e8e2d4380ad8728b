"""An update stays cheap to launch: each of its operations costs microseconds, whatever its size."""

from __future__ import annotations

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

from torchrl_ocwm.agents import AGENTS

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "update_speed.py"


@pytest.mark.parametrize("name", AGENTS)
def test_an_update_at_size_cpu_takes_few_operations(name: str) -> None:
    spec = spec_from_file_location("update_speed_for_counting", BENCHMARK)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = module_from_spec(spec)
    spec.loader.exec_module(module)
    how = {"mixed_precision": False, "compile": False, "cudagraph": False}
    work = module.Update(name, "cpu", {"threads": 1, "device": "cpu", "updates": 1, **how}).count()
    assert 7_000 < work.operations <= 9_000
