"""Devices by name."""

from __future__ import annotations

import torch

from torchrl_ocwm.errors import UserError


class DeviceError(UserError, ValueError):
    """There is no such device here; the message says why."""


def usable_device(name: torch.device | str) -> torch.device:
    """A device, after it has been tried.

    Raises:
        DeviceError: if there is no such device here.

    Examples:
        >>> usable_device("cpu")
        device(type='cpu')
        >>> usable_device("gpu")
        Traceback (most recent call last):
        torchrl_ocwm.devices.DeviceError: device 'gpu' cannot be used (Expected one of ...); device 'cpu' always can
    """
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (AssertionError, RuntimeError, TypeError) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        raise DeviceError(f"device {str(name)!r} cannot be used ({reason}); device 'cpu' always can") from error
    return device
