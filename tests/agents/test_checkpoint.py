"""Agents on disk: saved from a loop of one's own, and damaged descriptions."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torchrl._utils import logger
from torchrl.checkpoint import CheckpointError

from torchrl_ocwm import load_agent, save_agent
from torchrl_ocwm.agents import Agent, build_agent
from torchrl_ocwm.agents.archive import Archive
from torchrl_ocwm.agents.checkpoint import check_same_agent, describe
from torchrl_ocwm.testing import random_records, reacher_task

LARGE = 10**6


@pytest.fixture(scope="module")
def agent() -> Agent:
    return build_agent("focus_lcp", reacher_task(), "debug")


def test_an_agent_from_a_loop_of_ones_own(tmp_path: Path) -> None:
    agent = build_agent("focus_lcp", reacher_task(), "debug")
    optimizer = torch.optim.Adam(agent.loss.parameters())
    losses = agent.loss(random_records(agent.task, 2, 4))
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    optimizer.step()
    loaded = load_agent(save_agent(agent, tmp_path / "new" / "agent.zip")).agent
    assert (loaded.task, loaded.config, loaded.size) == (agent.task, agent.config, agent.size)
    for name, value in agent.loss.state_dict().items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(loaded.loss.state_dict()[name], value, rtol=0, atol=0, msg=name)


@pytest.mark.parametrize(("kind", "warned"), [("agent", 0), ("run", 1)])
def test_another_pytorch_is_said_of_a_run_alone(
    agent: Agent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, warned: int
) -> None:
    """The weights of an agent are checked by name and shape; those of a run have what PyTorch's modules call them."""
    if kind == "agent":
        save_agent(agent, tmp_path / "file.zip")
    else:
        Archive(agent=describe(agent), loss_module=agent.loss).save(tmp_path / "file.zip")
    said: list[str] = []
    monkeypatch.setattr(logger, "warning", lambda message, *_: said.append(message))
    monkeypatch.setattr(torch, "__version__", "9.9.9")
    load_agent(tmp_path / "file.zip")
    assert len(said) == warned
    assert all("version skew" in one for one in said)


def test_a_device_that_is_not_there(agent: Agent, tmp_path: Path) -> None:
    file = save_agent(agent, tmp_path / "agent.zip")
    with pytest.raises(ValueError, match="device 'cuda:99' cannot be used"):
        load_agent(file, device="cuda:99")


def test_another_agent_is_named_by_what_differs(agent: Agent, tmp_path: Path) -> None:
    file = save_agent(build_agent("focus_pcp", reacher_task(), "debug"), tmp_path / "agent.zip")
    with pytest.raises(CheckpointError, match=r"another agent \(.*position there, .*object_latent here"):
        check_same_agent(agent, file)
    check_same_agent(agent, save_agent(agent, tmp_path / "same.zip"))


def put(*keys: Any, value: Any) -> Callable[[Any], Any]:
    """Set one value of a description."""

    def change(description: Any) -> Any:
        inner = description
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value
        return description

    return change


def drop(*keys: Any) -> Callable[[Any], Any]:
    """Take one entry out of a description."""

    def change(description: Any) -> Any:
        inner = description
        for key in keys[:-1]:
            inner = inner[key]
        del inner[keys[-1]]
        return description

    return change


DAMAGES: dict[str, Callable[[Any], Any]] = {
    "a list": lambda description: [description],
    "a text": lambda description: "dreamer",
    "nothing": lambda description: None,
    "empty": lambda description: {},
    "no agent": drop("agent"),
    "no size": drop("size"),
    "no task": drop("task"),
    "something more": put("extra", value=1),
    "agent is a list": put("agent", value=[1]),
    "size is nothing": put("size", value=None),
    "task is a text": put("task", value="reacher"),
    "unknown setting": put("size", "colour", value="red"),
    "missing size": drop("size", "architecture", "belief"),
    "missing task name": drop("task", "name"),
    "unknown choice": put("agent", "behaviours", "reach", "goal", value="moon"),
    "choice is a number": put("agent", "behaviours", "reach", "goal", value=3),
    "number is a text": put("size", "architecture", "belief", value="16"),
    "number is true": put("size", "architecture", "belief", value=True),
    "whole number is real": put("size", "architecture", "belief", value=16.5),
    "negative": put("size", "architecture", "mlp_units", value=-1),
    "not a number": put("size", "learning", "gamma", value=float("nan")),
    "infinite": put("size", "learning", "model_lr", value=float("inf")),
    "list is a number": put("size", "architecture", "cnn_mults", value=3),
    "list holds a text": put("size", "architecture", "cnn_mults", value=["1"]),
    "list is a text": put("agent", "world_model", "observed", value="proprio"),
    "unknown observation": put("agent", "world_model", "observed", value=["smell"]),
    "larger than the file": put("size", "architecture", "hidden", value=LARGE),
    "another shape": put("size", "architecture", "hidden", value=12),
    "another row": put("agent", "world_model", "name", value="flat"),
    "objects are a text": put("task", "objects", value="finger"),
    "image size is a text": put("task", "image_size", value="64"),
    "image of three sides": put("task", "image_size", value=[3, 64, 64]),
    "workspace is a list": put("task", "workspace", value=[-1, 1]),
    "workspace without corner": drop("task", "workspace", "low"),
    "workspace upside down": put("task", "workspace", "low", value=[9.0, 9.0]),
    "corner holds a text": put("task", "workspace", "high", value=["0.2", "0.2"]),
    "reach of three": put("task", "workspace", "reach", value=[0.1, 0.2, 0.3]),
    "options are a list": put("task", "options", value=[1]),
    "not what it says": put("task", "workspace", "dim", value=2),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_description_is_refused(agent: Agent, tmp_path: Path, damage: Callable[[Any], Any]) -> None:
    description = damage(json.loads(json.dumps(describe(agent))))
    file = Archive(agent=description, loss_module=agent.loss).save(tmp_path / "agent.zip")
    with pytest.raises(CheckpointError, match=r"agent\.zip: "):
        load_agent(file)
    with pytest.raises(CheckpointError, match=r"agent\.zip: "):
        check_same_agent(agent, file)
