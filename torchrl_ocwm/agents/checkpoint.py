"""Agents on disk, in TorchRL's checkpoints."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import torch
from torchrl.checkpoint import CheckpointError

from torchrl_ocwm.agents.agent import Agent, Policy
from torchrl_ocwm.agents.archive import Archive, read_manifest
from torchrl_ocwm.agents.config import AgentConfig, Size
from torchrl_ocwm.devices import usable_device
from torchrl_ocwm.envs.task import Task


def save_agent(agent: Agent, path: str | Path) -> Path:
    """Save an agent that was trained in a loop of your own; :func:`load_agent` reads it.

    Args:
        agent: The agent.
        path: File to write, or to replace when the new one is whole.

    Returns:
        The file.

    Raises:
        CheckpointError: if it cannot be written.

    Examples:
        >>> import tempfile
        >>> from torchrl_ocwm.agents import build_agent
        >>> from torchrl_ocwm.testing import reacher_task
        >>> agent = build_agent("dreamer_pcp", reacher_task(), size="debug")
        >>> policy = load_agent(save_agent(agent, tempfile.mkdtemp() + "/agent.zip"))
        >>> policy.agent.config.reward
        'position_distance'
    """
    return Archive(agent=describe(agent), loss_module=agent.loss).save(path)


def load_agent(path: str | Path, *, device: torch.device | str = "cpu") -> Policy:
    """Load a trained agent's policy from a checkpoint; no dataset and no simulator is needed.

    Args:
        path: A checkpoint that training or :func:`save_agent` wrote.
        device: Where to put it.

    Returns:
        The policy (:meth:`Agent.policy`), a module that runs in any TorchRL rollout of the agent's task. Its
        ``agent`` attribute is the whole agent.

    Raises:
        CheckpointError: if there is no checkpoint, a damaged one, or not one of an agent of this library.
        ValueError: if there is no such device.
    """
    path, device = Path(path), usable_device(device)
    agent = rebuild(read_description(path))
    Archive(loss_module=agent.loss).load(path, map_location="cpu")
    agent.to(device).eval().requires_grad_(False)
    return agent.policy()


def describe(agent: Agent) -> dict[str, Any]:
    """What it takes to build an agent again; fits in JSON."""
    return {"agent": asdict(agent.config), "size": asdict(agent.size), "task": agent.task.to_dict()}


def rebuild(description: Any) -> Agent:
    """An agent with fresh weights from what :func:`describe` gave.

    Raises:
        CheckpointError: if the description lacks something, or holds what an agent cannot have.
    """
    parts = read_parts(description)
    try:
        return Agent(parts.task, parts.agent, parts.size)
    except ValueError as error:
        raise CheckpointError(f"the checkpoint describes an agent that cannot be built: {error}") from error


class Parts(NamedTuple):
    """What an agent is built from."""

    agent: AgentConfig
    size: Size
    task: Task


def read_parts(description: Any) -> Parts:
    """What :func:`describe` gave, checked whole.

    Raises:
        CheckpointError: if the description lacks something, or holds what an agent cannot have.
    """
    if not isinstance(description, Mapping) or set(description) != set(Parts._fields):
        raise CheckpointError(f"the checkpoint does not describe an agent by {', '.join(Parts._fields)}")
    return Parts(
        _read(AgentConfig, description["agent"], "agent"),
        _read(Size, description["size"], "size"),
        _read(Task, description["task"], "task"),
    )


def read_description(path: Path) -> dict[str, Any]:
    """The description of the agent in a checkpoint, after all of the file has been checked against its checksums.

    Raises:
        CheckpointError: if there is no checkpoint, a damaged one, or not one of an agent of this library.
    """
    components = read_manifest(path)["components"]
    if not {"agent", "loss_module"} <= set(components):
        raise CheckpointError(
            f"{path}: a TorchRL checkpoint, but not of an agent of torchrl_ocwm ({sorted(components)})"
        )
    description = Archive(agent={}).load(path).values.get("agent")
    try:
        with torch.device("meta"):  # shapes without memory
            needed = sum(value.numel() * value.itemsize for value in rebuild(description).loss.parameters())
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    if needed > path.stat().st_size:
        raise CheckpointError(f"{path}: describes an agent of {needed} bytes, which cannot be in it; it is damaged")
    return description


def check_same_agent(agent: Agent, path: Path) -> None:
    """Raise unless a checkpoint is of an agent like this one.

    Raises:
        CheckpointError: with what differs.
    """
    there, here = _plain(read_parts(read_description(path))), _plain(Parts(agent.config, agent.size, agent.task))
    differences = [
        f"{part}.{key}: {there[part][key]} there, {value} here"
        for part, values in here.items()
        for key, value in values.items()
        if there[part][key] != value
    ]
    if differences:
        raise CheckpointError(f"{path}: a checkpoint of another agent ({'; '.join(differences)})")


def _plain(parts: Parts) -> dict[str, dict[str, Any]]:
    """Parts as JSON has them, which knows no tuples."""
    return json.loads(json.dumps({name: asdict(part) for name, part in parts._asdict().items()}))


def _read(hint: Any, value: Any, at: str) -> Any:
    """A value of a file as its type; lists become tuples and mappings dataclasses."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if is_dataclass(hint):
        return _read_dataclass(hint, value, at)
    if origin in (Union, UnionType):
        (kind,) = set(arguments) - {NoneType}
        return None if value is None else _read(kind, value, at)
    if origin is tuple and isinstance(value, (list, tuple)):
        kinds = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else arguments
        if len(kinds) == len(value):
            return tuple(_read(kind, one, at) for kind, one in zip(kinds, value, strict=True))
    if origin is Literal:
        fits = value in arguments if isinstance(value, str) else False
    elif hint is float:
        fits = type(value) in (int, float) and abs(value) < float("inf")
    else:
        fits = type(value) is (origin or hint) and origin is not tuple
    if not fits:
        raise CheckpointError(f"the checkpoint is damaged: {at} must be {hint}, got {value!r}")
    return value


def _read_dataclass(kind: Any, values: Any, at: str) -> Any:
    if not isinstance(values, Mapping):
        raise CheckpointError(f"the checkpoint is damaged: {at} must be a mapping, got {values!r}")
    known = {field.name: field for field in fields(kind)}
    # A setting that a later release adds has the default that was the rule before.
    needed = {name for name, field in known.items() if field.default is field.default_factory is MISSING}
    odd = sorted((set(values) - set(known)) | (needed - set(values)))
    if odd:
        raise CheckpointError(f"the checkpoint is of another release: {kind.__name__} differs in {odd}")
    hints = get_type_hints(kind)
    try:
        return kind(**{name: _read(hints[name], value, f"{at}.{name}") for name, value in values.items()})
    except ValueError as error:
        raise CheckpointError(f"the checkpoint is damaged: {at}: {error}") from error
