"""World models: the parts that observe, remember and predict."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from torchrl_ocwm.envs.task import Task
from torchrl_ocwm.modules import FlatWorldModel, ObjectWorldModel, RSSMWorldModel, WorkspaceUnits
from torchrl_ocwm.modules.architecture import Architecture
from torchrl_ocwm.modules.world_model import VectorName
from torchrl_ocwm.objectives import FOCUSModelLoss, WeightedModelLoss
from torchrl_ocwm.parts import Part, register
from torchrl_ocwm.settings import SettingsError, setting


class WorldModelPart(Part, kind="world_model"):
    """How a world model is built, and what trains it."""

    @abstractmethod
    def build(self, task: Task, architecture: Architecture, needs: Mapping[str, Any]) -> RSSMWorldModel:
        """The world model.

        Args:
            task: Shapes and workspace.
            architecture: How large its networks are.
            needs: What goals and rewards ask of it (:attr:`~torchrl_ocwm.agents.goals.Goal.needs`).

        Raises:
            SettingsError: if it cannot give what is needed.
        """

    @abstractmethod
    def loss(self, model: RSSMWorldModel, needs: Mapping[str, Any], *, lambda_dynamic: float) -> WeightedModelLoss:
        """What trains it; ``lambda_dynamic`` is the weight of the KL that trains the prior."""


@dataclass(frozen=True)
class _Observing(WorldModelPart):
    """What all our world models observe, and what it weighs.

    Args:
        observed: Vectors that the world model sees and reconstructs, beside the image.
        predicted: Vectors that it reconstructs without seeing them. An agent acts without them.
        lambda_proprio: Weight of the reconstruction of proprioception.
        lambda_object_position: Weight of the reconstruction of the object positions.
        lambda_goal_position: Weight of the reconstruction of the goal position.
    """

    observed: tuple[VectorName, ...] = ("proprio", "object_position")
    predicted: tuple[VectorName, ...] = ()
    lambda_proprio: float = setting(1.0, at_least=0)
    lambda_object_position: float = setting(200.0, at_least=0)
    lambda_goal_position: float = setting(1.0, at_least=0)

    def validate(self) -> None:
        """Nothing is named twice, and a weight of what is not reconstructed would do nothing."""
        if twice := set(self.observed) & set(self.predicted):
            raise SettingsError(f"{min(twice)!r} is in observed and in predicted; it is reconstructed in either")
        for one in fields(self):
            name = one.name.removeprefix("lambda_")
            if name != one.name and name not in self._decoded and getattr(self, one.name) != one.default:
                raise SettingsError(f"{one.name} does nothing: {name!r} is not in observed={self.observed}")

    @property
    def _decoded(self) -> tuple[VectorName, ...]:
        return (*self.observed, *self.predicted)

    def _arguments(self, task: Task, architecture: Architecture, needs: Mapping[str, Any]) -> dict[str, Any]:
        known = {"reward_head", "positional_encoder" if isinstance(self, ObjectCentric) else "image_latent"}
        if odd := sorted(set(needs) - known):
            raise SettingsError(f"world_model={self._name!r} has no {odd[0]}, which a goal or a reward needs")
        return {
            "image_size": task.image_size,
            "proprio": task.proprio,
            "objects": len(task.objects),
            "action": task.action,
            "units": WorkspaceUnits(task.workspace.low, task.workspace.high),
            "observed": self.observed,
            "predicted": self.predicted,
            "reward_head": "reward_head" in needs,
            "architecture": architecture,
        }

    def _weights(self, lambda_dynamic: float) -> dict[str, Any]:
        names = [f"lambda_{name}" for name in self._decoded]  # the weight of anything else would do nothing
        return {"lambda_dynamic": lambda_dynamic, **{name: getattr(self, name) for name in names}}


@register("flat")
@dataclass(frozen=True)
class Flat(_Observing):
    """One latent state for the whole scene (Dreamer)."""

    def build(self, task: Task, architecture: Architecture, needs: Mapping[str, Any]) -> FlatWorldModel:
        """A world model with one latent, which learns the latents of images alone if a goal needs them."""
        return FlatWorldModel(**self._arguments(task, architecture, needs), image_latent="image_latent" in needs)

    def loss(self, model: RSSMWorldModel, needs: Mapping[str, Any], *, lambda_dynamic: float) -> WeightedModelLoss:
        """What trains it."""
        return WeightedModelLoss(model.records(), **needs.get("image_latent", {}), **self._weights(lambda_dynamic))


@register("object")
@dataclass(frozen=True)
class ObjectCentric(_Observing):
    """A latent for each object and the background too, from which masks, colours and positions are decoded (FOCUS)."""

    def build(self, task: Task, architecture: Architecture, needs: Mapping[str, Any]) -> ObjectWorldModel:
        """A world model with object latents, and a positional encoder if a goal needs one."""
        arguments = self._arguments(task, architecture, needs)
        return ObjectWorldModel(**arguments, positional_encoder="positional_encoder" in needs)

    def loss(self, model: RSSMWorldModel, needs: Mapping[str, Any], *, lambda_dynamic: float) -> FOCUSModelLoss:
        """What trains it."""
        positional: dict[str, Any] = needs.get("positional_encoder", {})
        return FOCUSModelLoss(model.records(), **positional, **self._weights(lambda_dynamic))
