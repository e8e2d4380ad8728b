"""Imagined rewards: what a behaviour is taught in imagination."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.objectives import LossModule

from torchrl_ocwm.agents.goals import GoalEncoding, object_centric
from torchrl_ocwm.agents.scene import Scene
from torchrl_ocwm.modules import LatentSimilarityReward, PositionDistanceReward
from torchrl_ocwm.parts import Part, register
from torchrl_ocwm.settings import SettingsError


class ImaginedReward(NamedTuple):
    """A reward in imagination, and what trains it if it learns.

    Args:
        module: Reads the imagined ``latent`` and writes ``reward`` ``[*batch, 1]``.
        loss: A loss module called with ``records`` ``[B, T]``, what the world model made of the batch, and
            ``imagined`` ``[N, H]``, the behaviour's rollout, both without gradients; gives ``loss_*`` entries.
        lr: Learning rate of the loss's parameters; ``None``: that of the world model.
    """

    module: TensorDictModuleBase
    loss: LossModule | None = None
    lr: float | None = None


class Reward(Part, kind="reward"):
    """How an imagined state is judged."""

    @property
    def needs(self) -> Mapping[str, Any]:
        """What it asks of the world model."""
        return {}

    @abstractmethod
    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The reward for one object of a scene.

        Args:
            scene: World model and object.
            goal: How goals are encoded, ``None`` for a behaviour that sees none.
        """


@register("head")
@dataclass(frozen=True)
class LearnedReward(Reward):
    """What the world model's reward head predicts: it learns the rewards of the records."""

    @property
    def needs(self) -> Mapping[str, Any]:
        """The head."""
        return {"reward_head": True}

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The head's prediction."""
        return ImaginedReward(scene.model.reward())


@register("position_distance")
@dataclass(frozen=True)
class PositionDistance(Reward):
    """Minus the distance in metres between the decoded position of the object and the goal (paper, equation 3)."""

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The distance, from the decoded positions."""
        distance = PositionDistanceReward(scene.model.units, object_index=scene.object_index)
        return ImaginedReward(TensorDictSequential(scene.model.object_position(), distance))


@register("latent_similarity")
@dataclass(frozen=True)
class LatentSimilarity(Reward):
    """Similarity of the object's latent and the goal latent (paper, r_LCP).

    Args:
        distance: The cosine similarity, or minus the mean squared error.
    """

    distance: Literal["cosine", "mse"] = "cosine"

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The similarity, from the extracted latents."""
        if self.distance == "mse" and goal is not None and goal.directions:
            raise SettingsError("distance='mse' compares lengths, which these goals do not have: give them it too")
        return _on_object_latent(scene, self.distance)


@register("latent_chord")
@dataclass(frozen=True)
class LatentChord(Reward):
    """Minus the distance between the directions of the two latents, which keeps its slope up to the goal."""

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The chord, from the extracted latents."""
        return _on_object_latent(scene, "chord")


def _on_object_latent(scene: Scene, distance: Literal["cosine", "mse", "chord"]) -> ImaginedReward:
    index = scene.object_index
    latents = object_centric(scene.model).object_latent(index + 1)
    return ImaginedReward(TensorDictSequential(latents, LatentSimilarityReward(object_index=index, distance=distance)))
