from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.agents import AGENTS, EXPLORERS, SIZES, Agent, build_agent
from torchrl_ocwm.envs import ENVIRONMENTS
from torchrl_ocwm.parts import Part
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import random_records, reacher_task

collect_ignore = ["plugin/ocwm_example"]  # a package that the tests import when they want its parts


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture(scope="module")
def registries() -> Iterator[None]:
    """What the tests of a module register is gone afterwards."""
    tables: list[dict[str, Any]] = [AGENTS, EXPLORERS, SIZES, ENVIRONMENTS, *Part.registered.values()]
    before = [dict(table) for table in tables]
    yield
    for table, content in zip(tables, before, strict=True):
        table.clear()
        table.update(content)


@pytest.fixture
def make_agent() -> Callable[..., Agent]:
    """Debug agents, all with the same weights, and random ones in the heads that would start at zero."""

    def make(name: str = "dreamer_pcp", changes: Mapping[str, Any] = {}) -> Agent:
        torch.manual_seed(0)
        agent = build_agent(change(AGENTS[name], changes), reacher_task(), size="debug")
        with torch.no_grad():
            for parameter in agent.parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
        critic = agent.behaviour().loss.value_loss
        critic.target_value_model_params.data.copy_(critic.value_model_params.data)
        return agent

    return make


@pytest.fixture
def no_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random numbers that are all the same, for code that draws them in another order."""
    rand = torch.rand

    def constant(*size: Any, **kwargs: Any) -> torch.Tensor:
        if "generator" in kwargs:  # test data
            return rand(*size, **kwargs)
        shape = size if isinstance(size[0], int) else tuple(size[0])
        return torch.full(shape, 0.3, **kwargs)

    monkeypatch.setattr(torch, "rand", constant)
    monkeypatch.setattr(
        torch.distributions.normal, "_standard_normal", lambda shape, dtype, device: torch.full(shape, 0.5)
    )


@pytest.fixture
def records() -> TensorDict:
    records = random_records(reacher_task(), 2, 6)
    records["is_init"][1, 3] = True  # an episode starts inside the second sequence
    records["next", "terminated"][0, 5] = True
    return records


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 16 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("cannot mount a file system here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)
