"""What an agent must know of a task to be built, without the simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from torchrl_ocwm.envs.workspace import Workspace
from torchrl_ocwm.images import ImageSize, image_shape
from torchrl_ocwm.settings import Settings, SettingsError, from_dict, to_dict

#: Metres within which an entity counts as at its goal (paper, figure "reconstructions").
SUCCESS_DISTANCE = 0.05


@dataclass(frozen=True)
class ActionRange(Settings):
    """What an action's range of −1 to 1 means to a robot, in its own units, such as joint targets in radians.

    Args:
        low: What −1 means, one value per action.
        high: What 1 means.

    Raises:
        SettingsError: if ``low`` is not below ``high`` for every action.

    Examples:
        >>> import torch
        >>> joints = ActionRange(low=(0.0, -2.0), high=(4.0, 2.0))
        >>> joints.normalise(torch.tensor([1.0, 2.0]))
        tensor([-0.5000,  1.0000])
        >>> joints.to_robot(torch.tensor([-0.5, 1.0]))
        tensor([1., 2.])
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def validate(self) -> None:
        """Lower ends are lower."""
        if not 0 < len(self.low) == len(self.high) or not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise SettingsError(f"low must be below high for every action, got {self.low} and {self.high}")

    def normalise(self, action: Tensor) -> Tensor:
        """Actions ``[..., A]`` in the robot's units to −1 to 1; what is beyond the range goes beyond ±1."""
        low, high = action.new_tensor(self.low), action.new_tensor(self.high)
        return 2 * (action - low) / (high - low) - 1

    def to_robot(self, action: Tensor) -> Tensor:
        """Actions ``[..., A]`` of −1 to 1 to the robot's units."""
        low, high = action.new_tensor(self.low), action.new_tensor(self.high)
        return low + (high - low) * (action + 1) / 2


@dataclass(frozen=True)
class Task(Settings):
    """Shapes and workspace of a task. Datasets and checkpoints carry it.

    Args:
        name: Short name of the environment.
        image_size: Height and width of the images, pixels: one number, or two if they differ. Two cameras are one
            image, side by side.
        objects: Names of the objects; the first is the one to position.
        proprio: Number of proprioceptive values P.
        action: Number of actions A: values of an action, or actions to choose from.
        workspace: Where goals are.
        options: What else :func:`~torchrl_ocwm.envs.make_env` needs to make the environment again, beside the horizon.
        action_range: What −1 and 1 mean to the robot, where actions are recorded in units of its own.
        discrete: Whether an action is one of A, as a vector that is 1 there and 0 elsewhere.

    Examples:
        >>> task = Task("reacher", 64, ("finger",), 5, 2, Workspace(low=(-0.24, -0.24), high=(0.24, 0.24)))
        >>> Task.from_dict(task.to_dict()) == task
        True
    """

    name: str
    image_size: ImageSize
    objects: tuple[str, ...]
    proprio: int
    action: int
    workspace: Workspace
    options: Mapping[str, Any] = field(default_factory=dict)
    action_range: ActionRange | None = None
    discrete: bool = False

    def validate(self) -> None:
        """There is something to position, and objects have names of their own."""
        for name, least in (("image_size", 1), ("proprio", 0), ("action", 1)):
            value = getattr(self, name)
            if min(value if isinstance(value, tuple) else (value,)) < least:
                raise SettingsError(f"{name} must be at least {least}, got {value}")
        if self.discrete and self.action_range is not None:
            raise SettingsError("action_range does nothing: discrete actions have no range")
        if self.action_range is not None and len(self.action_range.low) != self.action:
            raise SettingsError(f"action_range must have {self.action} values, got {len(self.action_range.low)}")
        if not self.objects or len(set(self.objects)) != len(self.objects):
            raise SettingsError(f"objects must be one name or several different ones, got {self.objects}")

    @property
    def image_shape(self) -> tuple[int, int]:
        """Height and width of the images, pixels."""
        return image_shape(self.image_size)

    def to_robot(self, action: Tensor) -> Tensor:
        """Actions ``[..., A]`` of an agent as the robot takes them: in its units, or the number ``[...]`` of a choice.

        Examples:
            >>> import torch
            >>> box = Workspace(low=(0.0, 0.0), high=(0.3, 0.3))
            >>> joints = ActionRange(low=(0.0, -2.0), high=(4.0, 2.0))
            >>> Task("arm", 64, ("cube",), 6, 2, box, action_range=joints).to_robot(torch.tensor([-0.5, 1.0]))
            tensor([1., 2.])
            >>> Task("arm", 64, ("cube",), 6, 3, box, discrete=True).to_robot(torch.tensor([0.0, 0.0, 1.0]))
            tensor(2)
        """
        if self.discrete:
            return action.argmax(-1)
        return action if self.action_range is None else self.action_range.to_robot(action)

    def to_dict(self) -> dict[str, Any]:
        """A mapping that fits in JSON."""
        return to_dict(self)

    @classmethod
    def from_dict(cls, values: Any) -> Task:
        """Read what :meth:`to_dict` wrote, also after a trip through JSON.

        Raises:
            SettingsError: for what no task can be, with its name.
        """
        return from_dict(cls, values, "task")
