"""Whether an update fits into memory, before anything is built."""

from __future__ import annotations

import os
import sys
from math import prod

import torch

from torchrl_ocwm.agents import AgentConfig, Size, build_agent
from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.settings import SettingsError

_BYTES = 4  # of a float32
_COPIES = 4  # a parameter, its gradient and two moments of the optimiser


def check_memory(agent: AgentConfig, task: Task, size: Size, device: torch.device) -> None:
    """Refuse a size whose update cannot fit, by a lower bound on what it needs.

    Args:
        agent: The row of choices.
        task: What it is for.
        size: Its size.
        device: Where it would be trained.

    Raises:
        SettingsError: with the memory that it would need, and what there is.

    Examples:
        >>> from torchrl_ocwm.agents import AGENTS, SIZES
        >>> from torchrl_ocwm.testing import reacher_task
        >>> check_memory(AGENTS["dreamer_pcp"], reacher_task(), SIZES["debug"], torch.device("cpu"))
    """
    with torch.device("meta"):  # shapes without memory
        model = build_agent(agent, task, size)
    learning, architecture = size.learning, size.architecture
    frames = learning.batch_size * learning.slice_len
    hidden = architecture.mlp_layers * architecture.mlp_units
    needs = {
        "parameters": _COPIES * sum(parameter.numel() for parameter in model.parameters()),
        # As seen, as predicted, and its gradient.
        "batch_size x slice_len frames": 3 * frames * 3 * prod(task.image_shape),
        "imagination_horizon steps from each frame": frames
        * learning.imagination_horizon
        * (model.model.latent_features + 2 * hidden),
    }
    there, needed = memory(device), _BYTES * sum(needs.values())
    if needed > there:
        largest = max(needs, key=lambda name: needs[name])
        raise SettingsError(
            f"size does not fit: an update needs {needed / 2**30:.1f} GiB at least, most of it for its {largest}, "
            f"and {device} has {there / 2**30:.1f} GiB"
        )


def memory(device: torch.device) -> int:
    """Bytes of memory that a device has in all."""
    if device.type == "cuda":
        return torch.cuda.get_device_properties(device).total_memory
    if hasattr(os, "sysconf"):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return sys.maxsize
