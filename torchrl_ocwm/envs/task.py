"""What an agent must know of a task to be built, without the simulator."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from torchrl_ocwm.envs.workspace import Workspace

#: Metres within which an entity counts as at its goal (paper, figure "reconstructions").
SUCCESS_DISTANCE = 0.05


@dataclass(frozen=True)
class Task:
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
    options: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """A mapping that fits in JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Task:
        """Read what :meth:`to_dict` wrote, also after a trip through JSON."""
        workspace: dict[str, Any] = {
            name: value if value is None else tuple(tuple(v) if isinstance(v, list) else v for v in value)
            for name, value in values["workspace"].items()
        }
        return cls(**{**values, "objects": tuple(values["objects"]), "workspace": Workspace(**workspace)})
