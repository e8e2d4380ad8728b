"""Which commit a run is of, and which machine does it."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

import torch

#: Beside the settings of a run.
MADE = "made.json"


def machine(device: str = "cpu") -> str:
    """Where this runs, in words.

    Args:
        device: What computes: a GPU is named too.

    Examples:
        >>> "cores" in machine()
        True
    """
    gpu = device.startswith("cuda") and torch.cuda.is_available()
    return f"{_processor()}, {os.cpu_count()} cores" + (f", {torch.cuda.get_device_name(device)}" if gpu else "")


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # not Linux
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def commit() -> str:
    """The commit of the checkout that this package is in, with a plus if it has been changed; else its release."""
    checkout = Path(__file__).parents[1]
    try:
        if not (checkout / ".git").exists():  # an installed one may lie in a checkout of something else
            return version("torchrl-ocwm")
        git = ["git", "-C", str(checkout), "describe", "--always", "--abbrev=8", "--exclude=*", "--dirty=+"]
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return version("torchrl-ocwm")
