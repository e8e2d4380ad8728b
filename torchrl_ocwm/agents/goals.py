"""Goals: what policy and critic see of them, beside the latent state."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn

from torchrl_ocwm.agents.scene import Scene
from torchrl_ocwm.modules import (
    FlatWorldModel,
    LatentPositionalEncoder,
    ObjectWorldModel,
    ObservationEncoder,
    UnitRMS,
)
from torchrl_ocwm.modules.goals import GOAL
from torchrl_ocwm.parts import Part, register
from torchrl_ocwm.settings import SettingsError, setting


class GoalEncoding(NamedTuple):
    """What a goal is for policy and critic, and how it is made of what there is.

    Args:
        features: How many numbers it is.
        position: Encodes positions ``[..., D]`` in workspace units, if it can be done.
        image: Encodes images ``[..., F, 3, H, W]`` uint8, if it can be done.
        frame: Writes ``("latent", "goal")``, the goal that a frame of the records is.
        directions: Whether only its direction means something; its length is then the same for all goals.
        object_index: Which object has to be seen in a frame that is a goal; ``None``: every frame is one.
    """

    features: int
    position: nn.Module | None
    image: nn.Module | None
    frame: TensorDictModuleBase
    directions: bool = False
    object_index: int | None = None


class Goal(Part, kind="goal"):
    """How a goal becomes what policy and critic see."""

    @property
    def needs(self) -> Mapping[str, Any]:
        """What it asks of the world model."""
        return {}

    @abstractmethod
    def build(self, scene: Scene) -> GoalEncoding | None:
        """The encoding, or nothing if policy and critic see no goal."""


@register("none")
@dataclass(frozen=True)
class NoGoal(Goal):
    """Actor and critic see the latent state only; the world model has to remember the goal that it observed."""

    def build(self, scene: Scene) -> None:
        """Nothing."""


@register("position")
@dataclass(frozen=True)
class Position(Goal):
    """Actor and critic also see the goal position, in workspace units (paper, section PCP)."""

    def build(self, scene: Scene) -> GoalEncoding:
        """The position as it is."""
        dim = scene.model.units.dim
        select = nn.Sequential(nn.Unflatten(-1, (-1, dim)), SelectObject(scene.object_index))
        frame = TensorDictModule(select, ["object_units"], [GOAL])
        return GoalEncoding(dim, nn.Identity(), None, frame, object_index=scene.object_index)


@register("object_latent")
@dataclass(frozen=True)
class ObjectLatent(Goal):
    """Actor and critic also see the latent that the object would have at the goal (paper, section LCP).

    Positions and images are encoded by different networks, which are trained to agree in direction only. All goals are
    brought to one length here, so that an actor trained on the one kind knows the other. With ``distance="mse"``
    training compares lengths too, so that they stay as they are.

    Args:
        weight: Weight of the loss of the latent positional encoder, which learns that latent.
        distance: How far apart two latents are in that loss: minus the cosine similarity, or the mean squared error.
        gradient: What that loss trains: the encoder, the object latents that it aims at, or both.
        final_weight: Weight in the end, which the weight moves to by the same factor at each update; none: it stays.
        annealing_updates: After how many updates it is that.
    """

    weight: float = setting(1.0, at_least=0)
    distance: Literal["cosine", "mse"] = "cosine"
    gradient: Literal["encoder", "latent", "both"] = "both"
    final_weight: float | None = setting(None, above=0)
    annealing_updates: int = setting(1000, at_least=1)

    def validate(self) -> None:
        """A weight of 0 cannot move by factors, and one that stays needs no updates."""
        if self.final_weight is not None and self.weight == 0:
            raise SettingsError("final_weight needs a weight above 0 to start from")
        if self.final_weight is None and self.annealing_updates != ObjectLatent.annealing_updates:
            raise SettingsError("annealing_updates does nothing without a final_weight")

    @property
    def needs(self) -> Mapping[str, Any]:
        """A positional encoder, and how it is trained."""
        loss: dict[str, Any] = {
            "lambda_positional": self.weight,
            "positional_distance": self.distance,
            "positional_gradient": self.gradient,
        }
        if self.final_weight is not None:
            loss["positional_annealing"] = (self.final_weight, self.annealing_updates)
        return {"positional_encoder": loss}

    def build(self, scene: Scene) -> GoalEncoding:
        """The latent at a position, in images or in a frame."""
        model, index, directions = object_centric(scene.model), scene.object_index, self.distance == "cosine"
        assert model.positional_encoder is not None
        length = UnitRMS() if directions else nn.Identity()
        position = nn.Sequential(_LatentAtGoal(model.positional_encoder, index), length)
        image = nn.Sequential(model.latents_in_images(), SelectObject(index), length)
        frame = TensorDictModule(nn.Sequential(SelectObject(index), length), ["image_latent"], [GOAL])
        return GoalEncoding(model.positional_encoder.features, position, image, frame, directions, index)


@register("full_latent")
@dataclass(frozen=True)
class FullLatent(Goal):
    """Actor and critic also see the latent of the scene, state and belief, that a goal image gives (LEXA cosine).

    In training a frame is encoded as a goal image is when the agent acts: alone, as the first frame of an episode. The
    latent that the world model has of the frame remembers what came before it, which no goal image does.

    Args:
        weight: Weight of the loss that teaches the world model what an image alone shows.
    """

    weight: float = setting(1.0, at_least=0)

    @property
    def needs(self) -> Mapping[str, Any]:
        """Latents of images alone, and how they are trained."""
        return {"image_latent": {"lambda_image_latent": self.weight}}

    def build(self, scene: Scene) -> GoalEncoding:
        """The latent of images, and that of the image of a frame."""
        model = scene.model
        assert isinstance(model, FlatWorldModel)  # no other gives what is needed
        frame = TensorDictModule(nn.Identity(), ["image_latent"], [GOAL])
        return GoalEncoding(model.latent_features, None, model.latent_in_images(), frame)


@register("image_embedding")
@dataclass(frozen=True)
class ImageEmbedding(Goal):
    """Actor and critic also see what the world model's encoder makes of a goal image (LEXA temporal)."""

    def build(self, scene: Scene) -> GoalEncoding:
        """The image's part of the embedding; of several images, that of the last."""
        encoder = scene.model.encoder
        frame = TensorDictModule(_ImagePart(encoder), ["encoded_latents"], [GOAL])
        return GoalEncoding(encoder.image_features, None, _LastImage(encoder), frame)


