"""What an agent must know of a task to be built, without the simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from torchrl_ocwm.envs.workspace import Workspace
from torchrl_ocwm.settings import Settings, SettingsError, from_dict, to_dict

#: Metres within which an entity counts as at its goal (paper, figure "reconstructions").
SUCCESS_DISTANCE = 0.05


@dataclass(frozen=True)
class Task(Settings):
    """Shapes and workspace of a task. Datasets and checkpoints carry it.

    Args:
        name: Short name of the environment.
        image_size: Height and width of the images, pixels.
        objects: Names of the objects; the first is the one to position.
        proprio: Number of proprioceptive values P.
        action: Number of actions A.
        workspace: Where goals are.
        options: What else :func:`~torchrl_ocwm.envs.make_env` needs to make the environment again, beside the horizon.

    Examples:
        >>> task = Task("reacher", 64, ("finger",), 5, 2, Workspace(low=(-0.24, -0.24), high=(0.24, 0.24)))
        >>> Task.from_dict(task.to_dict()) == task
        True
    """

    name: str
    image_size: int
    objects: tuple[str, ...]
    proprio: int
    action: int
    workspace: Workspace
    options: Mapping[str, Any] = field(default_factory=dict)

    def validate(self) -> None:
        """There is something to position, and objects have names of their own."""
        for name, least in (("image_size", 1), ("proprio", 0), ("action", 1)):
            if getattr(self, name) < least:
                raise SettingsError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if not self.objects or len(set(self.objects)) != len(self.objects):
            raise SettingsError(f"objects must be one name or several different ones, got {self.objects}")

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
