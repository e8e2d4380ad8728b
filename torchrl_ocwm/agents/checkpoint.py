"""Agents on disk, in TorchRL's checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, CheckpointError

from torchrl_ocwm.agents.agent import Agent, Policy
from torchrl_ocwm.agents.config import AgentConfig, Size
from torchrl_ocwm.agents.presets import flat
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.settings import from_dict, to_dict


def describe(agent: Agent) -> dict[str, Any]:
    """What it takes to build an agent again; fits in JSON."""
    return {"agent": to_dict(agent.config), "size": to_dict(agent.size), "task": to_dict(agent.task)}


def rebuild(description: dict[str, Any]) -> Agent:
    """An agent with fresh weights from what :func:`describe` gave; only registered parts are ever built.

    Raises:
        SettingsError: if a part or a setting is unknown here.
    """
    config = from_dict(AgentConfig, description["agent"], "agent")
    size = from_dict(Size, description["size"], "size")
    return Agent(Task.from_dict(description["task"]), config, size)


def load_agent(path: str | Path, *, device: torch.device | str = "cpu") -> Policy:
    """Load a trained agent's policy from a checkpoint; no dataset and no simulator is needed.

    Args:
        path: A checkpoint that training wrote.
        device: Where to put it.

    Returns:
        The policy (:meth:`Agent.policy`), a module that runs in any TorchRL rollout of the agent's task. Its
        ``agent`` attribute is the whole agent.

    Raises:
        CheckpointError: if there is no checkpoint, or not one of an agent of this library.
    """
    path = Path(path)
    agent = rebuild(read_description(path))
    Checkpoint(loss_module=agent.loss).load(path, map_location=device)
    agent.to(device).eval().requires_grad_(False)
    return agent.policy()


def read_description(path: Path) -> dict[str, Any]:
    """The description of the agent in a checkpoint.

    Raises:
        CheckpointError: if there is no checkpoint, or not one of an agent of this library.
    """
    if not path.exists():
        raise CheckpointError(f"{path}: no such checkpoint")
    try:
        components = Checkpoint.manifest(path)["components"]
    except Exception as error:  # whatever a file that is no checkpoint makes a zip or JSON reader raise
        raise CheckpointError(f"{path}: not a checkpoint of TorchRL ({error})") from error
    if not {"agent", "loss_module"} <= set(components):
        raise CheckpointError(
            f"{path}: a TorchRL checkpoint, but not of an agent of torchrl_ocwm ({sorted(components)})"
        )
    return Checkpoint(agent={}).load(path).values["agent"]


def check_same_agent(agent: Agent, path: Path) -> None:
    """Raise unless a checkpoint is of an agent like this one.

    Raises:
        CheckpointError: with what differs.
    """
    there, here = flat(read_description(path)), flat(describe(agent))
    differences = [
        f"{name}: {there.get(name)} there, {here.get(name)} here"
        for name in dict.fromkeys([*here, *there])
        if there.get(name) != here.get(name)
    ]
    if differences:
        raise CheckpointError(f"{path}: a checkpoint of another agent ({'; '.join(differences)})")