def object_centric(model: nn.Module) -> ObjectWorldModel:
    """The model, if it has object latents.

    Raises:
        SettingsError: if it has none.
    """
    if not isinstance(model, ObjectWorldModel):
        raise SettingsError("goals and rewards on object latents need world_model='object'")
    return model


class SelectObject(nn.Module):
    """What belongs to one object, ``[..., O, any]`` to ``[..., any]``.

    Args:
        index: Which object.
    """

    def __init__(self, index: int) -> None:
        super().__init__()
        self.index = index

    def forward(self, objects: Tensor) -> Tensor:
        """Latents ``[..., O, L]`` to that of the object, ``[..., L]``."""
        return objects[..., self.index, :]


class _LastImage(nn.Module):
    """Images ``[..., F, 3, H, W]`` to the embedding ``[..., E]`` of the last."""

    def __init__(self, encoder: ObservationEncoder) -> None:
        super().__init__()
        self.encoder = encoder

    def forward(self, pixels: Tensor) -> Tensor:
        return self.encoder.image(pixels[..., -1, :, :, :]).float()


class _ImagePart(nn.Module):
    """Embeddings of images and vectors to the image's part ``[..., E]``; holds no parameters of the encoder."""

    def __init__(self, encoder: ObservationEncoder) -> None:
        super().__init__()
        self.features = encoder.image_features

    def forward(self, embedding: Tensor) -> Tensor:
        return embedding[..., : self.features].float()


class _LatentAtGoal(nn.Module):
    """Goal positions ``[..., D]`` to the latent ``[..., L]`` of an object there."""

    def __init__(self, encoder: LatentPositionalEncoder, index: int) -> None:
        super().__init__()
        self.encoder, self.index = encoder, index

    def forward(self, goal_units: Tensor) -> Tensor:
        return self.encoder(goal_units.unsqueeze(-2), object_index=self.index).squeeze(-2)
