"""Agents on disk, in TorchRL's checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import CheckpointError

from torchrl_ocwm import __version__
from torchrl_ocwm.agents.agent import Agent, Policy
from torchrl_ocwm.agents.archive import Archive, read_manifest
from torchrl_ocwm.agents.config import AgentConfig, Size
from torchrl_ocwm.agents.sources import agent_file
from torchrl_ocwm.agents.weights import AgentWeights
from torchrl_ocwm.data.policies import POLICIES
from torchrl_ocwm.data.settings import Collection
from torchrl_ocwm.devices import usable_device
from torchrl_ocwm.envs.registry import make_task
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.parts import VARIABLE, absent, foreign
from torchrl_ocwm.settings import Settings, SettingsError, differences, from_dict, to_dict


def save_agent(agent: Agent, path: str | Path) -> Path:
    """Save what an agent has learnt, without the state of an optimiser; :func:`load_agent` reads it.

    For agents that were trained in a loop of your own, and for trained agents to keep or to share: the names in the
    file (:class:`~torchrl_ocwm.agents.AgentWeights`) outlast changes of this library, those in the checkpoint of a run
    need not.

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
        >>> policy.agent.config == agent.config
        True
    """
    return Archive(agent=describe(agent), weights=AgentWeights(agent)).save(path)


def load_agent(path: str | Path, *, behaviour: str | None = None, device: torch.device | str = "cpu") -> Policy:
    """Load a trained agent's policy from a checkpoint; no dataset and no simulator is needed.

    Args:
        path: A file that training or :func:`save_agent` wrote, a folder with one, the name of a trained agent that
            comes with this package (``"reacher/focus_lcp"``, :func:`shipped_agents`), or ``"hf://owner/name"``.
        behaviour: Which of the agent's behaviours acts; ``None``: that which acts unless another is asked for.
        device: Where to put it.

    Returns:
        The policy (:meth:`Agent.policy`), a module that runs in any TorchRL rollout of the agent's task. Its
        ``agent`` attribute is the whole agent.

    Raises:
        CheckpointError: if there is no checkpoint, a damaged one, or not one of an agent of this library.
        DeviceError: if there is no such device.
        ValueError: if there is no such behaviour.
        MissingPackageError: for ``hf://`` without ``huggingface_hub``.
    """
    path, device = agent_file(path), usable_device(device)
    agent = rebuild(read_description(path))
    lasting = "weights" in Archive.manifest(path)["components"]  # which was checked with the description
    kept: dict[str, Any] = {"weights": AgentWeights(agent)} if lasting else {"loss_module": agent.loss}
    Archive(any_version=lasting, **kept).load(path, map_location="cpu")
    agent.to(device).eval().requires_grad_(False)
    return agent.policy(behaviour)


def collecting_policy(
    settings: Collection, environment: str, options: Mapping[str, Any] | None = None
) -> Policy | None:
    """The policy that collects, where its settings name the checkpoint of an agent; ``None`` for a policy by name.

    Args:
        settings: The collection's, with the checkpoint under ``policy``.
        environment: Name of the environment that it collects in.
        options: Passed to the environment.

    Raises:
        SettingsError: if there is no such file, it is of another task's agent, or the agent lacks the behaviour.
        CheckpointError: for a file that is no checkpoint of an agent.
    """
    if settings.policy in POLICIES:
        return None
    try:
        agent_file(settings.policy)
    except CheckpointError as error:
        raise SettingsError(f"policy must be {', '.join(POLICIES)} or a trained agent ({error})") from error
    policy, task = load_agent(settings.policy, behaviour=settings.behaviour), make_task(environment, **(options or {}))
    if policy.agent.task != task:
        raise SettingsError(
            f"policy={settings.policy}: the agent was trained for another task "
            f"({differences(policy.agent.task, task, 'there', 'here')})"
        )
    return policy


@dataclass(frozen=True)
class Description(Settings):
    """What it takes to build an agent again.

    Args:
        agent: World model and behaviours.
        size: How large it is, and how it learns.
        task: What it is for.
        release: The release of this library that wrote it.
        plugins: The parts of other packages in it, and the packages, to say what is missing.
    """

    agent: AgentConfig
    size: Size
    task: Task
    release: str
    plugins: Mapping[str, str] = field(default_factory=dict)


def describe(agent: Agent) -> dict[str, Any]:
    """What it takes to build an agent again; fits in JSON.

    Raises:
        SettingsError: for a part that is not registered, and could not be built again.
    """
    plugins = {**foreign(agent.config), **foreign(agent.size)}
    return to_dict(Description(agent.config, agent.size, agent.task, __version__, plugins))


def rebuild(description: Any) -> Agent:
    """An agent with fresh weights from what :func:`describe` gave; only registered parts are ever built.

    Raises:
        CheckpointError: if the description lacks something, or holds what an agent cannot have.
    """
    parts = read_parts(description)
    try:
        return Agent(parts.task, parts.agent, parts.size)
    except ValueError as error:
        raise CheckpointError(f"the checkpoint describes an agent that cannot be built: {error}") from error


def read_parts(description: Any) -> Description:
    """What :func:`describe` gave, checked whole.

    Raises:
        CheckpointError: if the description lacks something, or holds what an agent cannot have.
    """
    release = description.get("release", "0.1") if isinstance(description, dict) else "0.1"
    try:
        return from_dict(Description, description)
    except SettingsError as error:
        if missing := absent(description.get("plugins") if isinstance(description, dict) else None):
            raise CheckpointError(
                f"the agent has parts that are not registered here: {', '.join(missing)}; install what registers them, "
                f"or name it in {VARIABLE}"
            ) from error
        if release == __version__:
            raise CheckpointError(f"the checkpoint is damaged: {error}") from error
        raise CheckpointError(
            f"the checkpoint is of release {release!r}, this is {__version__}: train again, or use that one ({error})"
        ) from error


def read_description(path: Path) -> dict[str, Any]:
    """The description of the agent in a checkpoint, after all of the file has been checked against its checksums.

    Raises:
        CheckpointError: if there is no checkpoint, a damaged one, or not one of an agent of this library.
    """
    components = read_manifest(path)["components"]
    if "agent" not in components or not {"loss_module", "weights"} & set(components):
        raise CheckpointError(
            f"{path}: a TorchRL checkpoint, but not of an agent of torchrl_ocwm ({sorted(components)})"
        )
    description = Archive(any_version=True, agent={}).load(path).values.get("agent")
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
    there, here = read_parts(read_description(path)), read_parts(describe(agent))
    if different := differences(replace(there, release=here.release), here, "there", "here"):
        raise CheckpointError(f"{path}: a checkpoint of another agent ({different})")
