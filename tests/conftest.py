from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import pytest
import torch
from tensordict import TensorDict

from torchrl_ocwm.agents import AGENTS, EXPLORERS, SIZES, Agent, build_agent
from torchrl_ocwm.console import COMMANDS
from torchrl_ocwm.envs import ENVIRONMENTS
from torchrl_ocwm.parts import Part
from torchrl_ocwm.recipes import config as recipes
from torchrl_ocwm.settings import change
from torchrl_ocwm.testing import random_records, reacher_task

#: What a command of a recipe has to say, whatever else it says.
REQUIRED = {
    "evaluate": ["checkpoint=a.zip"],
    "diagnose": ["checkpoint=a.zip", "dataset=data"],
    "reproduce": ["figure=table"],
    "share": ["evaluation=there"],
    "draw_targets": ["dataset=data", "destination=out"],
    "import_data": ["source=there"],
    "export_data": ["dataset=data", "format=npz", "destination=out"],
}

# A shell that runs the tests in the background lets them, and what they start, ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)

collect_ignore = ["plugin/ocwm_example"]  # a package that the tests import when they want its parts


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


@pytest.fixture
def float64(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Calculate in float64. In float32 the processor's way of rounding decides sooner or later which state is drawn."""
    monkeypatch.setattr(torch.Tensor, "float", torch.Tensor.double)
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


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
    with torch.device("cpu"):  # PyTorch notes once, at the first of these, which functions make tensors
        rand = torch.rand
        rand(1)

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


@pytest.fixture(scope="session")
def scripts() -> dict[str, ModuleType]:
    """The recipes by the names of their modules: to run one here saves the seconds that a process takes to start."""
    return {name: import_module(f"torchrl_ocwm.recipes.{name}") for name, _ in COMMANDS.values()}


@pytest.fixture
def command(
    scripts: dict[str, ModuleType],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> Callable[..., str]:
    """Run a recipe with arguments in an empty folder; what it says if it ends with an error, or what it prints."""
    monkeypatch.chdir(tmp_path)

    def run(script: str, *arguments: str) -> str:
        names = {argument.partition("=")[0] for argument in arguments}
        required = [one for one in REQUIRED.get(script, []) if one.partition("=")[0] not in names]
        monkeypatch.setattr(sys, "argv", ["ocwm", *required, *arguments])
        try:
            scripts[script].main()
        except SystemExit as stop:
            printed = capsys.readouterr()
            said = printed.err if stop.code else printed.out
            return stop.code if isinstance(stop.code, str) else said
        return capsys.readouterr().out

    return run


class Composed(BaseException):
    """The settings of a command; nothing else is done."""


@pytest.fixture
def compose(command: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """The settings that a recipe would run with, or what it says of a value that it refuses."""
    read = recipes.from_dict

    def stop(*arguments: Any) -> Any:
        raise Composed(read(*arguments))

    monkeypatch.setattr(recipes, "from_dict", stop)

    def run(script: str, *arguments: str) -> Any:
        try:
            return command(script, *arguments)
        except Composed as composed:
            return composed.args[0]

    return run
