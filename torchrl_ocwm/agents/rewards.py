"""Imagined rewards: what a behaviour is taught in imagination."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torchrl.objectives import LossModule

from torchrl_ocwm.agents.goals import GoalEncoding, object_centric
from torchrl_ocwm.agents.scene import Scene
from torchrl_ocwm.modules import (
    FullLatentReward,
    LatentSimilarityReward,
    MovingCentre,
    PositionDistanceReward,
    TemporalDistanceReward,
)
from torchrl_ocwm.modules import TemporalDistance as DistanceNetwork
from torchrl_ocwm.modules.networks import make_mlp
from torchrl_ocwm.modules.rewards import DistanceUnit
from torchrl_ocwm.objectives import TemporalDistanceLoss
from torchrl_ocwm.parts import Part, register
from torchrl_ocwm.settings import SettingsError, setting


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
    """Minus the distance between the decoded position of the object and the goal (paper, equation 3).

    Args:
        unit: Metres, or half-widths of the workspace: rewards of order one, for which a two-hot critic has finer bins.
    """

    unit: DistanceUnit = "metre"

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The distance, from the decoded positions."""
        units = scene.model.units
        distance = PositionDistanceReward(units, object_index=scene.object_index, unit=self.unit)
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
    """Minus the distance between the directions of the two latents, which keeps its slope up to the goal.

    Args:
        centred: Whether what the directions of imagined latents have in common is taken from both first. Latents that
            are alike wherever the object is then differ as much as others.
    """

    centred: bool = False

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The chord, from the extracted latents."""
        centre = MovingCentre(scene.architecture.object_features) if self.centred else None
        return _on_object_latent(scene, "chord", centre)


@register("full_latent_cosine")
@dataclass(frozen=True)
class FullLatentCosine(Reward):
    """Cosine similarity of the latent of the whole scene and the goal latent (LEXA cosine)."""

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The similarity."""
        if goal is not None and goal.features != scene.model.latent_features:
            raise SettingsError("reward='full_latent_cosine' compares whole latents: it needs goal='full_latent'")
        return ImaginedReward(FullLatentReward())


@register("temporal_distance")
@dataclass(frozen=True)
class TemporalDistance(Reward):
    """Minus the learnt number of steps from the state to the goal, as a share of the horizon (LEXA temporal).

    A head learns to predict, from the latent of a frame, the goal that this frame would be. A network learns, from the
    head's predictions along the behaviour's own imagined rollouts, how many steps apart two of them are. The defaults
    are those of the paper; LEXA's release has 4 layers of 128 units with batch normalisation.

    Args:
        layers: Hidden layers of the network.
        units: Units of each.
        batch_norm: Whether they are normalised over the batch.
        positives: Pairs of points of one rollout that the network learns from, per update.
        negatives: Pairs of points of different sequences, which count as a whole horizon apart, as a share of these.
        lr: Learning rate of head and network; ``None``: that of the world model.
    """

    layers: int = setting(4, at_least=1)
    units: int = setting(400, at_least=1)
    batch_norm: bool = False
    positives: int = setting(256, at_least=1)
    negatives: float = setting(0.1, at_least=0)
    lr: float | None = setting(None, at_least=0)

    def build(self, scene: Scene, goal: GoalEncoding | None) -> ImaginedReward:
        """The distance, and the loss that teaches it."""
        if goal is None:
            raise SettingsError("reward='temporal_distance' is a distance to a goal; give the behaviour one")
        head = make_mlp(in_features=scene.model.latent_features, out_features=goal.features, **scene.architecture.mlp)
        network = DistanceNetwork(goal.features, layers=self.layers, units=self.units, batch_norm=self.batch_norm)
        loss = TemporalDistanceLoss(head, network, goal.frame, positives=self.positives, negatives=self.negatives)
        predict = TensorDictModule(head, [("latent", "state"), ("latent", "belief")], ["embedding"])
        return ImaginedReward(TensorDictSequential(predict, TemporalDistanceReward(network)), loss, self.lr)


def _on_object_latent(
    scene: Scene, distance: Literal["cosine", "mse", "chord"], centre: MovingCentre | None = None
) -> ImaginedReward:
    index = scene.object_index
    latents = object_centric(scene.model).object_latent(index + 1)
    reward = LatentSimilarityReward(object_index=index, distance=distance, centre=centre)
    return ImaginedReward(TensorDictSequential(latents, reward))
